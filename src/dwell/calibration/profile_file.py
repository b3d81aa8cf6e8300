"""Profile file: samples of tasks and links in one Parquet file, in one column each.

Cells replay the columns ``task@node`` and ``from->to`` (`trace`). All columns have the same number
of rows, because a replay shares the rows of a file; samples of another length need another file.
The file's metadata describes each measurement as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from dwell.errors import ProfileError
from dwell.files import write_whole
from dwell.model.number_arrays import Floats
from dwell.model.semantics import bad_name

KEY = "dwell.profile"
FORMAT = 1
SUFFIX = ".parquet"


@dataclass(frozen=True, slots=True)
class Measurement:
    """Samples of one task on one node, or of one link.

    Parameters
    ----------
    name : str
        ``task@node`` or ``from->to``.
    columns : mapping of str to array of float64, shape (rows,)
        Milliseconds; the first column has the measurement's name, and cells replay it.
    about : mapping
        Description of the measurement, for JSON.
    """

    name: str
    columns: Mapping[str, Floats]
    about: Mapping[str, Any]

    @property
    def samples(self) -> Floats:
        """The column that a cell replays."""
        return self.columns[self.name]


def task_name(task: str, node: str) -> str:
    """Return ``task@node``.

    Raises
    ------
    ProfileError
        If one of them cannot be a name in a cell.
    """
    _require_names(task=task, node=node)
    return f"{task}@{node}"


def link_name(source: str, target: str) -> str:
    """Return ``source->target``, as cells write it.

    Raises
    ------
    ProfileError
        If one of them cannot be a name in a cell, or they are the same.
    """
    _require_names(**{"from": source, "to": target})
    if source == target:
        raise ProfileError(f"to: {target!r} is also where it starts; a link joins two nodes")
    return f"{source}->{target}"


def _require_names(**names: str) -> None:
    for what, name in names.items():
        if message := bad_name(name):
            raise ProfileError(f"{what}: {message}")


def stamp() -> dict[str, str]:
    """Return the time and the version that every measurement is stamped with."""
    from dwell.version import __version__

    return {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "dwell": __version__,
    }


def require_free(path: Path, names: Collection[str]) -> None:
    """Refuse a file that a profile may not be written to.

    Parameters
    ----------
    path : Path
        A new file, or a profile without other measurements than `names`.
    names : collection of str
        Names of the new profile's measurements.

    Raises
    ------
    ProfileError
        If its name does not end in ``.parquet``, it is no profile, or measurements would be lost.
    """
    if path.suffix.lower() != SUFFIX:
        raise ProfileError(f"{path}: a profile is a Parquet file; let its name end in {SUFFIX}")
    if path.is_dir():
        raise ProfileError(f"{path} is a folder; name a file")
    if not path.exists():
        return
    try:
        lost = [one.name for one in read_profile(path) if one.name not in names]
    except ProfileError:
        raise ProfileError(f"{path} exists and is no profile; name another file") from None
    if lost:
        raise ProfileError(
            f"{path} holds {', '.join(lost)}, which would be lost; name another file (profiles "
            "are put together with `dwell profile merge`)"
        )


def write_profile(path: Path, measurements: Sequence[Measurement]) -> None:
    """Write a file that appears complete or not at all; an older profile survives until then.

    Raises
    ------
    ProfileError
        If `path` is taken by something else, two measurements have one name, or their numbers of
        rows differ.
    OSError
        If it cannot be written.
    """
    import polars as pl

    names = [one.name for one in measurements]
    require_free(path, names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ProfileError(f"{', '.join(twice)}: measured twice; keep one of them")
    _require_one_length({one.name: len(one.samples) for one in measurements})
    frame = pl.DataFrame(
        {name: values for one in measurements for name, values in one.columns.items()}
    )
    about = {one.name: {**one.about, "columns": list(one.columns)} for one in measurements}
    text = json.dumps({"format": FORMAT, "measurements": about}, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda draft: frame.write_parquet(draft, metadata={KEY: text}))


def _require_one_length(rows: Mapping[str, int]) -> None:
    if len(set(rows.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in rows.items())
        raise ProfileError(
            f"numbers of rows differ ({listed}), and the columns of one file share their rows; "
            "measure as many runs everywhere, or keep separate files (a cell may name several)"
        )


def read_profile(path: Path) -> tuple[Measurement, ...]:
    """Read the measurements of a profile.

    Raises
    ------
    ProfileError
        If the file is missing or no profile, is of a newer format, or lacks values.
    """
    import polars as pl

    if not path.is_file():
        raise ProfileError(f"{path}: no such file")
    try:
        text = pl.read_parquet_metadata(path).get(KEY)
        if text is None:
            raise ProfileError(f"{path} is no profile; `dwell profile` writes one")
        frame = pl.read_parquet(path)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError) as error:
        reason = str(error).partition("\n")[0]
        raise ProfileError(f"{path} cannot be read: {reason}") from None
    about = _parsed(path, text)
    return tuple(_measurement(path, frame, name, entry) for name, entry in about.items())


def _parsed(path: Path, text: str) -> dict[str, dict[str, Any]]:
    """Return the entry of every measurement, by its name."""
    try:
        found = json.loads(text)
        version, measurements = int(found["format"]), dict(found["measurements"])
        sound = version != FORMAT or all(
            name in list(entry["columns"]) for name, entry in measurements.items()
        )
    except (ValueError, KeyError, TypeError):
        sound = False
    if not sound:
        raise ProfileError(f"{path}: its metadata cannot be understood; measure again")
    if version != FORMAT:
        raise ProfileError(f"{path}: format {version}; this version reads {FORMAT} only")
    return measurements


def _measurement(path: Path, frame: Any, name: str, entry: dict[str, Any]) -> Measurement:
    columns = {}
    for column in entry["columns"]:
        if column not in frame.columns or not frame[column].dtype.is_numeric():
            raise ProfileError(f"{path} has no numbers in a column {column!r}; measure again")
        values = frame[column].cast(float).fill_null(np.nan).to_numpy()
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0]) + 1
            raise ProfileError(f"{path}: column {column!r} has no value in row {row}")
        columns[column] = values
    about = {key: value for key, value in entry.items() if key != "columns"}
    return Measurement(name, columns, about)


def merge_profiles(paths: Iterable[Path]) -> tuple[Measurement, ...]:
    """Read several profiles as if they were one.

    Raises
    ------
    ProfileError
        If one cannot be read, two hold the same task on the same node (or the same link), or
        their numbers of rows differ.
    """
    merged: dict[str, tuple[Path, Measurement]] = {}
    rows: dict[str, int] = {}
    for path in paths:
        for one in read_profile(path):
            if one.name in merged:
                raise ProfileError(
                    f"{one.name} is both in {merged[one.name][0]} and in {path}; leave one out"
                )
            merged[one.name] = (path, one)
            rows[str(path)] = len(one.samples)
    _require_one_length(rows)
    return tuple(one for _, one in merged.values())
