"""How far estimates from few samples may be off (see ``sampling_errors.cpp``)."""

from __future__ import annotations

from ctypes import c_double, c_int64, c_void_p
from typing import NamedTuple

import numpy as np

from dwell.kernels.library import foreign
from dwell.model.number_arrays import Floats, Ints

#: First columns of the steps of `step_sums`: L95 and V_D, each with its declared value.
PAIRS = 4


class SeriesSums(NamedTuple):
    """Sums over steps of a metric, and of its differences from the declared values.

    Parameters
    ----------
    mean, squares, products : float
        Mean; sums of squared deviations from it, and of products of successive ones.
    more, more_squares, more_products : float
        The same of the differences.
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


def step_sums(steps: Floats) -> tuple[SeriesSums, SeriesSums, list[float]]:
    """Return the sums of L95, those of V_D, and the sums of all columns after `PAIRS`.

    Parameters
    ----------
    steps : float64 array, shape (n, columns)
        At least one step; contiguous.
    """
    count, width = steps.shape
    out = (c_double * (14 + width - PAIRS))()
    _step_sums()(steps.ctypes.data, count, width, out)
    sums: list[float] = out[:]
    return SeriesSums(*sums[:7]), SeriesSums(*sums[7:14]), sums[14:]


def held_error(values: Floats, measured: int) -> tuple[float, float]:
    """Return the lost share of values, and the standard error of their 95th percentile.

    The error is no less than the error of the mean. Infinite values are lost; of the others, at
    least two must be known for an error above 0.

    Parameters
    ----------
    measured : int
        Number of independent values.
    """
    out, scratch = (c_double * 2)(), np.empty(len(values))
    _held_error()(values.ctypes.data, len(values), measured, scratch.ctypes.data, out)
    return out[0], out[1]


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
_held_error = foreign("dwell_held_error", None, c_void_p, c_int64, c_int64, c_void_p, c_void_p)
_tail_error = foreign("dwell_tail_error", c_double, c_void_p, c_int64, c_double, c_double)
