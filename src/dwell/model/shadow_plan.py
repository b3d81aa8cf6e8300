"""Shadow plan: the alternative that also processes a cycle, as a shadow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model.frozen import FrozenDict
from dwell.model.placement import Placement, Replicas

GOLDEN = (np.sqrt(5) - 1) / 2

#: Share of the cycles for each alternative: one number, or a number per active candidate.
ShadowFraction: TypeAlias = float | Mapping[str, float]


def by_candidate(
    fraction: ShadowFraction, candidates: Mapping[str, Placement]
) -> FrozenDict[str, float]:
    """Return the share of each alternative, by the active candidate.

    Replicas whose members are the only other candidates have the share 0.
    """
    given = fraction if isinstance(fraction, Mapping) else dict.fromkeys(candidates, fraction)
    return FrozenDict(
        {
            name: 0.0 if isinstance(placed, Replicas) and not others else given.get(name, 0.0)
            for (name, placed), others in zip(
                candidates.items(), alternatives(candidates), strict=True
            )
        }
    )


def alternatives(candidates: Mapping[str, Placement]) -> list[list[int]]:
    """Return the indices of the candidates of shadows, by active candidate.

    No shadow goes through replicas, nor through a member of replicas in force.
    """
    plain = {i: name for i, name in enumerate(candidates) if candidates[name].second is None}
    return [
        [i for i, name in plain.items() if name not in _members(active, placed)]
        for active, placed in candidates.items()
    ]


def _members(name: str, placed: Placement) -> tuple[str, ...]:
    return placed.members if isinstance(placed, Replicas) else (name,)


def shadow_stamps(
    first: int, last: int, others: Sequence[int], fraction: float
) -> NDArray[np.int16]:
    """Return the candidate that each cycle of a stretch is also sent through, -1 for none.

    Cycle c is sent through the i-th alternative if the fractional part of c times the golden ratio
    lies in [i * fraction, (i + 1) * fraction). So no cycle is sent through two alternatives. Each
    gets its fraction of any stretch within a few cycles, evenly spread and in step with no periodic
    disturbance (H. Weyl, 1916, DOI 10.1007/BF01475864).

    Parameters
    ----------
    first, last : int
        Cycles, the last excluded.
    others : sequence of int
        Indices of the alternatives of the active candidate (see `alternatives`).
    fraction : float
        Share of the cycles that each alternative gets.

    Returns
    -------
    int16 array, shape (last - first,)
    """
    return ShadowPlan(first, last, [fraction], [others]).stamps(first, last, 0)


class ShadowPlan:
    """Which cycles of a stretch are also sent through an alternative (see `shadow_stamps`).

    Parameters
    ----------
    fractions : sequence of float
        Share of the cycles that each alternative gets, by the candidate that is active.
    others : sequence of sequences of int
        Indices of the alternatives, by the candidate that is active (see `alternatives`).
    """

    def __init__(
        self, first: int, last: int, fractions: Sequence[float], others: Sequence[Sequence[int]]
    ) -> None:
        self._first, self._last, self._fractions = first, last, tuple(fractions)
        self._none = max(map(len, others), default=0)
        padded = [[*row, *[-1] * (self._none + 1 - len(row))] for row in others]
        self._others = np.array(padded, np.int16)
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
        """Cycles with a shadow at the largest share and the most alternatives, ascending.

        They include the cycles with a shadow under every active candidate.
        """
        most = self._places[max(self._fractions)]
        return self._first + np.flatnonzero(most < self._none)

    def stamps(self, first: int, last: int, active: int) -> NDArray[np.int16]:
        """Return the stamps of some of the cycles where they run under a candidate."""
        place = self._places[self._fractions[active]]
        stamps: NDArray[np.int16] = self._others[active][
            place[first - self._first : last - self._first]
        ]
        return stamps
