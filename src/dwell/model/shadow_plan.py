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
    plan = ShadowPlan(first, last, candidates, fraction)
    return plan.stamps(first, last, active)


class ShadowPlan:
    """Which cycles of a stretch are also sent through an alternative (see `shadow_stamps`)."""

    def __init__(self, first: int, last: int, candidates: int, fraction: float) -> None:
        self._first, self._candidates = first, candidates
        #: Which alternative each cycle is sent through; the last one stands for none.
        self._place = np.full(last - first, max(candidates - 1, 0), np.int16)
        if fraction > 0 and candidates > 1:
            turned = np.arange(first, last) * GOLDEN
            turned -= np.floor(turned)
            turned /= fraction
            np.minimum(turned, candidates - 1, out=turned)
            self._place[:] = turned

    def __repr__(self) -> str:
        first = self._first
        return f"ShadowPlan(cycles {first} to {first + len(self._place)}, {len(self.sent)} sent)"

    @property
    def sent(self) -> NDArray[np.int64]:
        """The cycles that are sent through any, whatever they run under, ascending."""
        return self._first + np.flatnonzero(self._place < self._candidates - 1)

    def stamps(self, first: int, last: int, active: int) -> NDArray[np.int16]:
        """Return the stamps of some of the cycles where they run under a candidate."""
        alternatives = [i for i in range(self._candidates) if i != active]
        stamps: NDArray[np.int16] = np.array([*alternatives, -1], np.int16)[
            self._place[first - self._first : last - self._first]
        ]
        return stamps
