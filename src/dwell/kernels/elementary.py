"""Elementary functions of the kernel for Python, with the same bits on every processor."""

from __future__ import annotations

from ctypes import c_double, c_int64

import numpy as np

from dwell.kernels.library import foreign
from dwell.kernels.rows import FLOATS_IN, FLOATS_OUT
from dwell.model.number_arrays import Floats


def logarithms(x: Floats) -> Floats:
    """Return natural logarithms to within 1 ulp, for finite numbers from 2^-1022 on."""
    out = np.empty_like(x)
    _logarithms()(x, x.size, out)
    return out


def cube_root(x: float) -> float:
    """Return the cube root to within 1 ulp, for 0 and numbers from 2^-1022 to 2^1021."""
    return float(_cube_root()(x))


_logarithms = foreign("dwell_logarithms", None, FLOATS_IN, c_int64, FLOATS_OUT)
_cube_root = foreign("dwell_cube_root", c_double, c_double)
