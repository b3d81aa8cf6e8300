"""Fleet prices: what a whole fleet comes to at given placements, by the kernel.

All cells are played together, each under its present (see `dwell.estimators.presents`), on draws
and phases that are the same whatever the placements are: Φ is a function of these alone. A cell
that has nothing on a shared node meets no other, so that it is played once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.cost import price, tier_nodes
from dwell.estimators.presents import Present, realised
from dwell.estimators.prices import SEED
from dwell.kernels.advance import play
from dwell.kernels.arrays import Arrays, lay_out
from dwell.kernels.codes import EventKind, cell_of, kind_of
from dwell.kernels.random_draws import draw
from dwell.model.frozen import FrozenDict
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS

Floats: TypeAlias = NDArray[np.float64]
#: Candidate of each cell, in their order; None for a cell that is left out.
Placements: TypeAlias = tuple[str | None, ...]

#: Cycles of all cells together that are played of a fleet, and fewest windows of a cell, the first
#: of which settles queues.
CYCLES, FEWEST = 10_000, 3
AS_DECLARED = Present()


@dataclass(frozen=True, slots=True)
class PricedCell:
    """A cell of a fleet, as it is priced.

    Parameters
    ----------
    name : str
    problem : Problem
        With its phase.
    streams : str
        What the names of its random streams begin with.
    scenario : str
        What befalls it beside its present.
    """

    name: str
    problem: Problem
    streams: str = ""
    scenario: str = "baseline"


@dataclass(frozen=True, slots=True)
class CellPrice:
    """What a cell came to among the others, in the mean over windows.

    Parameters
    ----------
    qos : QoS
        As a controller sees it; utilisation of shared nodes is that by all.
    cost : float
        J without switching, and without the utilisation of shared nodes.
    """

    qos: QoS
    cost: float


@dataclass(frozen=True, slots=True)
class FleetPrice:
    """What a fleet came to.

    Parameters
    ----------
    cells : tuple of CellPrice
        By cell; None for one that was left out.
    shared : float
        What the utilisation of shared nodes costs: α·U/U* of each, the mean over cells.
    """

    cells: tuple[CellPrice | None, ...]
    shared: float

    def __repr__(self) -> str:
        return f"<FleetPrice: phi = {self.phi:.4g}>"

    @property
    def costs(self) -> list[float]:
        """J of every cell, without switching and shared nodes."""
        return [cell.cost for cell in self.cells if cell is not None]

    @property
    def phi(self) -> float:
        """Φ."""
        return sum(self.costs) + self.shared


class FleetPrices:
    """Plays a fleet at one placements after another.

    Parameters
    ----------
    cells : sequence of PricedCell
    shared : sequence of str
        Nodes that are one computer for all cells.
    cycles : int
        Cycles of all cells together.
    """

    def __init__(
        self, cells: Sequence[PricedCell], shared: Sequence[str], cycles: int = CYCLES
    ) -> None:
        self.cells, self.shared = tuple(cells), tuple(shared)
        self._windows = [_windows_of(cell.problem, cells, cycles) for cell in self.cells]
        self._declared = [
            draw(
                cell.problem,
                scenario=cell.scenario,
                seed=SEED,
                windows=windows,
                streams=cell.streams,
            )
            for cell, windows in zip(self.cells, self._windows, strict=True)
        ]
        self._index = [
            {name: i for i, name in enumerate(cell.problem.candidates)} for cell in cells
        ]
        self._meets = [
            {name: self.meets(placed) for name, placed in cell.problem.candidates.items()}
            for cell in self.cells
        ]
        self._terms = [CellTerms(cell.problem, self.shared) for cell in self.cells]
        self._presents: list[Present] = [AS_DECLARED] * len(self.cells)
        self._real = list(self._declared)
        self._alone: list[dict[str, CellPrice]] = [{} for _ in self.cells]
        self._known: dict[Placements, FleetPrice] = {}
        self._first: Arrays | None = None

    def __repr__(self) -> str:
        return f"<FleetPrices: {len(self.cells)} cells, shared: {', '.join(self.shared)}>"

    def meets(self, placement: Placement) -> bool:
        """Whether a placement has anything on a shared node."""
        return not set(self.shared).isdisjoint(placement.values())

    def begin(self, presents: Sequence[Present]) -> None:
        """Begin with other presents, one a cell; of a shared node the middle of them holds."""
        agreed = self._agreed(presents)
        for i, (present, before) in enumerate(zip(agreed, self._presents, strict=True)):
            if present is not before:
                self._real[i] = realised(self.cells[i].problem, self._declared[i], present)
                self._presents[i] = present
                self._alone[i].clear()
                self._known.clear()
                self._first = None

    def _agreed(self, presents: Sequence[Present]) -> list[Present]:
        """Presents of which the first one alone says something of shared nodes."""
        agreed = []
        for i, present in enumerate(presents):
            threads, down = dict(present.threads), set(present.down)
            for name in self.shared:
                threads.pop(name, None)
                down.discard(name)
                if i == 0:
                    said = sorted(one.threads.get(name, 0.0) for one in presents)
                    if middle := said[len(said) // 2]:
                        threads[name] = middle
                    if any(name in one.down for one in presents):
                        down.add(name)
            same = threads == present.threads and down == present.down
            agreed.append(
                present
                if same
                else replace(present, threads=FrozenDict(threads), down=frozenset(down))
            )
        return agreed

    def price(self, placements: Placements) -> FleetPrice:
        """Play the fleet at some placements; what was played under these presents is known."""
        known = self._known.get(placements)
        if known is None:
            known = self._known[placements] = self._price(placements)
        return known

    def _price(self, placements: Placements) -> FleetPrice:
        together = [name is not None and self._meets[i][name] for i, name in enumerate(placements)]
        plays = [
            name is not None and (together[i] or name not in self._alone[i])
            for i, name in enumerate(placements)
        ]
        if any(plays):
            arrays = self._played(placements, plays)
        cells: list[CellPrice | None] = []
        for i, name in enumerate(placements):
            if name is None:
                cells.append(None)
            elif plays[i]:
                found = self._price_of(arrays, i)
                if not together[i]:
                    self._alone[i][name] = found
                cells.append(found)
            else:
                cells.append(self._alone[i][name])
        return FleetPrice(tuple(cells), self._shared_cost(cells))

    def _played(self, placements: Placements, plays: Sequence[bool]) -> Arrays:
        if self._first is None:
            laid = zip((cell.problem for cell in self.cells), self._real, strict=True)
            self._first = lay_out(list(laid), shared=self.shared).copy()
        arrays = self._first.copy()
        stamps = np.zeros_like(arrays.tables.stamps)
        for i, name in enumerate(placements):
            if name is not None:
                stamps[i] = self._index[i][name]
        arrays.replace(stamps=stamps)
        # A cell that does not play is never released.
        tables = arrays.tables
        clock = tables.clock[0]
        events = tables.events[: clock["n_events"]]
        kept = [
            kind_of(key) != EventKind.RELEASE or plays[cell_of(key)]
            for key in events["key"].tolist()
        ]
        clock["n_events"] = sum(kept)
        tables.events[: clock["n_events"]] = events[kept]
        play(arrays)
        return arrays

    def _price_of(self, arrays: Arrays, i: int) -> CellPrice:
        problem, tables, terms = self.cells[i].problem, arrays.tables, self._terms[i]
        first, last = 1, self._windows[i]
        seen = tables.seen[i, first:last]
        shares = tables.shares[i, first:last, 0, : len(terms.resources)].mean(axis=0)
        l95_ms, missed = float(seen["l95_ms"].mean()), float(seen["missed"].mean())
        rate, uncut_ms = missed / problem.window_cycles, float(seen["uncut_ms"].mean())
        used = FrozenDict(zip(terms.resources, shares.tolist(), strict=True))
        qos = QoS(l95_ms, rate, used, max(uncut_ms, l95_ms))
        return CellPrice(qos, terms.cost(qos))

    def _shared_cost(self, cells: Sequence[CellPrice | None]) -> float:
        """What the utilisation of shared nodes costs: of each once, the mean over cells."""
        met = [(self._terms[i], cell) for i, cell in enumerate(cells) if cell is not None]
        return sum(terms.shared_cost(cell.qos) for terms, cell in met) / max(len(met), 1)


class CellTerms:
    """Terms of a cell's J: those of its own, and those of shared nodes."""

    def __init__(self, problem: Problem, shared: Sequence[str]) -> None:
        self.resources = tuple(problem.fabric.resources)
        self._objective = objective = problem.objective
        weights, targets = objective.weights, objective.targets
        nodes = tier_nodes(objective)
        factors = {
            "robot": weights.robot / targets.robot,
            "edge": weights.edge / targets.edge,
            "cloud": (weights.cloud or 0.0) / (targets.cloud or 1.0),
        }
        self._capacity = {name: one.capacity for name, one in problem.fabric.resources.items()}
        node_of = {name: one.node for name, one in problem.fabric.resources.items()}
        self._own, self._shared = [], []
        for tier in ("robot", "edge", "cloud"):
            names = getattr(nodes, tier)
            self._own.append([name for name in names if node_of[name] not in shared])
            # Of a shared node, its accelerators with it, the fullest counts.
            for node in shared:
                here = [name for name in names if node_of[name] == node]
                if here:
                    self._shared.append((factors[tier], here))

    def cost(self, qos: QoS) -> float:
        """J without switching and shared nodes."""
        robot, edge, cloud = (self._most(names, qos) for names in self._own)
        rate, objective = qos.violation_rate, self._objective
        return float(price(qos.l95_ms, rate, robot, edge, cloud, 0.0, objective))

    def of_one(self) -> dict[str, float]:
        """What one busy core, or place, of each shared resource would cost the cell."""
        return {
            name: factor / self._capacity[name] for factor, names in self._shared for name in names
        }

    def shared_cost(self, qos: QoS) -> float:
        """What the utilisation of shared nodes would cost the cell."""
        return sum(factor * self._most(names, qos) for factor, names in self._shared)

    def _most(self, names: Sequence[str], qos: QoS) -> float:
        """Utilisation of the fullest of some resources that are known."""
        return max((qos.utilisation.get(name, 0.0) for name in names), default=0.0)


def _windows_of(problem: Problem, cells: Sequence[PricedCell], cycles: int) -> int:
    """Windows that are played of a cell: all cells for about as long."""
    periods_ms = [cell.problem.pipeline.period_ms for cell in cells]
    span_ms = cycles / sum(1 / period_ms for period_ms in periods_ms)
    window_ms = problem.window_cycles * problem.pipeline.period_ms
    return 1 + max(math.ceil(span_ms / window_ms), FEWEST - 1)
