"""Random streams inside kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.compiled import kernel


@kernel
def ar1_path(noise: NDArray[np.float64], correlation: float, state: float, first: bool) -> float:
    """Turn white noise into a stationary AR(1) path of unit variance, in place.

    x[t] = r x[t-1] + sqrt(1 - r^2) e[t]; the very first value is e[0] itself.

    Parameters
    ----------
    noise : float64 array, shape (n,)
        Independent standard normals in, the path out.
    correlation : float
        r, in (-1, 1).
    state : float
        Last value of the block before; not used where `first`.
    first : bool
        Whether the block begins the path.

    Returns
    -------
    float
        Last value, the state for the next block.
    """
    gain = np.sqrt(1.0 - correlation * correlation)
    for i in range(noise.size):
        if first and i == 0:
            state = noise[0]
        else:
            state = correlation * state + gain * noise[i]
        noise[i] = state
    return state


@kernel
def standard_normals(rng: np.random.Generator, out: NDArray[np.float64]) -> None:
    """Fill an array with what ``rng.standard_normal`` gives, in half the time.

    Parameters
    ----------
    rng : Generator
        Advanced as NumPy would.
    out : float64 array, shape (n,)
    """
    for i in range(out.size):
        out[i] = rng.standard_normal()


@kernel
def nanoseconds(
    values: NDArray[np.float64], unit_ns: float, longest_ns: float, out: NDArray[np.int64]
) -> None:
    """Round durations to whole nanoseconds.

    Parameters
    ----------
    values : float64 array, shape (n,)
    unit_ns : float
        Nanoseconds in one of their units.
    longest_ns : float
        No duration is longer.
    out : int64 array, shape (n,)
    """
    for i in range(values.size):
        out[i] = np.int64(np.rint(min(values[i] * unit_ns, longest_ns)))
