"""Shadow plan: the alternative that also processes a cycle, as a shadow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model.frozen import FrozenDict
from dwell.model.placement import Placement

GOLDEN = (np.sqrt(5) - 1) / 2

#: Share of the cycles for each alternative: one number, or a number per active candidate.
ShadowFraction: TypeAlias = float | Mapping[str, float]


def by_candidate(
    fraction: ShadowFraction, candidates: Mapping[str, Placement]
) -> FrozenDict[str, float]:
    """Return the share of each alternative, by the active candidate; 0 in a cell with replicas."""
    if any(placement.second is not None for placement in candidates.values()):
        return FrozenDict(dict.fromkeys(candidates, 0.0))
    if isinstance(fraction, Mapping):
        return FrozenDict({name: fraction.get(name, 0.0) for name in candidates})
    return FrozenDict(dict.fromkeys(candidates, fraction))


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
    plan = ShadowPlan(first, last, [fraction] * candidates)
    return plan.stamps(first, last, active)


class ShadowPlan:
    """Which cycles of a stretch are also sent through an alternative (see `shadow_stamps`).

    Parameters
    ----------
    fractions : sequence of float
        Share of the cycles that each alternative gets, by the candidate that is active.
    """

    def __init__(self, first: int, last: int, fractions: Sequence[float]) -> None:
        self._first, self._last, self._fractions = first, last, tuple(fractions)
        self._none = max(len(self._fractions) - 1, 0)
        turned = np.arange(first, last) * GOLDEN
        turned -= np.floor(turned)
        #: Which alternative each cycle is sent through, by the share; the last stands for none.
        self._places = {fraction: self._placed(turned, fraction) for fraction in set(fractions)}

    def __repr__(self) -> str:
        return f"ShadowPlan(cycles {self._first} to {self._last}, {len(self.sent)} sent)"

    def _placed(self, turned: NDArray[np.float64], fraction: float) -> NDArray[np.int16]:
        if not (fraction > 0 and self._none):
            return np.full(len(turned), self._none, np.int16)
        return np.minimum(turned / fraction, self._none).astype(np.int16)

    @property
    def sent(self) -> NDArray[np.int64]:
        """Cycles with a shadow under the active candidate that sends most, ascending.

        They include the cycles with a shadow under every other active candidate.
        """
        most = self._places[max(self._fractions)]
        return self._first + np.flatnonzero(most < self._none)

    def stamps(self, first: int, last: int, active: int) -> NDArray[np.int16]:
        """Return the stamps of some of the cycles where they run under a candidate."""
        alternatives = [i for i in range(len(self._fractions)) if i != active]
        place = self._places[self._fractions[active]]
        stamps: NDArray[np.int16] = np.array([*alternatives, -1], np.int16)[
            place[first - self._first : last - self._first]
        ]
        return stamps
