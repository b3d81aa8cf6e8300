"""Memory that a process has been given by the kernel, and keeps."""

from __future__ import annotations

import ctypes

# malloc.h of the GNU C library.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
#: The most that it takes for the second: larger blocks come from the kernel, and go back to it.
LARGE = 32 << 20
#: Free memory at the end of a heap from which on the kernel gets it back.
SPARE = 1 << 30


def keep_memory() -> bool:
    """Have `malloc` keep the memory that it has been given, as real-time programs do.

    Otherwise a stage that needs some arrays for each job may give them back each time, or may not:
    that depends on what else its process has allocated. Where it does, every page of every array is
    a fault: 7 to 11 % of the CPU time of a detector in pictures of 300 kB, in one process and not
    in the next.

    Returns
    -------
    bool
        Whether it does; only the GNU C library is asked.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGE) and mallopt(M_TRIM_THRESHOLD, SPARE))
