"""The times of the parts of a window's cycles (see ``meter.cpp``)."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import POINTER, c_int64, c_void_p
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.library import library

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class _Window(ctypes.Structure):
    """A window's cycles; ``meter.cpp`` has the same structs."""

    _fields_ = (("rows", c_void_p), ("n", c_int64), ("width", c_int64))


class _Layout(ctypes.Structure):
    _fields_ = (
        ("n_tasks", c_int64),
        ("n_flows", c_int64),
        ("sources", c_void_p),
        ("parts", c_void_p),
        ("shared", c_void_p),
    )


class _Found(ctypes.Structure):
    _fields_ = (
        ("ms", c_void_p),
        ("count", c_void_p),
        ("order", c_void_p),
        ("most", c_int64),
        ("n_parts", c_int64),
    )


class CyclesLayout:
    """What cycles under one candidate, and their shadows, go through.

    Parameters
    ----------
    sources : int64 array, shape (flows,)
        Source of each flow.
    parts : int64 array, shape (1 + candidates, tasks + flows)
        Number of the part of each task, then of each flow, for the cycles themselves, then for
        their shadows through each candidate; -1 where they have none of their own.
    shared : bool array, shape (1 + candidates, flows)
        Whether the source of a flow is shared with the cycle.
    """

    def __init__(self, sources: Ints, parts: Ints, shared: NDArray[np.bool_]) -> None:
        flows = len(sources)
        # Rows have addresses in these.
        self._behind = tuple(map(np.ascontiguousarray, (sources, parts, shared)))
        addresses = (table.ctypes.data for table in self._behind)
        self.row = _Layout(parts.shape[1] - flows, flows, *addresses)

    def __reduce__(self) -> tuple[type[CyclesLayout], tuple[NDArray[Any], ...]]:
        # A copy has addresses of its own.
        return CyclesLayout, self._behind


class PartTimes:
    """Times of the parts of a window's cycles, milliseconds, infinite where lost.

    Parameters
    ----------
    parts : int
        Number of parts.

    Raises
    ------
    KernelError
        If the library cannot be loaded: before the first window, and not in it.
    """

    def __init__(self, parts: int) -> None:
        self._meter = _meter()
        self._count, self._order = np.zeros((2, parts), np.int64)
        self._window = _Window()
        self._found = _Found(None, self._count.ctypes.data, self._order.ctypes.data)
        self._ms = np.empty((parts, 0))

    def __reduce__(self) -> tuple[type[PartTimes], tuple[int]]:
        # As in a copy of `CyclesLayout`; what has been found stays here.
        return PartTimes, (len(self._count),)

    def begin(
        self,
        cycles: Sequence[NDArray[np.integer]],
        shadows: Sequence[NDArray[np.integer]] | None,
        limit_ns: int,
    ) -> None:
        """Begin a window; the times of the one before are overwritten.

        Parameters
        ----------
        cycles, shadows : sequence of four int64 arrays
            Of the cycles, and of their shadows: the candidate that each went through, shape (n,),
            -1 for none; when its jobs became ready and when they had completed, (n, tasks); and
            when its messages arrived, (n, flows). -1 for an instant that had not come.
        limit_ns : int
            A job or message that began before this, and has not ended, counts as lost.
        """
        columns = [cycles[0][:, None], *cycles[1:]]
        if shadows is not None:
            columns += [shadows[0][:, None], *shadows[1:]]
        # One table has one address, which takes as long to find as to copy it.
        self._rows = np.concatenate(columns, axis=1, dtype=np.int64)
        (count, width), self._limit_ns = self._rows.shape, limit_ns
        self._window.rows, self._window.n = self._rows.ctypes.data, count
        self._window.width = width
        if self._ms.shape[1] < 2 * count:
            self._ms = np.empty((len(self._count), 2 * count))
            self._found.ms, self._found.most = self._ms.ctypes.data, self._ms.shape[1]
        self._count[:] = 0
        self._found.n_parts = 0

    def add(self, active: int, layout: CyclesLayout) -> None:
        """Add the times of the cycles under one candidate, and then of their shadows."""
        self._meter(layout.row, self._window, active, self._limit_ns, self._found)

    def by_part(self) -> dict[int, Floats]:
        """Return the times by number of part, in the order in which they were found."""
        counts = self._count.tolist()
        order = self._order[: self._found.n_parts].tolist()
        return {part: self._ms[part, : counts[part]] for part in order}


@cache
def _meter() -> Any:
    """Return the function of the library, with the types of its arguments."""
    function = library().dwell_meter
    layout, window, found = POINTER(_Layout), POINTER(_Window), POINTER(_Found)
    function.argtypes = layout, window, c_int64, c_int64, found
    function.restype = None
    return function
