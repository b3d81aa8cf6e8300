"""Fleet rank: which of two prices of a fleet is better, by the fleet's objective."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from dwell.control.neighbours import Rank
from dwell.cost import GAIN_TOLERANCE, exceeds
from dwell.estimators.fleet_prices import PricedCell
from dwell.model.fleet import FleetObjective


class FleetRank:
    """Compares the costs of a fleet.

    Parameters
    ----------
    objective : FleetObjective
        ``sum``: the sum of all costs counts. ``worst``: costs of cells in steps of the least Δ_min,
        sorted from the largest, count first.
    cells : sequence of PricedCell
    """

    def __init__(self, objective: FleetObjective, cells: Sequence[PricedCell]) -> None:
        self.objective, self._count = objective, len(cells)
        least = min(cell.problem.controller.min_improvement for cell in cells)
        self._step = least or GAIN_TOLERANCE

    def first(self, costs: Sequence[float], absent: Collection[int] = ()) -> Rank:
        """Return the part of the rank that counts before the sum.

        Parameters
        ----------
        costs : sequence of float
            J of every cell; then, the cost of shared nodes.
        absent : collection of int
            Cells that do not count.
        """
        if self.objective == "sum":
            return ()
        own = [cost for i, cost in enumerate(costs[: self._count]) if i not in absent]
        steps = (math.ceil((cost - GAIN_TOLERANCE) / self._step) for cost in own)
        return tuple(sorted(map(float, steps), reverse=True))

    def phi(self, costs: Sequence[float], absent: Collection[int] = ()) -> float:
        """Return Φ of costs as those of `first`."""
        return sum(cost for i, cost in enumerate(costs) if i not in absent)

    def of(self, costs: Sequence[float], owed: float = 0.0) -> Rank:
        """Return the rank of costs, of which the smaller one is better."""
        return (*self.first(costs), sum(costs) + owed)

    def is_better(
        self,
        before: Sequence[float],
        after: Sequence[float],
        owed: float,
        absent: Collection[int] = (),
    ) -> bool:
        """Whether costs are better by more than is owed, without those of absent cells."""
        one, other = self.first(before, absent), self.first(after, absent)
        if one != other:
            return other < one
        return exceeds(self.phi(before, absent) - self.phi(after, absent), owed)
