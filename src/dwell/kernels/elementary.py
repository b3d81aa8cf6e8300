"""The kernel's elementary functions for Python: the same bits on every processor."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int64, c_void_p

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.rows import FLOATS_IN, FLOATS_OUT
from dwell.model.number_arrays import Floats


def logarithms(x: Floats) -> Floats:
    """Return natural logarithms to within 1 ulp, for numbers from 2^-1022 on that are finite."""
    out = np.empty_like(x)
    _logarithms()(x, x.size, out)
    return out


def cube_root(x: float) -> float:
    """Return the cube root to within 1 ulp, for 0 and numbers from 2^-1022 to 2^1021."""
    return float(_cube_root()(x))


def moments(x: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean, and the sums of squared deviations and of products of successive ones."""
    out = (c_double * 3)()
    _moments()((c_double * len(x))(*x), len(x), out)
    return out[0], out[1], out[2]


_moments = foreign("dwell_moments", None, c_void_p, c_int64, c_void_p)
_logarithms = foreign("dwell_logarithms", None, FLOATS_IN, c_int64, FLOATS_OUT)
_cube_root = foreign("dwell_cube_root", c_double, c_double)
