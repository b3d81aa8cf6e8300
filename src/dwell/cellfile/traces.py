"""Traces: recorded columns that a cell names, and their files.

Processes that name the same file in the same way share one table: a row dropped for one column is
dropped for all, and the columns of a cycle come from one row.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple, TypeAlias

from dwell.cellfile.cell_form import TRACE
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


def declared_traces(entry: Entry) -> Iterator[tuple[str, Entry]]:
    """Yield every trace declared in an entry, with its place in the file."""
    for one in entries_of(entry):
        if one.shape is TRACE:
            yield one.path, one
