"""Atomic writes of files: a draft in the same folder replaces the old file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

#: The content of a file, or a function that writes it to a path.
Content: TypeAlias = bytes | str | Callable[[Path], object]


def write_whole(
    path: Path, content: Content, *, private: bool = False, durable: bool = True
) -> None:
    """Write a file atomically, in UTF-8 if it is text; an older file stays until the end.

    Only the owner can read a `private` file. With `durable`, the file survives a power failure once
    this function has returned. A killed process leaves a file ``.NAME.PID.draft`` in the folder,
    which must exist. Raises OSError if writing fails.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    # A draft of a killed process with the same number would keep its own mode.
    draft.unlink(missing_ok=True)
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        handle = os.open(draft, flags, 0o600 if private else 0o666)
        with os.fdopen(handle, "wb") as file:
            if isinstance(content, str):
                file.write(content.encode())
            elif isinstance(content, bytes):
                file.write(content)
            else:
                content(draft)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    if durable:
        _synchronise(path.parent)


def _synchronise(folder: Path) -> None:
    """Write a folder's entries to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
