"""Prices of a complete fleet at given placements, simulated with the kernel.

All cells are simulated together, each under its measured conditions (see
`dwell.estimators.present`). Realisations and phases are the same for all placements, so Φ depends
on the placements alone. A cell without tasks on a shared node does not affect other cells and is
simulated once per candidate.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.cell_terms import CellTerms
from dwell.estimators.present import AS_DECLARED, Present
from dwell.estimators.prices import SEED
from dwell.kernels.arrays import Arrays, CellArrays
from dwell.kernels.over_age import due_misses
from dwell.kernels.random_draws import draw
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS
from dwell.model.scenario import Scenario
from dwell.model.stretches import share_over

#: Candidate of each cell, in their order; None for a cell that is left out.
Placements: TypeAlias = tuple[str | None, ...]

#: Simulated cycles of all cells together; fewest windows of a cell, including the first, in which
#: queues settle. Less than half a minute has too few bursts of foreign threads.
CYCLES, FEWEST = 10_000, 9


@dataclass(frozen=True, slots=True)
class PricedCell:
    """A cell of a fleet, with everything that determines its price."""

    name: str
    #: With its phase.
    problem: Problem
    #: Prefix of the names of its random streams.
    streams: str = ""
    #: Scenario that is simulated in addition to the measured conditions.
    scenario: str = "baseline"


@dataclass(frozen=True, slots=True, eq=False)
class CellPrice:
    """QoS and cost of a cell in a simulated fleet, averaged over windows."""

    #: As a controller measures it, without the utilisation of shared nodes.
    qos: QoS
    #: J without switching and without the utilisation of shared nodes.
    cost: float
    #: L95, milliseconds, and V_D of each window, shape (windows, 2).
    windows: Floats


@dataclass(frozen=True, slots=True)
class FleetPrice:
    """Price of a fleet: its cells and its shared nodes."""

    #: Price of each cell; None for a cell that is left out.
    cells: tuple[CellPrice | None, ...]
    #: Cost of the utilisation of shared nodes: α·U/U* of each, averaged over cells.
    shared: float
    #: Utilisation of the shared nodes' resources by all cells, in the windows of the first cell
    #: that uses a shared node.
    used: Mapping[str, float]

    def __repr__(self) -> str:
        return f"<FleetPrice: phi = {self.phi:.4g}>"

    @property
    def costs(self) -> list[float]:
        """J of every cell, without switching and shared nodes."""
        return [cell.cost for cell in self.cells if cell is not None]

    @property
    def parts(self) -> list[float]:
        """J of every cell, then the cost of shared nodes."""
        return [*self.costs, self.shared]

    @property
    def phi(self) -> float:
        """Φ, the sum of `parts`."""
        return sum(self.parts)

    def qos(self, index: int) -> QoS | None:
        """Return the QoS of a cell, with the utilisation of shared nodes."""
        cell = self.cells[index]
        if cell is None:
            return None
        return replace(cell.qos, utilisation=FrozenDict({**cell.qos.utilisation, **self.used}))


class FleetPrices:
    """Simulated prices of a fleet by its placements.

    Each node in `shared` is one computer for all cells. `cycles` is the number of simulated cycles
    of all cells together; `disturbances` are the disturbances of shared nodes.
    """

    def __init__(
        self,
        cells: Sequence[PricedCell],
        shared: Sequence[str],
        cycles: int = CYCLES,
        disturbances: Scenario = (),
    ) -> None:
        self.cells, self.shared = tuple(cells), tuple(shared)
        self._windows = [_windows_of(cell.problem, cells, cycles) for cell in self.cells]
        drawn = [
            draw(
                cell.problem,
                scenario=cell.scenario,
                seed=SEED,
                windows=windows,
                streams=cell.streams,
                shared=self.shared,
                disturbances=disturbances,
            )
            for cell, windows in zip(self.cells, self._windows, strict=True)
        ]
        problems = (cell.problem for cell in self.cells)
        self._player = CandidatePlayer([*zip(problems, drawn, strict=True)], self.shared)
        self._meets = [
            {name: self.meets(placed) for name, placed in cell.problem.candidates.items()}
            for cell in self.cells
        ]
        self._terms = [CellTerms(cell.problem, self.shared) for cell in self.cells]
        self._presents: list[Present] = [AS_DECLARED] * len(self.cells)
        self._absent: frozenset[int] = frozenset()
        self._alone: list[dict[str, CellPrice]] = [{} for _ in self.cells]
        #: Prices under the present conditions, by placements.
        self.known: dict[Placements, FleetPrice] = {}

    def __repr__(self) -> str:
        return f"<FleetPrices: {len(self.cells)} cells, shared: {', '.join(self.shared)}>"

    def meets(self, placement: Placement) -> bool:
        """Whether a placement uses a shared node."""
        return not placement.nodes.isdisjoint(self.shared)

    def begin(self, presents: Sequence[Present], absent: Collection[int] = ()) -> None:
        """Begin with other measured conditions, one per cell.

        A shared node has the median of its foreign threads over cells, and is down if it is down in
        any cell. Cells in `absent` do not count for shared nodes.
        """
        given = zip(presents, self._presents, strict=True)
        changed = [i for i, (present, before) in enumerate(given) if present is not before]
        if not changed and self._absent == frozenset(absent):
            return
        self._presents, self._absent = list(presents), frozenset(absent)
        # The first cell has the conditions of shared nodes.
        new = {i: self._of(i) for i in (0, *changed)}
        if not self._player.measures and any(of != AS_DECLARED for of in new.values()):
            self._player = CandidatePlayer(self._player.cells, self.shared, measures=True)
        if self._player.measures:
            self._player.begin(new)
        for i in new:
            self._alone[i].clear()
        self.known.clear()

    def _of(self, index: int) -> Present:
        """Return a cell's measured conditions; the first cell's also describe shared nodes."""
        present = self._presents[index]
        threads, down = dict(present.threads), set(present.down)
        for name in self.shared:
            threads.pop(name, None)
            down.discard(name)
            if index == 0:
                known = [one for i, one in enumerate(self._presents) if i not in self._absent]
                said = sorted(one.threads.get(name, 0.0) for one in known)
                if said and (middle := said[len(said) // 2]):
                    threads[name] = middle
                if any(name in one.down for one in known):
                    down.add(name)
        return replace(present, threads=FrozenDict(threads), down=frozenset(down))

    def price(self, placements: Placements) -> FleetPrice:
        """Return the price at some placements; simulate it once per measured conditions."""
        if placements not in self.known:
            self.known[placements] = self._price(placements)
        return self.known[placements]

    def _price(self, placements: Placements) -> FleetPrice:
        placed = {i: name for i, name in enumerate(placements) if name is not None}
        there = [i for i, name in placed.items() if self._meets[i][name]]
        new = [i for i, name in placed.items() if name not in self._alone[i]]
        # The first cell on a shared node measures its utilisation; else, the first cell.
        watcher = min(there or placed)
        plays = {watcher, *there, *new}
        arrays = self._player.play({i: placed[i] for i in plays})
        found = {
            i: self._price_of(arrays, i) if i in plays else self._alone[i][name]
            for i, name in placed.items()
        }
        for i in plays.difference(there):
            self._alone[i][placed[i]] = found[i]
        used = {
            name: share
            for name, share in self._used(arrays, watcher).items()
            if name in self._terms[watcher].of_shared
        }
        costs = [self._terms[i].shared_cost(used) for i in placed]
        cells = tuple(map(found.get, range(len(placements))))
        return FleetPrice(cells, sum(costs) / len(costs), used)

    def _price_of(self, arrays: Arrays, i: int) -> CellPrice:
        terms = self._terms[i]
        played = self._player.windows(arrays, i, 1, self._windows[i])
        windows = np.column_stack((played.l95_ms, played.violation_rate))
        l95_ms, rate = windows.mean(axis=0).tolist()
        uncut_ms = float(played.uncut_ms.mean())
        shares = self._used(arrays, i).items()
        used = FrozenDict((name, share) for name, share in shares if name not in terms.of_shared)
        age_ms, per_hour = float(played.age_ms.mean()), float(played.price_per_hour.mean())
        known, misses = (l95_ms, rate, used, max(uncut_ms, l95_ms)), self._misses(arrays, i)
        qos = QoS(*known, age_ms=age_ms, misses=misses, price_per_hour=per_hour)
        return CellPrice(qos, terms.cost(qos), windows)

    def _misses(self, arrays: Arrays, i: int) -> float | None:
        """Return the share of a cell's stretches with more misses than its cap, if it has one."""
        problem, realisation = self._player.cells[i]
        cap, width = problem.objective.caps.misses, problem.window_cycles
        if cap is None:
            return None
        played = problem.pipeline, realisation.release_ns, CellArrays(arrays, i)
        return share_over(due_misses(*played, slice(width, self._windows[i] * width)), cap)

    def _used(self, arrays: Arrays, i: int) -> dict[str, float]:
        """Return the utilisation of each resource by all cells, averaged over a cell's windows."""
        shares = self._player.windows(arrays, i, 1, self._windows[i]).shares[:, 0].mean(axis=0)
        return dict(zip(self._terms[i].resources, shares.tolist(), strict=True))


def _windows_of(problem: Problem, cells: Sequence[PricedCell], cycles: int) -> int:
    """Return the number of simulated windows of a cell, for about the same time in all cells."""
    pipelines = [(cell.problem.pipeline, cell.problem.objective.caps.misses) for cell in cells]
    span_ms = cycles / sum(1 / pipeline.period_ms for pipeline, _ in pipelines)
    # Caps on misses need enough stretches, at the same load of all cells.
    capped = [cap.least_cycles * of.due_interval * of.period_ms for of, cap in pipelines if cap]
    span_ms = max(span_ms, *capped, 0.0)
    window_ms = problem.window_ms
    return 1 + max(math.ceil(span_ms / window_ms), FEWEST - 1)
