"""Work folders: each belongs to one piece of work, which fills it in as many attempts as needed.

A file in the folder has the work's description. Work with another description is refused with the
differences, and nothing changes. Files appear complete or not at all.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from dwell.errors import RunError, SimulationError
from dwell.files import write_whole
from dwell.model.bounds import as_read

# How many differences from other work are listed.
LISTED = 4

Description = Mapping[str, Any]


class FolderMark(NamedTuple):
    """Mark of the folders of one kind of work.

    Parameters
    ----------
    what : str
        The kind of work, for messages: ``study``.
    file : str
        Name of the file with the description.
    version : int
        Version of the folder's layout.
    folders : tuple of str
        Folders inside that the work fills.
    """

    what: str
    file: str
    version: int
    folders: tuple[str, ...]

    @property
    def key(self) -> str:
        """Key of the version in the file."""
        return f"dwell-{self.what}-folder"


@contextmanager
def open_work_folder(
    folder: Path, mark: FolderMark, description: Description, notes: Description | None = None
) -> Iterator[None]:
    """Open a folder for this process alone; make it if it is missing.

    Parameters
    ----------
    description : mapping
        Everything that determines the results, as JSON-able values.
    notes : mapping, optional
        JSON-able: written next to the description, and replaced after a change.

    Raises
    ------
    RunError
        If the folder has other contents or other work of this kind, or is in use.
    SimulationError
        If it cannot be made or written.
    """
    try:
        if folder.exists():
            _require_kind(folder, mark)
        for inner in mark.folders:
            (folder / inner).mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise unwritable(folder, error) from None
    try:
        _lock(folder, handle, mark.what)
        _take(folder, mark, description, notes or {})
        for place in (folder, *(folder / inner for inner in mark.folders)):
            for draft in place.glob(".*.draft"):
                draft.unlink(missing_ok=True)
        yield
    finally:
        os.close(handle)


def _lock(folder: Path, handle: int, what: str) -> None:
    """Keep other processes out; the operating system releases the lock at this process's end."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RunError(f"{folder} is in use: another process works on this {what}") from None


def _require_kind(folder: Path, mark: FolderMark) -> None:
    """Refuse a folder with other contents."""
    if not folder.is_dir():
        raise RunError(f"{folder} is not a folder; choose another")
    if (folder / mark.file).is_file():
        return
    # Work that was killed at its start leaves these.
    drafts = f".{mark.file}*.draft"
    if any(one.name not in mark.folders and not one.match(drafts) for one in folder.iterdir()):
        raise RunError(f"{folder} exists and is no {mark.what}; choose another folder")


def _take(folder: Path, mark: FolderMark, description: Description, notes: Description) -> None:
    """Write whose folder it is, or refuse it where it is another's."""
    path = folder / mark.file
    text = json.dumps({mark.key: mark.version, **description}, allow_nan=False)
    digest = hashlib.sha256(text.encode()).hexdigest()
    whole = {**json.loads(text), "digest": digest, **notes}
    if path.is_file():
        try:
            known = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RunError(f"{path}: cannot be read ({error})") from None
        if not isinstance(known, dict):
            raise RunError(f"{path} describes no {mark.what}; choose another folder")
        if known.get("digest") != digest:
            raise RunError(_difference(folder, mark.what, known, whole))
        if known == whole:
            return
    try:
        text = json.dumps(whole, indent=2, ensure_ascii=False, allow_nan=False)
        write_whole(path, f"{text}\n")
    except OSError as error:
        raise unwritable(path, error) from None


def unwritable(path: Path, error: OSError) -> SimulationError:
    """Return the error that says so."""
    return SimulationError(f"{path}: cannot be written ({error.strerror or error})")


def _difference(folder: Path, what: str, known: Any, asked: Any) -> str:
    """Return the message about other work in a folder."""
    found = [one for one in _differences(known, asked, "") if one.partition(":")[0] != "digest"]
    more = [] if len(found) <= LISTED else [f"and {len(found) - LISTED} more"]
    listed = "\n".join(f"  {line}" for line in (*found[:LISTED], *more))
    return (
        f"{folder} holds another {what}, or work of other versions; choose another folder, "
        f"or remove this folder:\n{listed}"
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
