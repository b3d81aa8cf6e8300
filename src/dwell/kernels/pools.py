"""Pools of the newest values of each part of a cycle (see ``pools.cpp``)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from ctypes import addressof, byref, c_double, c_int32, c_int64, c_void_p
from typing import Any, NamedTuple

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.meter import PartTimes
from dwell.kernels.rows import structs
from dwell.model.number_arrays import Floats, Ints

#: Room for values, and for windows.
ROOM = 408
#: Bytes of an instant.
BYTES = 8
#: Number of equal parts of the range of the declared values; the kernel searches in one of them.
GUIDE_PARTS = 512
#: Why Python must look at a pool after `PoolRows.learn`: the values were not added; they were
#: added; they were added to a pool that is not as declared, and show the same regime.
NOT_ADDED, ADDED, GROWN = 1, 2, 3


class HeldValues:
    """The newest values of a part.

    Parameters
    ----------
    known : float64 array, shape (n,)
        The values as declared, ascending.
    patience_ms, likeness, block
        See `dwell.estimators.pool.Reference`.

    Attributes
    ----------
    row : ctypes.Structure
        The kernel's row; its fields are declared in ``rows.h``.
    """

    def __init__(self, known: Floats, patience_ms: float, likeness: float, block: int) -> None:
        self.row = structs()["Pool"](0, len(known), patience_ms, likeness, block)
        self._known, self._held = known, np.empty(ROOM)
        self._before, self._values = np.empty(ROOM), (-1, np.empty(0))
        self._chunks = (structs()["Chunk"] * ROOM)()
        finite = known[np.isfinite(known)]
        low, high = (finite[0].item(), finite[-1].item()) if len(finite) else (0.0, 0.0)
        self.row.guide_low = low
        self.row.guide_parts_per_ms = GUIDE_PARTS / (high - low) if high > low else 0.0
        self._scratch = (c_double * 0)()
        self._set_addresses()

    def __getstate__(self) -> tuple[Any, ...]:
        return bytes(self.row), self._known, self._held, self._before, bytes(self._chunks)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # A copy has its own addresses.
        row, self._known, self._held, self._before, chunks = state
        self._values, self._scratch = (-1, np.empty(0)), (c_double * 0)()
        self.row = structs()["Pool"].from_buffer_copy(row)
        self._chunks = (structs()["Chunk"] * ROOM).from_buffer_copy(chunks)
        self._set_addresses()

    def _set_addresses(self) -> None:
        self.row.known, self.row.held = self._known.ctypes.data, self._held.ctypes.data
        self.row.before, self.row.chunks = self._before.ctypes.data, addressof(self._chunks)
        self._guide = (c_int32 * (GUIDE_PARTS + 1))()
        self.row.guide = addressof(self._guide)
        where = self.row.guide_low, self.row.guide_parts_per_ms, self._guide
        _guide()(self.row.known, len(self._known), *where)

    @property
    def values(self) -> Floats:
        """The values in the order of arrival; the same array until they change."""
        row, (changes, values) = self.row, self._values
        if changes != row.changes:
            values = self._held[row.first : row.first + row.size].copy()
            values.flags.writeable = False
            self._values = row.changes, values
        return values

    @property
    def before(self) -> Floats:
        """The values, ascending, before the present run of windows (see ``rows.h``)."""
        return self._before[: self.row.n_before].copy() if self.row.n_before else self._known

    @before.setter
    def before(self, values: Floats) -> None:
        if len(values) > len(self._before):
            self._before = np.empty(len(values))
            self._set_addresses()
        self.row.n_before = 0 if values is self._known else len(values)
        self._before[: self.row.n_before] = values[: self.row.n_before]

    def error(self) -> tuple[float, float]:
        """Return the lost share of the values, and the standard error of their 95th percentile.

        The error is no less than the error of the mean. Infinite values are lost; of the others,
        at least two must be known for an error above 0.
        """
        if len(self._scratch) < self.row.size:
            self._scratch = (c_double * len(self._held))()
        out = (c_double * 2)()
        _held_error()(byref(self.row), self._scratch, out)
        return out[0], out[1]

    def begin(self, values: Floats, sums: tuple[float, float, float], window: int) -> None:
        """Start again with these values; none counts as measured."""
        row = self.row
        if len(values) > len(self._held):
            self._held = np.empty(len(values))
            self._set_addresses()
        self._held[: len(values)] = values
        row.changes += 1
        row.first, row.size, (row.larger, row.smaller, row.places) = 0, len(values), sums
        self._chunks[0] = structs()["Chunk"](window, 0, len(values), *sums)
        row.first_chunk, row.n_chunks, row.touched = 0, 1, window
        row.measured = row.cycles = row.lasting = row.run_cycles = row.n_before = 0

    def add(
        self,
        values: Floats,
        sums: tuple[float, float, float],
        window: int,
        memory: float,
        cycles: int,
    ) -> None:
        """Add values, and drop the oldest: values beyond the memory or the largest number held.

        Parameters
        ----------
        sums : tuple of float
            Sums of the values' places (see `places`).
        """
        values = np.ascontiguousarray(values)
        where = values.ctypes.data, len(values)
        _pool_add()(byref(self.row), *where, *sums, window, memory, cycles)


class PoolRows:
    """The rows of pools, by the number of their part.

    Parameters
    ----------
    groups : int64 array, shape (groups, parts)
        Numbers of some parts; -1 for none.
    """

    def __init__(self, pools: Sequence[HeldValues], groups: Ints) -> None:
        self._pools, self._groups = tuple(pools), groups
        self._rows = np.array([addressof(pool.row) for pool in pools], np.uint64)
        self._out, self._support = np.empty(len(pools), np.int64), np.empty((len(groups), 2), int)
        self._addresses = self._rows.ctypes.data, self._out.ctypes.data
        self._of_groups = groups.ctypes.data, *groups.shape, self._support.ctypes.data

    def __reduce__(self) -> tuple[type[PoolRows], tuple[Sequence[HeldValues], Ints]]:
        # A copy refers to the copies of the pools.
        return PoolRows, (self._pools, self._groups)

    def others(self) -> list[int]:
        """Return the numbers of the parts that are not as declared."""
        pools, out = self._addresses
        n = _others()(pools, len(self._pools), out)
        return self._out[:n].tolist() if n else []

    def weakest(self) -> list[list[int]]:
        """Return for each group the fewest measured values of a part, and the earliest window.

        The window is the earliest one of the newest values of each part.
        """
        _weakest()(self._addresses[0], *self._of_groups)
        return self._support.tolist()

    def learn(
        self,
        found: PartTimes,
        window: int,
        memory: float,
        cycles: int,
        least: float,
        parts: Ints | None = None,
    ) -> list[tuple[int, int]]:
        """Add the values of a window to the pools whose regime stays the same.

        Parameters
        ----------
        least : float
            Fewest deviations from chance that show another regime.
        parts : int64 array, shape (n,), optional
            Numbers of the parts; if None, all parts that were found.

        Returns
        -------
        list of tuple of (number, why)
            Parts that need another look, and why (`NOT_ADDED`, `ADDED`, `GROWN`).
        """
        pools, out = self._addresses
        of, count = found.found.order, found.found.n_parts
        if parts is not None:
            of, count = parts.ctypes.data, len(parts)
        n = _learn()(pools, byref(found.found), of, count, window, memory, cycles, least, out)
        if not n:
            return []
        numbers = found.numbers if parts is None else parts.tolist()
        why = zip(numbers, self._out[:count].tolist(), strict=True)
        return [(number, one) for number, one in why if one]


def places(
    known: Floats, values: Floats, patience_ms: float = math.inf
) -> tuple[float, float, float]:
    """Add up the places p of values among known values; places are between 0 and 1.

    Parameters
    ----------
    known : float64 array, shape (m,)
        Ascending.
    values : float64 array, shape (n,)
    patience_ms : float
        A value beyond counts as infinite.

    Returns
    -------
    tuple of float
        Sums of -log(1 - p), of -log(p), and of p.
    """
    values, out = np.ascontiguousarray(values), (c_double * 3)()
    where = known.ctypes.data, len(known), values.ctypes.data, len(values)
    _places()(*where, patience_ms, out)
    return out[0], out[1], out[2]


class TimesRow(NamedTuple):
    """The times of cycles: an int64 array, as an argument of `fill`."""

    address: int
    cycles: int
    #: Cycles from one value to the next.
    rate: int = 1

    @classmethod
    def of(cls, row: Ints, rate: int = 1) -> TimesRow:
        """Return the row of a contiguous array, for as long as the array exists."""
        return cls(row.ctypes.data, len(row), rate)


def fill(
    rows: Sequence[TimesRow], values: Floats, stretched: float, begin: int, offset: int
) -> None:
    """Fill the times of cycles with known values in turn (see `dwell.estimators.present_tables`).

    Parameters
    ----------
    rows : sequence of TimesRow
        Nanoseconds; unchanged if all values are lost.
    values : float64 array
        Milliseconds; infinite values are left out.
    stretched : float
        Divisor of the values.
    begin, offset : int
        First column that is filled, and the cycle of column 0.
    """
    values = np.ascontiguousarray(values)
    for address, cycles, rate in rows:
        first, runs = -(-begin // rate), -(-cycles // rate)
        out = address + first * rate * BYTES
        where = first + offset // rate, runs - first, rate, out
        _fill()(values.ctypes.data, len(values), stretched, *where)


_places = foreign("dwell_places", None, c_void_p, c_int64, c_void_p, c_int64, c_double, c_void_p)
_fill = foreign(
    "dwell_fill", c_int64, c_void_p, c_int64, c_double, c_int64, c_int64, c_int64, c_void_p
)
_pool_add = foreign(
    "dwell_pool_add",
    None,
    *(c_void_p, c_void_p, c_int64, c_double, c_double, c_double, c_int64, c_double, c_int64),
)
_held_error = foreign("dwell_held_error", None, c_void_p, c_void_p, c_void_p)
_guide = foreign("dwell_guide", None, c_void_p, c_int64, c_double, c_double, c_void_p)
_learn = foreign(
    "dwell_learn",
    c_int64,
    *(c_void_p, c_void_p, c_void_p, c_int64, c_int64, c_double, c_int64, c_double, c_void_p),
)
_others = foreign("dwell_others", c_int64, c_void_p, c_int64, c_void_p)
_weakest = foreign("dwell_weakest", None, c_void_p, c_void_p, c_int64, c_int64, c_void_p)
