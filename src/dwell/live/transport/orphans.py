"""Orphaned shared memory: files of Zenoh that no process has locked.

Zenoh locks each file that it has mapped, until its process ends. The next process that uses shared
memory removes the files without a lock. This module removes them if no such process may follow.
"""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - where Linux keeps it
_FILES = "*.zenoh"
#: Age below which a file may not have its lock yet.
YOUNG_S = 0.5


def is_shared_memory(path: str) -> bool:
    """Return whether a file is shared memory of Zenoh."""
    return Path(path).match(f"{SHARED_MEMORY}/{_FILES}")


def remove_orphans(folder: Path = SHARED_MEMORY) -> int:
    """Remove this user's orphaned files of Zenoh; return their number."""
    removed = 0
    for path in folder.glob(_FILES):
        with suppress(OSError):
            removed += _remove(path)
    return removed


def _remove(path: Path) -> bool:
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(descriptor)
        if found.st_uid != os.getuid() or abs(time.time() - found.st_ctime) < YOUNG_S:
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
        return True
    finally:
        os.close(descriptor)
