"""Traces: recorded columns that a cell names, read from Parquet or CSV files.

Processes that name the same file in the same way share one table, so that a row dropped for one
column is dropped for all and the columns of a cycle come from one row.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from dwell.cellfile.cell_form import TRACE
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import Entry, entries_of
from dwell.model import TraceTable

DEFAULT_TIME = "sent_ms"


class Source(NamedTuple):
    """A file and a way to read it; the processes that share it share their rows."""

    file: str
    by: Literal["row", "time"]
    group: str | tuple[str, ...] | None
    time: str | None
    on_negative: Literal["error", "drop", "clip"]
    wrap: bool

    @classmethod
    def of(cls, entry: Entry) -> Source:
        """Return the source that a declaration names, defaults filled in."""
        by: Literal["row", "time"] = entry.by or "row"
        time = entry.time or DEFAULT_TIME if by == "time" else None
        on_negative: Literal["error", "drop", "clip"] = entry.on_negative or "error"
        return cls(entry.file, by, entry.group, time, on_negative, bool(entry.wrap))

    @property
    def groups(self) -> tuple[str, ...]:
        """Columns whose values make a group."""
        if self.group is None:
            return ()
        return (self.group,) if isinstance(self.group, str) else self.group


Tables: TypeAlias = dict[Source, TraceTable]


def read_traces(entry: Entry, folder: Path, faults: Faults) -> Tables:
    """Read every trace that a cell names.

    Parameters
    ----------
    folder : Path
        Where relative file names start.
    faults : Faults
        Takes what is wrong with the files.

    Returns
    -------
    dict of Source to TraceTable
        Less the sources at fault.
    """
    uses: dict[Source, list[tuple[str, Entry]]] = {}
    doubtful: set[Source] = set()
    for path, trace in declared_traces(entry):
        source = Source.of(trace)
        uses.setdefault(source, []).append((path, trace))
        if faults.touches(path):
            doubtful.add(source)
        if trace.time is not None and trace.by != "time":
            faults.add(f"{path}.time", "has no effect without `by: time`; add that, or remove it")
    tables: Tables = {}
    if not uses:
        return tables
    from dwell.cellfile.trace_files import Reading

    for source, declarations in uses.items():
        reading = Reading(source, declarations, folder, faults)
        frame = reading.frame()
        # How a declaration at fault would have its data read is not known.
        if frame is not None and source not in doubtful:
            table = reading.table(frame)
            if table is not None:
                tables[source] = table
    return tables


def declared_traces(entry: Entry) -> Iterator[tuple[str, Entry]]:
    """Yield every trace declared in an entry, with its place in the file."""
    for one in entries_of(entry):
        if one.shape is TRACE:
            yield one.path, one
