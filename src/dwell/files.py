"""Files that appear whole or not at all: written beside, then put in place."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

#: What a file shall hold, or what writes it to the path that it is given.
Content: TypeAlias = bytes | str | Callable[[Path], object]


def write_whole(
    path: Path, content: Content, *, private: bool = False, durable: bool = True
) -> None:
    """Write a file that appears complete or not at all; an older one stays until then.

    A process that is killed meanwhile leaves a file ``.NAME.PID.draft`` beside it.

    Parameters
    ----------
    path : Path
        In a folder that exists.
    content : bytes, str or callable
        Texts are UTF-8. A callable is given the path of the draft, and writes it.
    private : bool
        Whether its owner alone can read it.
    durable : bool
        Whether it must be on the disk, and stay when the power goes, before this returns.

    Raises
    ------
    OSError
        If that fails.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.draft")
    # What a killed process of this number left would keep its own mode.
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
    """Have the kernel write down a folder's names."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
