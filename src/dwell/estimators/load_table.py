"""Load table: what candidates of a fleet's cells come to by how loaded a shared node is.

Of every kind of cell and every candidate that uses a shared node, one cell after another is played
on it together, until all cells of the fleet are there: those of the kind first, the others beside
them on what they have most work with. The table says what would be worth a look; Φ itself is
played (see `dwell.estimators.fleet_prices`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.fleet_prices import FleetCellSpec, FleetPrices
from dwell.estimators.prices import prices_of
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]

#: Cycles of a cell that are played at each level.
CYCLES = 3_000
#: How many fleets are remembered.
KEPT = 8


@dataclass(frozen=True, slots=True, eq=False)
class LoadColumn:
    """A candidate of a kind of cell, by the load of its shared node.

    Parameters
    ----------
    level : float64 array, shape (levels,)
        Cores of the node that all cells there ask for, ascending; the first is that of one cell.
    l95_ms, violation_rate : float64 array, shape (levels,)
        Mean over the cells of the kind.
    l95_error_ms, violation_error : float64 array, shape (levels,)
        Their standard errors.
    cells : int array, shape (levels,)
        How many cells are there.
    """

    level: Floats
    l95_ms: Floats
    violation_rate: Floats
    l95_error_ms: Floats
    violation_error: Floats
    cells: NDArray[np.int64]

    def __repr__(self) -> str:
        return f"<LoadColumn: {len(self.level)} levels up to {self.level[-1]:.3g} cores>"


class LoadTable:
    """What candidates come to by load.

    Parameters
    ----------
    cells : sequence of FleetCellSpec
    shared : sequence of str
    progress : callable
        Told how many of how many levels have been played.

    Attributes
    ----------
    kinds : tuple of int
        Kind of each cell: the first one that is as it is, but for its phase.
    work : tuple of mapping of str to (node, cores)
        By cell and candidate, the shared node that it asks most of, and how much.
    columns : mapping of (kind, candidate) to LoadColumn
    """

    def __init__(
        self,
        cells: Sequence[FleetCellSpec],
        shared: Sequence[str],
        *,
        cycles: int = CYCLES,
        progress: Callable[[int, int], None] = lambda done, of: None,
    ) -> None:
        self.cells, self.shared = tuple(cells), tuple(shared)
        self.kinds = kinds_of(cells)
        self.work = tuple(_work(cell.problem, shared) for cell in cells)
        plays = FleetPrices(cells, shared, cycles * len(cells))
        asked = [
            (kind, name)
            for kind in dict.fromkeys(self.kinds)
            for name in self.work[kind]
        ]
        self.columns: dict[tuple[int, str], LoadColumn] = {}
        for place, (kind, name) in enumerate(asked):
            self.columns[kind, name] = self._column(
                plays,
                kind,
                name,
                lambda done, of, place=place: progress(place * of + done, len(asked) * of),
            )

    def __repr__(self) -> str:
        return f"<LoadTable: {len(self.cells)} cells, {len(self.columns)} candidates of kinds>"

    def _column(
        self, plays: FleetPrices, kind: int, name: str, progress: Callable[[int, int], None]
    ) -> LoadColumn:
        mine = [i for i, of in enumerate(self.kinds) if of == kind]
        others = [i for i, of in enumerate(self.kinds) if of != kind and self.work[i]]
        order = mine + others
        placements: list[str | None] = [None] * len(self.cells)
        node, cores = self.work[kind][name]
        level, rows = 0.0, []
        for count, i in enumerate(order, 1):
            if self.kinds[i] == kind:
                placements[i] = name
                level += cores
            else:
                heaviest = max(self.work[i], key=lambda one: self.work[i][one][1])
                placements[i], (where, more) = heaviest, self.work[i][heaviest]
                level += more if where == node else 0.0
            found = plays.price(tuple(placements)).cells
            seen = [cell for j in mine if (cell := found[j]) is not None]
            l95, rates = (
                np.array([getattr(one.qos, what) for one in seen])
                for what in ("l95_ms", "violation_rate")
            )
            rows.append((level, l95.mean(), rates.mean(), _error(l95), _error(rates), count))
            progress(count, len(order))
        *columns, counts = (np.array(column) for column in zip(*rows, strict=True))
        return LoadColumn(*columns, counts)


_known: dict[tuple[tuple[FleetCellSpec, ...], tuple[str, ...]], LoadTable] = {}


def load_table(
    cells: Sequence[FleetCellSpec],
    shared: Sequence[str],
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> LoadTable:
    """Return the table of a fleet; what was asked before is not played again."""
    asked = tuple(cells), tuple(shared)
    if asked not in _known:
        _known[asked] = LoadTable(*asked, progress=progress)
        for old in list(_known)[:-KEPT]:
            del _known[old]
    return _known[asked]


def kinds_of(cells: Sequence[FleetCellSpec]) -> tuple[int, ...]:
    """Return of every cell the first one of its kind: equal but for phase and name."""
    firsts: dict[object, int] = {}
    return tuple(
        firsts.setdefault(_kind(cell.problem), i) for i, cell in enumerate(cells)
    )


def _kind(problem: Problem) -> object:
    pipeline = problem.pipeline
    tasks, flows = tuple(pipeline.tasks.items()), pipeline.flows
    return problem.name, pipeline.period_ms, pipeline.deadline_ms, tasks, flows, problem.candidates


def _work(problem: Problem, shared: Sequence[str]) -> Mapping[str, tuple[str, float]]:
    """Of every candidate that uses shared nodes, the one that it asks most cores of."""
    prices, nodes = prices_of(problem), problem.fabric.nodes
    found = {}
    for name, placement in problem.candidates.items():
        here = [node for node in shared if node in placement.values()]
        if here:
            cores = {node: prices[name].own[node] * nodes[node].capacity for node in here}
            node = max(here, key=cores.__getitem__)
            found[name] = node, cores[node]
    return found


def _error(values: Floats) -> float:
    """Standard error of the mean over cells; of a single one it is not known."""
    if len(values) < 2:
        return float("inf")
    return float(values.std(ddof=1) / np.sqrt(len(values)))
