"""Stretches: misses in K consecutive cycles."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from dwell.model.objective import MissCap


def misses_in(missed: NDArray[np.bool_], stretches: Iterable[int]) -> Iterator[NDArray[np.int32]]:
    """Count the misses in every stretch of K consecutive cycles, for several K.

    Parameters
    ----------
    missed : bool array, shape (n,)
    stretches : iterable of int
        K, cycles of a stretch.

    Yields
    ------
    int32 array, shape (n - K + 1,)
        The largest is the smallest m for which the cycles meet "at most m misses in any K". With
        fewer than K cycles the array has one element, the number of all misses.
    """
    total = np.zeros(len(missed) + 1, np.int32)
    np.cumsum(missed, dtype=np.int32, out=total[1:])
    for stretch in stretches:
        yield total[stretch:] - total[:-stretch] if len(missed) > stretch else total[-1:]


def share_over(missed: NDArray[np.bool_], cap: MissCap) -> float:
    """Return the share of the stretches of k cycles with more than m misses."""
    (counts,) = misses_in(missed, [cap.k])
    return float((counts > cap.m).mean())
