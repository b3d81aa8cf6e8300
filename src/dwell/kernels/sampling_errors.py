"""Errors of estimates from few samples (see ``sampling_errors.cpp``)."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int64, c_void_p
from typing import NamedTuple

import numpy as np

from dwell.kernels.library import foreign
from dwell.model.number_arrays import Floats, Ints

#: First columns of `Steps`: L95 and V_D, each with its declared value.
PAIRS = 4


class SeriesSums(NamedTuple):
    """Sums over steps of a metric, and of its differences from the declared values.

    Parameters
    ----------
    mean, squares, products : float
        Mean; sums of squared deviations from it, and of products of successive deviations.
    more, more_squares, more_products : float
        The same for the differences.
    apart : float
        Sum of the absolute differences.
    """

    mean: float
    squares: float
    products: float
    more: float
    more_squares: float
    more_products: float
    apart: float


class Steps:
    """Mean metrics of the newest steps of a simulation.

    Parameters
    ----------
    most : int
        Largest number of steps.
    columns : int
        Number of columns: `PAIRS`, and others.
    """

    def __init__(self, most: int, columns: int) -> None:
        self._table, self._count = np.zeros((most, columns)), 0
        self._out = (c_double * (14 + columns - PAIRS))()
        self._address = self._table.ctypes.data

    def __len__(self) -> int:
        return self._count

    @property
    def table(self) -> Floats:
        """The steps, the oldest first, shape (n, columns)."""
        return self._table[: self._count]

    def add(self, means: Sequence[float]) -> None:
        """Add a step; a full table drops the oldest."""
        self.keep(len(self._table) - 1)
        self._table[self._count] = means
        self._count += 1

    def keep(self, most: int) -> None:
        """Keep the newest steps."""
        if self._count > most:
            self._table[:most] = self._table[self._count - most : self._count]
            self._count = most

    def sums(self) -> tuple[SeriesSums, SeriesSums, list[float]]:
        """Return the sums for L95, for V_D, and for each column after `PAIRS`."""
        _step_sums()(self._address, self._count, self._table.shape[1], self._out)
        sums: list[float] = self._out[:]
        return SeriesSums(*sums[:7]), SeriesSums(*sums[7:14]), sums[14:]


def tail_error_ms(latency_ns: Ints, most_ms: float, off: float) -> float:
    """Return the error of the 95th percentile of latencies whose place has the error `off`.

    Parameters
    ----------
    latency_ns : int64 array, shape (n,)
        At least one; the order changes.
    most_ms : float
        Largest latency that counts.
    """
    return float(_tail_error()(latency_ns.ctypes.data, len(latency_ns), most_ms, off))


_step_sums = foreign("dwell_step_sums", None, c_void_p, c_int64, c_int64, c_void_p)
_tail_error = foreign("dwell_tail_error", c_double, c_void_p, c_int64, c_double, c_double)
