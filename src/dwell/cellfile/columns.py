"""Columns of a recorded file: CSV by the standard library, Parquet by Polars where it is."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import installing
from dwell.model.bounds import counted

Values: TypeAlias = "NDArray[np.float64] | NDArray[np.object_]"

SUFFIXES = (".parquet", ".csv")
#: What separates columns in exports of spreadsheets whose language writes decimals with a comma.
OTHER_SEPARATORS = {";": "semicolons", "\t": "tabs"}
POINTS = "write decimals with a point, as 1.5, and thousands without a sign"


class UnreadableError(Exception):
    """A file without columns; the text is the reason."""


class FileColumn(NamedTuple):
    """A column of a file.

    Parameters
    ----------
    values : float64 or object array, shape (rows,)
        Numbers, NaN for missing values; or other values.
    kind : str
        Type of values other than numbers: ``String``, or the first text of a CSV file with its
        row; empty for numbers.
    """

    values: Values
    kind: str = ""


def column_names(path: Path) -> list[str]:
    """Return the names of a file's columns.

    Raises
    ------
    UnreadableError
        If the file has no columns, or Polars is missing.
    """
    if path.suffix.lower() == ".parquet":
        pl = _polars(path)
        try:
            return list(pl.scan_parquet(path).collect_schema().names())
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
            raise _unreadable(path, error) from None
    return next(_csv_rows(path))


def read_columns(path: Path, names: Sequence[str]) -> dict[str, FileColumn]:
    """Read columns that a file has.

    Raises
    ------
    UnreadableError
        If it cannot be read.
    """
    wanted = list(dict.fromkeys(names))
    if path.suffix.lower() == ".parquet":
        return _parquet(path, wanted)
    rows = _csv_rows(path)
    head = next(rows)
    places = [head.index(name) for name in wanted]
    kept = []
    for number, row in enumerate(rows, 1):
        if len(row) != len(head):
            remedy = POINTS if len(row) > len(head) else "complete the row, or remove it"
            found = f"row {number} has {counted(len(row), 'field')} ({', '.join(row)})"
            raise _unreadable(path, f"{found}, and the head {len(head)}; {remedy}")
        kept.append([row[place] for place in places])
    columns = zip(*kept, strict=True) if kept else ([] for _ in wanted)
    return dict(zip(wanted, map(_parsed, columns), strict=True))


def _csv_rows(path: Path) -> Iterator[list[str]]:
    """Yield the head of a CSV file and its rows; an empty line is no row.

    Raises
    ------
    UnreadableError
        If it cannot be read, has no head, or is not separated by commas.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            head = next(reader, [])
            rows = (row for row in reader if not _is_blank(row))
            if _is_blank(head):
                if next(rows, None) is None:
                    raise UnreadableError(f"{path} is empty; record it again, or name another")
                raise _unreadable(path, "line 1 is empty, and has to name the columns; remove it")
            _require_commas(path, head)
            yield head
            yield from rows
    except UnicodeDecodeError as error:
        found = f"byte 0x{error.object[error.start]:02x} is not UTF-8; save it as CSV in UTF-8"
        raise _unreadable(path, found) from None
    except (csv.Error, OSError) as error:
        raise _unreadable(path, error) from None


def _is_blank(row: Sequence[str]) -> bool:
    """Whether a line holds nothing; a missing value alone on its line is a quoted nothing."""
    return not row or (len(row) == 1 and row[0].isspace())


def _require_commas(path: Path, head: Sequence[str]) -> None:
    for sign, called in OTHER_SEPARATORS.items():
        if len(head) == 1 and sign in head[0]:
            found = f"line 1 is separated by {called}; separate columns by commas"
            raise _unreadable(path, f"{found}, and {POINTS}")


def _parsed(texts: Sequence[str]) -> FileColumn:
    """Return a column of numbers where all texts are some; nothing at all is a missing one."""
    numbers = np.empty(len(texts), np.float64)
    for row, text in enumerate(texts):
        try:
            numbers[row] = float(text) if text.strip() else np.nan
        except ValueError:
            return FileColumn(np.array(texts, object), f"{text!r} in row {row + 1}")
    return FileColumn(numbers)


def _parquet(path: Path, names: list[str]) -> dict[str, FileColumn]:
    pl = _polars(path)
    from polars.selectors import by_name

    try:
        # By exact name: elsewhere polars takes ^x$ and * for patterns.
        frame = pl.scan_parquet(path).select(by_name(*names)).collect()
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        raise _unreadable(path, error) from None
    found = {}
    for name in names:
        series = frame[name]
        if series.dtype.is_numeric():
            numbers = series.cast(pl.Float64).fill_null(np.nan).to_numpy()
            found[name] = FileColumn(np.asarray(numbers, np.float64))
        else:
            values = np.empty(len(series), object)
            values[:] = series.to_list()
            found[name] = FileColumn(values, str(series.dtype))
    return found


def _polars(path: Path) -> Any:
    """Return Polars, which robots need not have."""
    try:
        import polars
    except ModuleNotFoundError:
        raise UnreadableError(
            f"{path} needs Polars, which is not installed; {installing('sim')}, or record the "
            "trace as CSV"
        ) from None
    return polars


def _unreadable(path: Path, reason: object) -> UnreadableError:
    return UnreadableError(f"{path} cannot be read: {str(reason).partition(chr(10))[0]}")
