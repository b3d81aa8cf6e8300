"""Python interface of the event loop (see ``advance.h``)."""

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
    """Advance to the next pause or to the end, and enlarge tables that are full.

    The kernel returns after a fixed number of events, which lets Python handle Ctrl-C. The result
    is PAUSED, STEP or FINISHED.
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
    """Add an event of a cell; the queue always has room for a few (see `play`)."""
    _post()(of.whole.address, at_ns, make_key(kind, of.part.row, cycle, item))


class LoggedCycles:
    """The logs of a cell's cycles and of their shadows, if any.

    Parameters
    ----------
    flows : int64 array
        The flows of the result as indices into the kernel's flows.
    """

    def __init__(self, of: CellArrays, flows: Ints) -> None:
        self._of, self._flows, self._flows_at = of, flows, flows.ctypes.data
        self._has_shared = bool(of.whole.tables.clock[0]["has_shared"])

    def window(self, first: int, last: int) -> WindowRows:
        """Return the logs of the cycles `first` to `last` - 1."""
        part, n, count = self._of.part, last - first, len(self._flows)
        tasks = part.copies * part.tasks
        table = np.empty((n, part.rows * (1 + 4 * tasks + count)), np.int64)
        beside = np.empty((n, part.rows, tasks, 2), np.int64) if self._has_shared else None
        rows = WindowRows(table, tasks, count, beside)
        _logged()(
            *(self._of.whole.address, part.row, part.rows, first, n, tasks),
            *(self._flows_at, count, rows.row.rows, rows.beside_address),
        )
        return rows


def send_state(
    of: CellArrays, hop: int, cycle: int, attempt: int, arrival: int, now_ns: int
) -> tuple[int, int]:
    """Attempt to send the state of a task that moves, and post its arrival.

    Parameters
    ----------
    hop : int
        Index of the hop in the realisation.
    arrival : int
        Key of the arrival event.

    Returns
    -------
    at_ns : int
        Instant of the next attempt; -1 if this attempt succeeds, or the link stays down.
    attempt : int
        Number of the next attempt; a wait for the end of an outage does not count.
    """
    following = (c_int64 * 2)()
    hop += of.part.hop_0
    _send()(of.whole.address, hop, cycle, attempt, arrival, now_ns, following)
    return following[0], following[1]


def end_repeats(of: CellArrays, arrival: int, now_ns: int) -> None:
    """Release the messages that wait for a cancelled state; `arrival` is the key of its arrival."""
    _end_repeats()(of.whole.address, arrival, now_ns)
