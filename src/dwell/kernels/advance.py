"""The event loop, as Python calls it (see ``advance.h``)."""

from __future__ import annotations

from ctypes import POINTER, c_int32, c_int64, c_void_p

import numpy as np

from dwell.kernels.arrays import Arrays, CellArrays
from dwell.kernels.codes import EventKind, Status, make_key
from dwell.kernels.library import foreign
from dwell.kernels.meter import WindowRows
from dwell.model.number_arrays import Ints

STATUSES = tuple(Status)

_advance = foreign("dwell_advance", c_int32, c_void_p)
_post = foreign("dwell_post_event", None, c_void_p, c_int64, c_int64)
_send = foreign("dwell_send_state", None, c_void_p, *(c_int64,) * 5, POINTER(c_int64))
_end_repeats = foreign("dwell_end_repeats", None, c_void_p, *(c_int64,) * 2)
_logged = foreign(
    "dwell_logged_window", None, c_void_p, *(c_int64,) * 5, c_void_p, c_int64, *(c_void_p,) * 2
)


def play(arrays: Arrays) -> Status:
    """Advance to the next pause or to the end, enlarging what has become too small.

    A call of the kernel ends after a counted number of events, so that Python sees Ctrl-C.

    Returns
    -------
    Status
        PAUSED, STEP or FINISHED.
    """
    advance = _advance()
    while True:
        status: int = advance(arrays.address)
        if status == Status.GROW_EVENTS:
            arrays.grow_events()
        elif status == Status.GROW_RING:
            arrays.grow_ring()
        elif status != Status.BUSY:
            return STATUSES[status]


def post_event(of: CellArrays, at_ns: int, kind: EventKind, cycle: int = 0, item: int = 0) -> None:
    """Add an event of a cell; there is always room for a few (see `play`)."""
    _post()(of.whole.address, at_ns, make_key(kind, of.part.row, cycle, item))


def logged_window(of: CellArrays, first: int, last: int, flows: Ints) -> WindowRows:
    """Return what the logs still have of a cell's cycles, and of its shadow, if it has one.

    Parameters
    ----------
    first, last : int
        Cycles, the last excluded.
    flows : int64 array, shape (flows,)
        Which flows, in the order of the kernel's.
    """
    part, tasks, count = of.part, of.part.tasks, len(flows)
    table = np.empty((last - first, part.rows * (1 + 4 * tasks + count)), np.int64)
    beside = None
    if of.whole.tables.clock[0]["has_shared"]:
        beside = np.empty((last - first, part.rows, tasks, 2), np.int64)
    rows = WindowRows(table, tasks, count, beside)
    _logged()(
        *(of.whole.address, part.row, part.rows, first, last - first, tasks),
        *(flows.ctypes.data, count, rows.row.rows, rows.beside_address),
    )
    return rows


def send_state(
    of: CellArrays, hop: int, cycle: int, attempt: int, arrival: int, now_ns: int
) -> tuple[int, int]:
    """Send the state of a task that moves, reliably, whatever the link does; post its arrival.

    Parameters
    ----------
    hop : int
        Which of the realisation's.
    arrival : int
        Key of the event of its arrival.

    Returns
    -------
    at_ns : int
        Instant of the next attempt; -1 if this one succeeds, or the link is down for good.
    attempt : int
        Number of the next attempt; waiting for the end of an outage is none.
    """
    following = (c_int64 * 2)()
    hop += of.part.hop_0
    _send()(of.whole.address, hop, cycle, attempt, arrival, now_ns, following)
    return following[0], following[1]


def end_repeats(of: CellArrays, arrival: int, now_ns: int) -> None:
    """Let messages wait no longer for state that is not sent again; `arrival` is its key."""
    _end_repeats()(of.whole.address, arrival, now_ns)
