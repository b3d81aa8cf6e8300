"""The event loop, as Python calls it (see ``advance.h``)."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np

from dwell.kernels.arrays import Arrays
from dwell.kernels.codes import Status
from dwell.kernels.library import library
from dwell.kernels.rows import Ints

I64, TABLES = ctypes.c_int64, ctypes.c_void_p
STATUSES = tuple(Status)


@cache
def _functions() -> tuple[Any, Any, Any, Any]:
    """Return the functions of the library, with the types of their arguments."""
    loaded = library()
    advance, post, send = loaded.dwell_advance, loaded.dwell_post_event, loaded.dwell_send_state
    logged = loaded.dwell_logged_instants
    logged.argtypes, logged.restype = (TABLES, I64, I64, TABLES, I64, TABLES), None
    advance.argtypes, advance.restype = (TABLES,), ctypes.c_int32
    post.argtypes, post.restype = (TABLES, I64, I64), None
    send.argtypes, send.restype = (TABLES, I64, I64, I64, I64, ctypes.POINTER(I64)), None
    return advance, post, send, logged


def play(arrays: Arrays) -> Status:
    """Advance to the next pause or to the end, enlarging what has become too small.

    A call of the kernel ends after a counted number of events, so that Python sees Ctrl-C.

    Returns
    -------
    Status
        PAUSED, STEP or FINISHED.
    """
    advance = _functions()[0]
    while True:
        status: int = advance(arrays.address)
        if status == Status.GROW_EVENTS:
            arrays.grow_events()
        elif status == Status.GROW_RING:
            arrays.grow_ring()
        elif status != Status.BUSY:
            return STATUSES[status]


def post_event(arrays: Arrays, at_ns: int, key: int) -> None:
    """Add an event of the caller's; there is always room for a few (see `play`)."""
    _functions()[1](arrays.address, at_ns, key)


def logged_instants(
    arrays: Arrays, first: int, last: int, flows: Ints
) -> list[tuple[Ints, Ints, Ints, Ints, Ints]]:
    """Return what the logs still have of cycles, nanoseconds; -1 for never.

    Parameters
    ----------
    first, last : int
        Cycles, the last excluded.
    flows : int64 array, shape (flows,)
        Which flows, in the order of the kernel's.

    Returns
    -------
    list of (ready_ns, end_ns, arrived_ns, start_ns, work_ns)
        By cell: when all inputs of a job were there, and when it had completed, int64 arrays of
        shape (cycles, tasks), when messages arrived, (cycles, flows), when a job started, and the
        core time that it has received, if it has completed, (cycles, tasks).
    """
    tables, count = arrays.tables, last - first
    jobs = count * (tables.jobs.size // tables.slots.size)
    found = np.empty((len(tables.cells), 4 * jobs + count * len(flows)), np.int64)
    _functions()[3](
        *(arrays.address, first, count),
        *(flows.ctypes.data, len(flows), found.ctypes.data),
    )
    by_cell = []
    for of in found:
        ready, end, start, work = of[: 4 * jobs].reshape(4, count, -1)
        by_cell.append((ready, end, of[4 * jobs :].reshape(count, len(flows)), start, work))
    return by_cell


def send_state(
    arrays: Arrays, hop: int, cycle: int, attempt: int, now_ns: int
) -> tuple[int, bool, int]:
    """Send the state of a task that moves; it is carried reliably, whatever the link does.

    Returns
    -------
    at_ns : int
        Instant of its arrival, or of the next attempt; -1 where the link is down for good.
    arrived : bool
        Which of the two.
    attempt : int
        Number of the next attempt; waiting for the end of an outage is none.
    """
    sent = (I64 * 3)()
    _functions()[2](arrays.address, hop, cycle, attempt, now_ns, sent)
    return sent[0], bool(sent[1]), sent[2]
