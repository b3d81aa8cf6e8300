"""Trace files: the columns that a cell uses of one file, read, judged and put in groups."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.cellfile.columns import (
    POINTS,
    SUFFIXES,
    FileColumn,
    UnreadableError,
    column_names,
    read_columns,
)
from dwell.cellfile.document_faults import Faults
from dwell.cellfile.forms import Entry
from dwell.cellfile.traces import Source, Tables, declared_traces
from dwell.errors import TraceError
from dwell.model import Trace, TraceTable
from dwell.model.bounds import VALUE
from dwell.model.document import digest
from dwell.model.number_arrays import Floats, Mask
from dwell.model.semantics import nearest

Frame: TypeAlias = Mapping[str, FileColumn]

RELATIVE = (
    "file names are relative to the cell file's folder, or to the folder given as `traces` "
    "(`--traces FOLDER`)"
)
RECORD_AGAIN = "no row could stay; record it again, or name another column"


def read_traces(entry: Entry, folder: Path, faults: Faults) -> Tables:
    """Read every trace that a cell names.

    Parameters
    ----------
    folder : Path
        Where relative file names start.
    faults : Faults
        Collects the faults of the files.

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
    for source, declarations in uses.items():
        reading = Reading(source, declarations, folder, faults)
        frame = reading.frame()
        # How a declaration at fault would have its data read is not known.
        if frame is not None and source not in doubtful:
            table = reading.table(frame)
            if table is not None:
                tables[source] = table
    return tables


@dataclass(slots=True)
class Reading:
    """One source being read.

    Parameters
    ----------
    uses : sequence of (str, Entry)
        The declarations that share it, with their places in the cell file.
    folder : Path
        Where relative file names start.
    faults : Faults
        Collects the faults of the file.
    """

    source: Source
    uses: Sequence[tuple[str, Entry]]
    folder: Path
    faults: Faults
    failed: bool = field(default=False, init=False)

    def table(self, frame: Frame) -> TraceTable | None:
        """Return the table of the columns, or None after at least one fault."""
        values = {name: _floats(frame[name]) for name in dict.fromkeys(self._columns())}
        starts = self._starts(frame)
        time = None
        if self.source.time is not None:
            time = _floats(frame[self.source.time])
        keep, clipped = self._judge(values, time)
        if not self.failed and not keep.any():
            self._fail("file", f"none of its {len(keep)} rows is left after `on_negative: drop`")
        if self.failed:
            return None
        if self.source.on_negative == "clip":
            values = {name: np.maximum(column, 0.0) for name, column in values.items()}
        starts = _kept_starts(starts, keep)
        values = {name: _frozen(column[keep]) for name, column in values.items()}
        if time is not None:
            time = self._instants(time[keep], starts, np.flatnonzero(keep))
        if self.failed:
            return None
        dropped = int(np.count_nonzero(~keep)) + clipped
        table = TraceTable(
            columns=values, starts=starts, time_ms=time, dropped=dropped, **self.source._asdict()
        )
        self._verify(table)
        return None if self.failed else table

    def _fail(self, key: str, message: str, path: str | None = None) -> None:
        self.failed = True
        self.faults.add(f"{path or self.uses[0][0]}.{key}", message, kind=TraceError)

    def _columns(self) -> Iterator[str]:
        return (entry.column for _, entry in self.uses)

    def frame(self) -> Frame | None:
        """Return the columns that the cell uses, of the right types, at least one row."""
        path = self.folder / self.source.file
        if path.suffix.lower() not in SUFFIXES:
            endings = " or ".join(SUFFIXES)
            message = f"{self.source.file!r} must end in {endings}, which says how to read it"
            self._fail("file", message)
            return None
        if not path.is_file():
            what = "is a folder" if path.is_dir() else "does not exist"
            self._fail("file", f"{path} {what}; {_beside(path)}")
            return None
        try:
            if not self._has_columns(column_names(path)):
                return None
            wanted = [*self._columns(), *self.source.groups, self.source.time]
            frame = read_columns(path, [name for name in wanted if name is not None])
        except UnreadableError as error:
            self._fail("file", str(error))
            return None
        if not len(next(iter(frame.values())).values):
            self._fail("file", f"{path} has no rows; record it again, or name another")
            return None
        return frame if self._has_numbers(frame) else None

    def _named(self) -> Iterator[tuple[str, str, str]]:
        """Yield place, key and value of every column with numbers that is named."""
        for path, entry in self.uses:
            yield path, "column", entry.column
        if self.source.time is not None:
            yield self.uses[0][0], "time", self.source.time

    def _has_columns(self, names: Sequence[str]) -> bool:
        groups = ((self.uses[0][0], "group", name) for name in self.source.groups)
        for path, key, name in (*self._named(), *groups):
            if name not in names:
                hint = nearest(name, names)
                known = "" if hint.startswith("known") else f" (known: {', '.join(names)})"
                message = f"{self.source.file} has no column {name!r}; {hint}{known}"
                self._fail(key, message, path)
        return not self.failed

    def _has_numbers(self, frame: Frame) -> bool:
        for path, key, name in self._named():
            if frame[name].kind:
                message = f"column {name!r} holds {frame[name].kind}; it must hold numbers"
                remedy = f"{POINTS}, leave out what is missing, or name another column"
                self._fail(key, f"{message}: {remedy}", path)
        return not self.failed

    def _starts(self, frame: Frame) -> NDArray[np.int64]:
        """Return the first row of every group; the rows of a group must be consecutive."""
        if not self.source.groups:
            return np.zeros(1, np.int64)
        columns = [_labels(frame[name]) for name in dict.fromkeys(self.source.groups)]
        starts: list[int] = []
        before: tuple[object, ...] | None = None
        seen: set[tuple[object, ...]] = set()
        for row, labels in enumerate(zip(*columns, strict=True)):
            if labels == before:
                continue
            if labels in seen and not self.failed:
                values = ", ".join(map(_label, labels))
                self._fail(
                    "group",
                    f"group {values} begins again at row {row + 1} after another group; sort the "
                    "file by group",
                )
            seen.add(labels)
            starts.append(row)
            before = labels
        return np.array(starts, np.int64)

    def _judge(self, values: dict[str, Floats], time: Floats | None) -> tuple[Mask, int]:
        """Return the kept rows and the number of clipped rows; record invalid values as faults."""
        used = [(path, "column", values[entry.column]) for path, entry in self.uses]
        # Negative and unusable values of columns and of instants.
        negative = [column < 0 for *_, column in used]
        lost = [~(column <= VALUE.high) for *_, column in used]  # and so is NaN
        if time is not None:
            used.append((self.uses[0][0], "time", time))
            negative.append(np.zeros(len(time), np.bool_))
            lost.append(~np.isfinite(time))
        mode, clip = self.source.on_negative, np.any(negative, axis=0)
        left = ~(clip | np.any(lost, axis=0))
        if mode == "drop":
            return left, 0
        remedies = {
            "set `on_negative: drop` to leave such rows out of all columns": left.any(),
            "`on_negative: clip` to set negative values to 0": not np.any(lost) and mode == "error",
        }
        remedy = ", or ".join(text for text, works in remedies.items() if works)
        for (path, key, column), below, gone in zip(used, negative, lost, strict=True):
            bad = gone | below if mode == "error" else gone
            if bad.any():
                self._fail(key, f"{_complaint(column, bad)}; {remedy or RECORD_AGAIN}", path)
        return np.ones(len(left), np.bool_), int(np.count_nonzero(clip)) if mode == "clip" else 0

    def _instants(self, time: Floats, starts: NDArray[np.int64], rows: NDArray[np.int64]) -> Floats:
        """Return each row's instant since its group's first; they must not go back."""
        steps = np.diff(time)
        steps[starts[1:] - 1] = 0
        if (steps < 0).any():
            at = int(np.flatnonzero(steps < 0)[0])
            self._fail(
                "time",
                f"{self.source.time!r} goes back from {time[at]:g} to {time[at + 1]:g} at row "
                f"{int(rows[at + 1]) + 1}; sort the file by it, or name the columns that tell "
                "recordings apart with `group`",
            )
        lengths = np.diff(np.append(starts, len(time)))
        return _frozen(time - np.repeat(time[starts], lengths))

    def _verify(self, table: TraceTable) -> None:
        for path, entry in self.uses:
            if entry.sha256 is not None and digest(Trace(table, entry.column)) != entry.sha256:
                self._fail(
                    "sha256",
                    f"{self.source.file} does not hold the recorded data; find the file that "
                    "does, or remove the key to use this file",
                    path,
                )


