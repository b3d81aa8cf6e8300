"""Fleet rank: which of two prices of a fleet is better, by the fleet's objective."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import ClassVar

from dwell.control.neighbours import Rank
from dwell.control.table_loads import UNSERVED, shortfall
from dwell.cost import GAIN_TOLERANCE, exceeds
from dwell.estimators.fleet_prices import CellPrice, FleetPrice, PricedCell
from dwell.estimators.slow_processes import unseen_error
from dwell.model.fleet import FleetObjective
from dwell.model.objective import AIM

#: Distance of V_D from the limit in standard errors at which a cell becomes served or not served.
DEVIATIONS = 2.0


class FleetRank:
    """Compares prices of a fleet by the sum of all costs.

    Parameters
    ----------
    cells : sequence of PricedCell

    Attributes
    ----------
    limit : float, optional
        V_D above which a search adds to the cost of a cell.
    worse : str
        Objection if the part before the sum is worse.
    """

    limit: float | None = None
    worse: ClassVar[str] = ""

    def __init__(self, cells: Sequence[PricedCell]) -> None:
        self.cells = tuple(cells)

    def first(self, price: FleetPrice, absent: Collection[int] = ()) -> Rank:
        """Return the part of the rank that counts before the sum.

        Parameters
        ----------
        absent : collection of int
            Cells that do not count.
        """
        return ()

    def aims(self, price: FleetPrice) -> list[float]:
        """Return the cost of each cell in a search for better placements."""
        return price.costs

    def aim(self, cost: float, violation_rate: float) -> float:
        """Return the cost in a search of a cell without other cells."""
        return cost

    def settle(self, price: FleetPrice) -> None:
        """Record the price at the current placements."""

    def is_promising(
        self, before: Sequence[float], after: Sequence[float], absent: Collection[int] = ()
    ) -> bool:
        """Whether costs by the table are better before the sum counts."""
        return False

    def phi(self, price: FleetPrice, absent: Collection[int] = ()) -> float:
        """Return Φ without the costs of absent cells."""
        return sum(cost for i, cost in enumerate(price.parts) if i not in absent)

    def of(self, price: FleetPrice, owed: float = 0.0, absent: Collection[int] = ()) -> Rank:
        """Return the rank of a price without absent cells; the smaller one is better."""
        return (*self.first(price, absent), self.phi(price, absent) + owed)

    def objection(
        self,
        before: FleetPrice,
        after: FleetPrice,
        owed: float,
        absent: Collection[int] = (),
    ) -> str | None:
        """Return why a price is not better by more than is owed, without absent cells; or None."""
        one, other = self.first(before, absent), self.first(after, absent)
        if one != other:
            return self.worse if other > one else None
        falls = self.phi(before, absent) - self.phi(after, absent)
        if exceeds(falls, owed):
            return None
        if falls < 0:
            return f"ledger: Φ would rise by {-falls:.3g}"
        return f"ledger: Φ would fall by {falls:.3g}, {owed:.3g} is owed"


class WorstFirst(FleetRank):
    """Compares costs in steps of the least Δ_min, sorted from the largest; then the sum."""

    worse = "ledger: the worst cells would cost more"

    def __init__(self, cells: Sequence[PricedCell]) -> None:
        super().__init__(cells)
        least = min(cell.problem.controller.min_improvement for cell in cells)
        self._step = least or GAIN_TOLERANCE

    def first(self, price: FleetPrice, absent: Collection[int] = ()) -> Rank:
        """Return the steps of all cells."""
        return self._steps(price.parts, absent)

    def is_promising(
        self, before: Sequence[float], after: Sequence[float], absent: Collection[int] = ()
    ) -> bool:
        """Whether the worst cells are better."""
        return self._steps(after, absent) < self._steps(before, absent)

    def _steps(self, costs: Sequence[float], absent: Collection[int]) -> Rank:
        own = [cost for i, cost in enumerate(costs[: len(self.cells)]) if i not in absent]
        steps = (math.ceil((cost - GAIN_TOLERANCE) / self._step) for cost in own)
        return tuple(sorted(map(float, steps), reverse=True))


class MostServed(FleetRank):
    """Compares how many cells are served; then the sum.

    A cell is served if its V_D is more than two standard errors below the limit, and not served if
    it is more than two above. In between, the last result applies; the first one uses V_D alone.
    """

    worse = "ledger: fewer cells would be served"

    def __init__(self, cells: Sequence[PricedCell], limit: float) -> None:
        super().__init__(cells)
        self.limit: float = limit
        self._served: list[bool | None] = [None] * len(self.cells)
        self._due_cycles = [cell.problem.due_cycles for cell in self.cells]

    def first(self, price: FleetPrice, absent: Collection[int] = ()) -> Rank:
        """Return minus the number of cells that are served."""
        return (-float(sum(of for i, of in enumerate(self.served(price)) if i not in absent)),)

    def served(self, price: FleetPrice) -> list[bool]:
        """Return which cells are served."""
        return [cell is not None and self._is_served(i, cell) for i, cell in enumerate(price.cells)]

    def _is_served(self, index: int, cell: CellPrice) -> bool:
        before, rate, count = self._served[index], cell.qos.violation_rate, len(cell.windows)
        error = max(
            float(cell.windows[:, 1].std()) / math.sqrt(count - 1),
            unseen_error(rate, count * self._due_cycles[index]),
        )
        if before is None or abs(rate - self.limit) > DEVIATIONS * error:
            return rate <= self.limit
        return before

    def settle(self, price: FleetPrice) -> None:
        """Record which cells are served."""
        self._served = [*self.served(price)]

    def aims(self, price: FleetPrice) -> list[float]:
        """Return the costs, with `UNSERVED` for each cell that is not served."""
        served = zip(price.costs, self.served(price), strict=True)
        return [cost + UNSERVED * (not is_served) for cost, is_served in served]

    def aim(self, cost: float, violation_rate: float) -> float:
        """Return the cost with its `shortfall`."""
        return cost + shortfall(violation_rate, self.limit)

    def is_promising(
        self, before: Sequence[float], after: Sequence[float], absent: Collection[int] = ()
    ) -> bool:
        """Whether the table predicts more served cells."""
        return sum(after) < sum(before)


def fleet_rank(
    objective: FleetObjective, cells: Sequence[PricedCell], limit: float | None = None
) -> FleetRank:
    """Return the rank of an objective.

    Parameters
    ----------
    limit : float, optional
        Largest V_D of a cell that is served, with the objective ``served``.
    """
    if objective == "sum":
        return FleetRank(cells)
    return WorstFirst(cells) if objective == "worst" else MostServed(cells, limit or AIM)
