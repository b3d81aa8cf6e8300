"""The folder of a study: what study it is, a part for every finished item, and the tables.

``study.json`` says what study the folder belongs to, ``parts`` holds one Parquet file an item. A
file appears complete or not at all: it is written under another name, brought to the disk, and
renamed. Whatever kills the process, what is there can be relied on, and what is not is done again.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dwell.errors import RunError, SimulationError
from dwell.io.wording import as_read

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Parts", "opened"]

VERSION = 1
DESCRIPTION = "study.json"
FOLDER = "parts"
# How many differences from another study are listed.
LISTED = 4

Description = Mapping[str, Any]


@dataclass(slots=True)
class Parts:
    """The parts of one study in its folder, open for this process alone.

    Parameters
    ----------
    folder : Path
    names : frozenset of str
        Of all items of the study.
    """

    folder: Path
    names: frozenset[str]

    def finished(self) -> frozenset[str]:
        """Return the names of the items whose parts are there."""
        found = (path.stem for path in (self.folder / FOLDER).glob("*.parquet"))
        return self.names.intersection(found)

    def write(self, name: str, frame: pl.DataFrame) -> None:
        """Write the part of an item.

        Raises
        ------
        SimulationError
            If that fails; the parts that are there stay.
        """
        self._write(self._part(name), frame)

    def read(self, names: Sequence[str]) -> pl.DataFrame:
        """Return the parts of items, one below the other.

        Raises
        ------
        RunError
            If one cannot be read.
        """
        import polars as pl

        frames = []
        for name in names:
            try:
                frames.append(pl.read_parquet(self._part(name), glob=False))
            except (OSError, pl.exceptions.PolarsError) as error:
                raise RunError(
                    f"{self._part(name)}: cannot be read ({error}); remove it and run the study "
                    "again"
                ) from None
        return pl.concat(frames)

    def write_table(self, name: str, frame: pl.DataFrame) -> None:
        """Write a table of the whole study.

        Raises
        ------
        SimulationError
            If that fails.
        """
        self._write(self.folder / f"{name}.parquet", frame)

    def _part(self, name: str) -> Path:
        return self.folder / FOLDER / f"{name}.parquet"

    def _write(self, path: Path, frame: pl.DataFrame) -> None:
        # To memory first: how a disk is full is then the system's own answer.
        data = io.BytesIO()
        frame.rechunk().write_parquet(data)
        try:
            write_whole(path, data.getvalue())
        except OSError as error:
            raise _unwritable(path, error) from None


@contextmanager
def opened(folder: Path, description: Description, names: Sequence[str]) -> Iterator[Parts]:
    """Open the folder of a study, which is made where there is none.

    Parameters
    ----------
    folder : Path
    description : mapping
        JSON-able: all that the tables depend on.
    names : sequence of str
        Of all items.

    Raises
    ------
    RunError
        If the folder holds something else, or another study, or is in use.
    SimulationError
        If it cannot be made or written.
    """
    try:
        if folder.exists():
            _require_study(folder)
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise _unwritable(folder, error) from None
    try:
        _lock(folder, handle)
        _claim(folder, description)
        for place in (folder, folder / FOLDER):
            for draft in place.glob(".*.draft"):
                draft.unlink(missing_ok=True)
        yield Parts(folder, frozenset(names))
    finally:
        os.close(handle)


def _lock(folder: Path, handle: int) -> None:
    """Keep other processes out; the kernel lets them in when this one ends, however it does."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RunError(f"{folder} is in use: another process works on this study") from None


def _require_study(folder: Path) -> None:
    """Refuse a folder that holds something else."""
    if not folder.is_dir():
        raise RunError(f"{folder} is no folder; choose another one")
    if (folder / DESCRIPTION).is_file():
        return
    # Killed at its very beginning, a study leaves these.
    known = {FOLDER, f".{DESCRIPTION}.draft"}
    if any(path.name not in known for path in folder.iterdir()):
        raise RunError(f"{folder} exists and is no study; choose another folder")


def _claim(folder: Path, description: Description) -> None:
    """Write what study the folder belongs to, or refuse it where that is another one."""
    path = folder / DESCRIPTION
    text = json.dumps({"dwell-study-folder": VERSION, **description}, allow_nan=False)
    whole = json.loads(text)
    whole["digest"] = hashlib.sha256(text.encode()).hexdigest()
    if path.is_file():
        try:
            known = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RunError(f"{path}: cannot be read ({error})") from None
        if not isinstance(known, dict):
            raise RunError(f"{path} describes no study; choose another folder")
        if known.get("digest") != whole["digest"]:
            raise RunError(_difference(folder, known, whole))
        return
    try:
        text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False)
        write_whole(path, f"{text}\n".encode())
    except OSError as error:
        raise _unwritable(folder, error) from None


def _unwritable(path: Path, error: OSError) -> SimulationError:
    return SimulationError(f"{path}: cannot be written ({error.strerror or error})")


def _difference(folder: Path, known: Any, asked: Any) -> str:
    """Return what is different about the study in a folder."""
    found = [one for one in _differences(known, asked, "") if one.partition(":")[0] != "digest"]
    more = [] if len(found) <= LISTED else [f"and {len(found) - LISTED} more"]
    listed = "\n".join(f"  {line}" for line in (*found[:LISTED], *more))
    return (
        f"{folder} holds another study, or one made with other versions; choose another folder, or "
        f"remove this one:\n{listed}"
    )


def _differences(known: Any, asked: Any, path: str) -> Iterator[str]:
    """Yield ``path: it is ... there and ... now`` for everything that differs."""
    if isinstance(known, dict) and isinstance(asked, dict):
        for key in dict.fromkeys((*known, *asked)):
            inner = f"{path}.{key}" if path else key
            yield from _differences(known.get(key), asked.get(key), inner)
    elif known != asked:
        yield f"{path}: {_shown(known)} there, {_shown(asked)} now"


def _shown(value: object) -> str:
    if isinstance(value, list) and all(isinstance(item, int | float | str) for item in value):
        text = ", ".join(str(item) for item in value)
        return text if len(text) <= 60 else f"{text[:57]}..."
    return as_read(value)


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that appears complete or not at all, and stays when the power goes.

    Raises
    ------
    OSError
        If that fails; an older file of the name stays then.
    """
    draft = path.with_name(f".{path.name}.draft")
    try:
        with draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    handle = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
