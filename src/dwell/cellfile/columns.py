"""Columns of a recorded file: CSV by the standard library, Parquet by Polars where it is."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import installing

Values: TypeAlias = "NDArray[np.float64] | NDArray[np.object_]"

SUFFIXES = (".parquet", ".csv")


class UnreadableError(Exception):
    """A file that holds no columns; what is wrong with it."""


class FileColumn(NamedTuple):
    """A column of a file.

    Parameters
    ----------
    values : float64 or object array, shape (rows,)
        Numbers, NaN where one is missing; or anything else.
    kind : str
        Type of its values, where these are no numbers: ``String``, ``Boolean``; empty for numbers.
    """

    values: Values
    kind: str = ""


def column_names(path: Path) -> list[str]:
    """Return the names of a file's columns.

    Raises
    ------
    UnreadableError
        If there are none, or Polars is missing.
    """
    if path.suffix.lower() == ".parquet":
        pl = _polars(path)
        try:
            return list(pl.scan_parquet(path).collect_schema().names())
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
            raise _unreadable(path, error) from None
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            names = next(csv.reader(file, strict=True), None)
    except (csv.Error, OSError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from None
    if not names:
        raise UnreadableError(f"{path} is empty; record it again, or name another")
    return names


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
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            head = next(reader)
            places = [head.index(name) for name in wanted]
            rows = []
            for number, row in enumerate(reader, 1):
                if len(row) != len(head):
                    found = f"row {number} has {len(row)} fields, and the head {len(head)}"
                    raise _unreadable(path, found)
                rows.append([row[place] for place in places])
    except (csv.Error, OSError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from None
    columns = zip(*rows, strict=True) if rows else ([] for _ in wanted)
    return dict(zip(wanted, map(_parsed, columns), strict=True))


def _parsed(texts: Sequence[str]) -> FileColumn:
    """Return a column of numbers where all texts are some; nothing at all is a missing one."""
    try:
        return FileColumn(np.array([float(text) if text else np.nan for text in texts], np.float64))
    except ValueError:
        truth = {text.lower() for text in texts} <= {"true", "false", ""}
        return FileColumn(np.array(texts, object), "Boolean" if truth else "String")


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
