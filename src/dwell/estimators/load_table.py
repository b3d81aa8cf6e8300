"""Table of L95 and V_D of a fleet's candidates by the load of a shared node.

For every kind of cell and every candidate that uses a shared node, the load grows from one cell to
all cells of the fleet: first the cells of the kind, then the others, each on its candidate with the
most work. All levels are simulated with the same realisations. The cell alone serves as a control
variate (DOI 10.1287/opre.30.5.961), because its price is known precisely. The table only proposes
moves; Φ is simulated (see `dwell.estimators.fleet_prices`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dwell.estimators.fleet_prices import FleetPrices, PricedCell
from dwell.estimators.prices import prices_of
from dwell.estimators.remembered import Remembered
from dwell.model.number_arrays import Floats
from dwell.model.problem import Problem
from dwell.model.progress import Progress

#: Simulated cycles of a candidate, all levels together; fewest and most per cell and level.
CYCLES, FEWEST, MOST = 1_000_000, 3_000, 15_000
#: Most levels of a candidate; readers interpolate between levels.
LEVELS = 14
#: Number of fleets whose tables are kept.
KEPT = 8


@dataclass(frozen=True, slots=True, eq=False)
class LoadColumn:
    """A candidate of a kind of cell, by the load of the shared resource that it fills most.

    All arrays have shape (levels,). L95 and V_D are means over the cells of the kind; their
    standard errors come from the differences between windows.
    """

    #: Cores, or places, that all cells keep busy, ascending; the first level has one cell.
    level: Floats
    l95_ms: Floats
    violation_rate: Floats
    l95_error_ms: Floats
    violation_error: Floats

    def __repr__(self) -> str:
        return f"<LoadColumn: {len(self.level)} levels up to {self.level[-1]:.3g} cores>"


class LoadTable:
    """L95 and V_D of the candidates of a fleet by load.

    `cycles` is the number of simulated cycles per cell and level. `progress` is called with the
    number of simulated levels and the number of all levels. Without `with_columns`, nothing is
    simulated.

    `kinds` has the kind of each cell, the index of the first cell that differs only in its phase.
    `work` has, by cell and candidate, the resource of a shared node that it fills most (the CPU or
    a kind of accelerator) and the number of cores, or places, that it keeps busy. `columns` has the
    `LoadColumn` of each kind and candidate.
    """

    def __init__(
        self,
        cells: Sequence[PricedCell],
        shared: Sequence[str],
        *,
        cycles: int | None = None,
        with_columns: bool = True,
        progress: Progress | None = None,
    ) -> None:
        self.cells, self.shared = tuple(cells), tuple(shared)
        self.kinds = kinds_of(cells)
        self.work = tuple(_work(cell.problem, shared) for cell in cells)
        self.columns: dict[tuple[int, str], LoadColumn] = {}
        if not with_columns:
            return
        count = sum(map(bool, self.work))
        self._counts = {1 + (count - 1) * i // (LEVELS - 1) for i in range(LEVELS)}
        if cycles is None:
            cycles = 2 * CYCLES // (len(cells) * len(self._counts))
            cycles = min(max(cycles, FEWEST), MOST)
        plays = FleetPrices(cells, shared, cycles * len(cells))
        asked = [(kind, name) for kind in dict.fromkeys(self.kinds) for name in self.work[kind]]
        done, levels = 0, len(asked) * len(self._counts)
        for group in asked:
            rows = []
            for row in self._levels(plays, *group):
                rows.append(row)
                done += 1
                if progress is not None:
                    progress(done, levels)
            level, l95_ms, rate, l95_error_ms, error = np.array(rows, float).T
            self.columns[group] = LoadColumn(level, l95_ms, rate, l95_error_ms, error)

    def __repr__(self) -> str:
        return f"<LoadTable: {len(self.cells)} cells, {len(self.columns)} candidates of kinds>"

    def _asked(self, index: int, name: str) -> float:
        return self.work[index][name][1]

    def _levels(self, plays: FleetPrices, kind: int, name: str) -> Iterator[tuple[float, ...]]:
        """Yield the rows of a column; the number of cells increases."""
        mine = [i for i, of in enumerate(self.kinds) if of == kind]
        others = [i for i, of in enumerate(self.kinds) if of != kind and self.work[i]]
        placements: list[str | None] = [None] * len(self.cells)
        asked, level = self.work[kind][name][0], 0.0
        price, alone = prices_of(self.cells[kind].problem)[name], None
        known = np.array([price.l95_ms, price.violation_rate])
        known_error = np.array([price.l95_error_ms, price.violation_error])
        for count, i in enumerate(mine + others, 1):
            # Cells of other kinds use their candidate with the most work.
            placed = name if i in mine else max(self.work[i], key=partial(self._asked, i))
            placements[i], (resource, work) = placed, self.work[i][placed]
            level += work if resource == asked else 0.0
            if count not in self._counts:
                continue
            found = plays.price(tuple(placements)).cells
            windows = np.mean([cell.windows for j in mine if (cell := found[j])], axis=0)
            alone = windows if alone is None else alone
            (l95_ms, rate), (l95_error_ms, error) = _controlled(windows, alone, known, known_error)
            yield level, l95_ms, rate, l95_error_ms, error


def _controlled(
    windows: Floats, alone: Floats, known: Floats, known_error: Floats
) -> tuple[Floats, Floats]:
    """Return means over windows with standard errors; the cell alone is the control variate."""
    count = len(windows)
    if count < 3:
        return windows.mean(axis=0), np.full(2, np.inf)
    spread = alone - alone.mean(axis=0)
    squares = (spread * spread).sum(axis=0)
    slope = np.divide((spread * windows).sum(axis=0), squares, where=squares > 0, out=0 * squares)
    rest = windows - slope * alone
    variance = rest.var(axis=0, ddof=2) / count + (slope * known_error) * (slope * known_error)
    return np.maximum(rest.mean(axis=0) + slope * known, 0.0), np.sqrt(variance)


_remembered = Remembered[tuple[tuple[PricedCell, ...], tuple[str, ...]], LoadTable](KEPT)


def load_table(
    cells: Sequence[PricedCell],
    shared: Sequence[str],
    progress: Progress | None = None,
) -> LoadTable:
    """Return the table of a fleet; known tables are not simulated again."""
    asked = tuple(cells), tuple(shared)
    return _remembered.answer(asked, lambda: LoadTable(*asked, progress=progress))


def kinds_of(cells: Sequence[PricedCell]) -> tuple[int, ...]:
    """Return for every cell the first cell of its kind: equal except for phase and name."""
    firsts: dict[Problem, int] = {}
    kinds = [cell.problem.at_phase(0.0) for cell in cells]
    return tuple(firsts.setdefault(kind, i) for i, kind in enumerate(kinds))


def _work(problem: Problem, shared: Sequence[str]) -> Mapping[str, tuple[str, float]]:
    """Return the resource that each candidate with work on shared nodes fills most."""
    prices, resources = prices_of(problem), problem.fabric.resources
    found = {}
    for name in problem.candidates:
        own = prices[name].own
        here = [one for one, of in resources.items() if of.node in shared and own[one] > 0]
        if here:
            most = max(here, key=own.__getitem__)
            found[name] = most, own[most] * resources[most].capacity
    return found
