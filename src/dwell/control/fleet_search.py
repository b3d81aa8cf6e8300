"""Fleet search: moves of several cells that lower Φ together, with few simulations of the fleet.

A *change* begins when Φ changes for equal placements or a cell moves without the ledger: measured
conditions are new, a guard moves a cell, a cell leaves Φ or returns. Each change allows at most
`PLAYS` simulations of the fleet. When every cell has decided, the search simulates the best
placements by the table of loads, then moves of one and two cells. Cells that cannot move yet are
searched later with the remaining simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import add
from typing import TypeAlias

from dwell.control.fleet_rank import FleetRank
from dwell.control.knapsack import cheapest
from dwell.control.neighbours import Neighbours, Rank
from dwell.control.table_loads import Loads
from dwell.estimators.fleet_prices import FleetPrice, FleetPrices

#: Simulations of the fleet per change, and the number reserved for cells that cannot move yet.
PLAYS, KEPT = 12, 5

Names: TypeAlias = tuple[str, ...]


class FleetSearch:
    """Counts the simulations of a change, and searches when every cell has decided.

    Parameters
    ----------
    prices : FleetPrices
        Simulates the fleet.
    loads : Loads
        Table of loads with the objective's additions for a search.
    rank : FleetRank
    before : int
        Largest number of simulations before the search of a change, for moves of single cells.
    """

    def __init__(self, prices: FleetPrices, loads: Loads, rank: FleetRank, before: int) -> None:
        self._prices, self._loads, self._rank, self._before = prices, loads, rank, before
        self._neighbours = Neighbours(prices.cells, loads)
        self._dwells = [cell.problem.min_dwell_decisions > 0 for cell in prices.cells]
        #: By cell, whether it may move; None for a cell outside the search.
        self._free: list[bool | None] = [None] * len(prices.cells)
        self._plays, self._spent = 0, False
        #: Cells that have decided since the change; None after the search.
        self._decided: set[int] | None = set()
        #: Cells that could not move at the last search.
        self._held: set[int] = set()

    def __repr__(self) -> str:
        return f"<FleetSearch: {self._plays} of {PLAYS} plays>"

    def change(self) -> None:
        """Begin a change; if the search of the last change is still due, the two count as one."""
        if self._decided is None:
            self._decided, self._plays, self._spent = set(), 0, False

    def decide(self, index: int, *, free: bool | None) -> None:
        """Note that a cell decides, and whether it may move (see `is_free`)."""
        self._free[index] = free
        if free and index in self._held:
            self._held.remove(index)
            if self._decided is None and self._plays < PLAYS:
                self._decided = set()
        if self._decided is not None:
            self._decided.add(index)

    def move(self, index: int) -> None:
        """Note that a cell has moved: it is not free while it dwells."""
        if self._dwells[index] and self._free[index]:
            self._free[index] = False

    def spend(self) -> None:
        """Record a move of a single cell: nothing is simulated any more before the search."""
        self._spent = True

    def is_free(self, index: int) -> bool:
        """Whether a cell could move at its last decision, and has not moved since."""
        return bool(self._free[index])

    @property
    def is_open(self) -> bool:
        """Whether the search of a change is still due."""
        return self._decided is not None

    @property
    def is_due(self) -> bool:
        """Whether every cell has decided since the change."""
        return self._decided is not None and len(self._decided) == len(self._free)

    @property
    def _most(self) -> int:
        """Largest number of simulations of a change outside its search."""
        if self.is_open:
            return 0 if self._spent else self._before
        return PLAYS

    @property
    def has_plays(self) -> bool:
        """Whether a simulation outside the search is left."""
        return self._plays < self._most

    def play(self, placements: Names) -> FleetPrice | None:
        """Simulate the fleet outside a search; None if no simulation is left."""
        return self._play(placements, self._most)

    def _play(self, placements: Names, most: int) -> FleetPrice | None:
        if placements not in self._prices.known:
            if self._plays >= most:
                return None
            self._plays += 1
        return self._prices.price(placements)

    def jump(
        self, here: Names, alone: Sequence[Mapping[str, float]], owed: Sequence[Mapping[str, float]]
    ) -> Names:
        """Return the best placements by the table (for parameters see `best`)."""
        return cheapest(self._loads, _costs(alone, owed), here)

    def best(
        self,
        here: Names,
        alone: Sequence[Mapping[str, float]],
        owed: Sequence[Mapping[str, float]],
        rank: Callable[[FleetPrice, float], Rank],
    ) -> Names:
        """Search the best placements; this ends the change.

        Parameters
        ----------
        here : tuple of str
            Current placements.
        alone : sequence of mapping of str to float
            By cell, the cost of each candidate in a search, without other cells.
        owed : sequence of mapping of str to float
            By cell, the least fall of Φ for a move to each permitted candidate.
        rank : callable
            Rank from a price of the fleet and the cost of the moves.
        """
        self._decided = None
        self._held = {i for i, free in enumerate(self._free) if free is False}
        if not any(self._free):
            return here
        most = PLAYS - KEPT if self._held and self._plays < PLAYS - KEPT else PLAYS
        costs = _costs(alone, owed)

        def dues(placements: Names) -> Iterator[float]:
            return (of[name] for of, name in zip(owed, placements, strict=True))

        def ranked(placements: Names) -> Rank | None:
            price = self._play(placements, most)
            return None if price is None else rank(price, sum(dues(placements)))

        def aims(placements: Names) -> list[float]:
            aims = self._rank.aims(self._prices.price(placements))
            return [*map(add, aims, dues(placements))]

        if ranked(here) is None:
            return here
        starts = here, cheapest(self._loads, costs, here)
        return self._neighbours.search(starts, costs, aims, ranked)


def _costs(
    alone: Sequence[Mapping[str, float]], owed: Sequence[Mapping[str, float]]
) -> list[dict[str, float]]:
    return [
        {name: costs[name] + due for name, due in of.items()}
        for costs, of in zip(alone, owed, strict=True)
    ]
