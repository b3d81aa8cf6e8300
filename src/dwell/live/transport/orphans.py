"""Shared memory that processes have left behind: Zenoh's files without anybody who holds them.

Zenoh holds a lock on every file that it has mapped, and lets go of it when its process ends. What
nobody holds is removed by the next process that uses shared memory; or here, where there may be no
next one.
"""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - where Linux keeps it
_FILES = "*.zenoh"
#: A file that young may be without its lock yet.
YOUNG_S = 0.5


def is_shared_memory(path: str) -> bool:
    """Whether a file is shared memory of Zenoh's."""
    return Path(path).match(f"{SHARED_MEMORY}/{_FILES}")


def remove_orphans(folder: Path = SHARED_MEMORY) -> int:
    """Remove this user's files of Zenoh's that no process holds; returns how many."""
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
