"""Setting of `malloc`: a process keeps its freed memory."""

from __future__ import annotations

import ctypes

# malloc.h of the GNU C library.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
#: Largest valid M_MMAP_THRESHOLD in bytes; freed blocks above it return to the kernel.
LARGE = 32 << 20
#: Free bytes at the end of a heap above which `malloc` returns memory to the kernel.
SPARE = 1 << 30


def keep_memory() -> bool:
    """Make `malloc` keep freed memory, as real-time programs do; return whether it will.

    Otherwise a stage may return its arrays to the kernel after each job, depending on the other
    allocations of its process. Each page of each array then costs a page fault: 7 to 11 % of the
    CPU time of a detector with images of 300 kB, in one process and not in the next. Only the GNU C
    library has this setting.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGE) and mallopt(M_TRIM_THRESHOLD, SPARE))
