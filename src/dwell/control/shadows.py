"""Stamps of shadows: the alternative that a cycle is also sent through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GOLDEN = (np.sqrt(5) - 1) / 2


def shadow_stamps(
    first: int, last: int, active: int, candidates: int, fraction: float
) -> NDArray[np.int16]:
    """Return the candidate that each cycle of a stretch is also sent through, -1 for none.

    Cycle c is sent through the i-th alternative where the fractional part of c times the golden
    ratio lies in [i * fraction, (i + 1) * fraction): every alternative gets its fraction of any
    stretch within a few cycles, evenly spread and in step with no periodic disturbance, and no
    cycle is sent through two (H. Weyl, 1916, DOI 10.1007/BF01475864).

    Parameters
    ----------
    first, last : int
        Cycles, the last excluded.
    active : int
        Index of the candidate that the cycles run under.
    candidates : int
        Number of candidates.
    fraction : float
        Share of the cycles that each alternative gets.

    Returns
    -------
    int16 array, shape (last - first,)
    """
    alternatives = np.array([i for i in range(candidates) if i != active] + [-1], np.int16)
    if fraction <= 0 or candidates < 2:
        return np.full(last - first, -1, np.int16)
    place = (np.arange(first, last) * GOLDEN % 1.0 / fraction).astype(np.int64)
    stamps: NDArray[np.int16] = alternatives[np.minimum(place, candidates - 1)]
    return stamps