def _complaint(column: Floats, bad: Mask) -> str:
    """Return how many rows of a column are bad, in which ways, and the first of them."""
    kinds = {
        "negative": bad & (column < 0),
        "missing or NaN": bad & np.isnan(column),
        "above 1e9": bad & (column > VALUE.high),
    }
    counts = {kind: int(np.count_nonzero(rows)) for kind, rows in kinds.items()}
    has = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
    row = int(np.flatnonzero(bad)[0])
    value = "" if np.isnan(column[row]) else f", {column[row]:g}"
    return f"{has} of {len(column)} rows (first: row {row + 1}{value})"


def _floats(column: FileColumn) -> Floats:
    return np.asarray(column.values, np.float64)


def _labels(column: FileColumn) -> list[object]:
    """Return the values of a group; one that is missing is equal to another."""
    return [
        None if isinstance(value, float) and math.isnan(value) else value
        for value in column.values.tolist()
    ]


def _label(value: object) -> str:
    """Return a value of a group as its file has it: whole numbers without a point."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _kept_starts(starts: NDArray[np.int64], keep: Mask) -> NDArray[np.int64]:
    """Return the first row of every group that has one left, counted among the rows that stay."""
    before = np.concatenate(([0], np.cumsum(keep)))
    first = before[starts]
    last = before[np.append(starts[1:], len(keep))]
    return np.asarray(first[last > first], np.int64)


def _frozen(column: Floats) -> Floats:
    column = np.ascontiguousarray(column, np.float64)
    column.setflags(write=False)
    return column


def _beside(path: Path) -> str:
    """Return a remedy for a missing file."""
    try:
        names = [item.name for item in path.parent.iterdir() if item.suffix.lower() in SUFFIXES]
    except OSError:
        return f"{path.parent} is not a folder; {RELATIVE}"
    match = difflib.get_close_matches(path.name, names, n=1)
    if match:
        return f"did you mean {match[0]!r}?"
    return RELATIVE
