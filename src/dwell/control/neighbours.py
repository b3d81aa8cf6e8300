"""Neighbours: placements of a fleet that differ in one cell or two, most promising first."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias

from dwell.control.table_loads import AtLoad, Loads, moved
from dwell.estimators.fleet_prices import PricedCell

#: Value of placements; the smaller one is better.
Rank: TypeAlias = "tuple[float, ...]"

#: Moves of each kind that are combined in pairs.
PAIRED = 16


class _Move(NamedTuple):
    """A cell takes another candidate.

    Parameters
    ----------
    rise : float
        Predicted change of Φ.
    own : float
        Least change of the cell's own cost, if it meets no other cell.
    cell, name : int, str
    joins : int
        Change of the number of cells on shared nodes.
    at : AtLoad
        Loads after it.
    """

    rise: float
    own: float
    cell: int
    name: str
    joins: int
    at: AtLoad


class Neighbours:
    """Predicts Φ of placements near simulated placements.

    The table of loads ignores which cells meet. Two corrections account for it. When a cell moves,
    its difference between simulated and tabulated cost disappears. When a cell joins others of its
    period, its predicted wait increases or decreases with the nearness of their phases.
    """

    def __init__(self, cells: Sequence[PricedCell], loads: Loads) -> None:
        self._loads = loads
        self._nearness = [[_nearness(one, other) for other in cells] for one in cells]

    def of(
        self,
        placements: Sequence[str],
        costs: Sequence[Mapping[str, float]],
        played: Sequence[float],
    ) -> Iterator[tuple[str, ...]]:
        """Yield placements after moves of one and two cells, most promising first.

        Moves that add, keep or remove cells on shared nodes take turns. Moves that cannot pay off
        even without any waiting are left out.

        Parameters
        ----------
        costs : sequence of mapping of str to float
            By cell, cost of each permitted candidate without other cells.
        played : sequence of float
            Simulated cost of each cell at these placements.
        """
        loads, at = self._loads, self._loads.at(placements)
        rest = [
            cost - known
            for cost, known in zip(played, loads.costs(placements, costs), strict=False)
        ]
        moves = [
            self._moved(placements, at, costs, i, name, played[i], rest[i])
            for i, of in enumerate(costs)
            for name in of
            if name != placements[i]
        ]
        by_kind: defaultdict[int, list[tuple[float, tuple[str, ...]]]] = defaultdict(list)
        best: defaultdict[int, list[_Move]] = defaultdict(list)
        # A cell that leaves a shared node saves the others at most their waiting.
        relief = sum(
            max(cost - costs[i][name], 0.0)
            for i, (cost, name) in enumerate(zip(played, placements, strict=True))
            if loads.resource(i, name) is not None
        )

        def may_pay(*some: _Move) -> bool:
            leaves = any(loads.resource(one.cell, placements[one.cell]) for one in some)
            return sum(one.own for one in some) < (relief if leaves else 0.0)

        for move in sorted(moves, key=lambda move: move.rise):
            if may_pay(move):
                by_kind[move.joins].append((move.rise, _with(placements, move)))
            best[move.joins].append(move)
        few = [move for some in best.values() for move in some[:PAIRED]]
        for one, other in itertools.combinations(few, 2):
            if one.cell != other.cell and may_pay(one, other):
                rise = self._of_two(placements, at, one, other)
                joins = max(-1, min(one.joins + other.joins, 1))
                by_kind[joins].append((rise, _with(placements, one, other)))
        kinds = sorted(map(sorted, by_kind.values()))
        for turn in itertools.zip_longest(*kinds):
            yield from (found[1] for found in turn if found is not None)

    def search(
        self,
        starts: Iterable[tuple[str, ...]],
        costs: Sequence[Mapping[str, float]],
        aims: Callable[[tuple[str, ...]], Sequence[float]],
        rank: Callable[[tuple[str, ...]], Rank | None],
    ) -> tuple[str, ...]:
        """Search from the best start until no neighbour is better or `rank` returns None.

        Parameters
        ----------
        costs
            As in `of`.
        aims : callable
            Simulated cost of each cell at ranked placements.
        rank : callable
            Simulated rank of placements; None if no simulation is left.
        """
        best = min(starts, key=lambda one: rank(one) or (math.inf,))
        least = rank(best)
        while least is not None:
            for one in self.of(best, costs, aims(best)):
                found = rank(one)
                if found is None:
                    return best
                if found < least:
                    best, least = one, found
                    break
            else:
                return best
        return best

    def _moved(
        self,
        placements: Sequence[str],
        at: AtLoad,
        costs: Sequence[Mapping[str, float]],
        i: int,
        name: str,
        played: float,
        rest: float,
    ) -> _Move:
        loads, here = self._loads, placements[i]
        rise = costs[i][name] - costs[i][here] + loads.rise(at, i, here, name) - rest
        after = loads.at(moved(placements, i, name))
        resource = loads.resource(i, name)
        if resource is not None:
            near = [
                self._nearness[i][j]
                for j, other in enumerate(placements)
                if j != i and loads.resource(j, other) == resource
            ]
            wait = loads.wait(i, name, after.loads[resource])
            rise += wait * sum(near) / max(len(near), 1)
        joins = (resource is not None) - (loads.resource(i, here) is not None)
        return _Move(rise, costs[i][name] - played, i, name, joins, after)

    def _of_two(self, placements: Sequence[str], at: AtLoad, one: _Move, other: _Move) -> float:
        """Return the predicted change of Φ by two moves; the first changes the second's load."""
        loads, here = self._loads, placements[other.cell]
        alone = loads.rise(at, other.cell, here, other.name)
        together = loads.rise(one.at, other.cell, here, other.name)
        return one.rise + other.rise + together - alone


def _with(placements: Sequence[str], *moves: _Move) -> tuple[str, ...]:
    for move in moves:
        placements = moved(placements, move.cell, move.name)
    return tuple(placements)


def _nearness(one: PricedCell, other: PricedCell) -> float:
    """Return 1 for equal phases, -1 for opposite phases, 0 for other periods."""
    a, b = one.problem.pipeline, other.problem.pipeline
    if a.period_ms != b.period_ms:
        return 0.0
    apart = abs(a.first_release_ms - b.first_release_ms) % a.period_ms / a.period_ms
    return 1.0 - 4.0 * min(apart, 1.0 - apart)
