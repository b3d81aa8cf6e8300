"""Ledger: who of a fleet is where, and which move is good for all.

Closes are looked at one after another. What cells know of themselves (their *presents*, see
`dwell.estimators.presents`) and where they are is frozen from one close to the next; a cell that
may move is asked for if something of it is new. A table of loads says which of its candidates are
worth a look; then the fleet is played as it is and as it would be, on the same draws. The move is
made if

* Φ as played falls by more than the mover owes, Δ_min + α_S·S, and
* no cell comes over a cap that it was under.

A move counts from then on, before any window shows it. Under given presents Φ is a function of the
placements alone, and every move lowers it by more than the least Δ_min: the number of moves is
finite, whatever the table says, and at most (Φ at first − least Φ) / least Δ_min.

A cell whose windows are not what was played for it leaves Φ until they are again (see
`dwell.control.watchdog`). Its load stays where it is; the proof holds from one such change to the
next.

The objective decides which of two prices is better (see `dwell.control.fleet_rank`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dwell.control.coordination import Coordination, Verdict, Wish
from dwell.control.fleet_rank import fleet_rank
from dwell.control.table_loads import Loads, moved
from dwell.control.watchdog import (
    NOT_AS_PLAYED,
    WAS_NOT_AS_PLAYED,
    Doubts,
    Expected,
    SeenWindow,
    Watchdog,
)
from dwell.cost import exceeds, excess, hamming
from dwell.estimators.fleet_prices import CellTerms, FleetPrice, FleetPrices, PricedCell
from dwell.estimators.load_table import LoadTable, load_table
from dwell.estimators.presents import Present
from dwell.estimators.prices import prices_of
from dwell.estimators.protocol import CellEstimator
from dwell.model import Caps, Decision, QoS
from dwell.model.fleet import FleetObjective
from dwell.model.progress import Progress

__all__ = ["FleetLedger", "Loads", "PricedCell", "Seat"]

#: So many of a cell's candidates are played at a close, those that the table thinks best of.
LOOKS = 2


class FleetLedger:
    """Knows where all cells of a fleet are, and lets them move where that is good for all.

    Parameters
    ----------
    cells : sequence of PricedCell
    shared : sequence of str
        Nodes that are one computer for all cells.
    objective : {"sum", "worst", "served"}
    table : LoadTable, optional
        Proposes moves; made of `tabled` where None.
    tabled : sequence of PricedCell, optional
        Cells at the phases that the table is made for; `cells` where None.
    prices : FleetPrices, optional
        What plays.
    progress : callable, optional
        Told how many of how many levels of the table have been played.
    limit : float, optional
        Largest V_D of a cell that is served, with the objective ``served``.

    Attributes
    ----------
    placements : list of str
        Where every cell is.
    presents : list of Present
        What each cell knows of itself.
    alone : list of mapping of str to float
        By cell and candidate, J where no other cell is there, without switching and shared nodes.
    loads : Loads
        The table, added up.
    round : int
        Number of the round: of the closes since the fleet was last played.
    absent : set of int
        Cells that have left Φ, since their windows are not what was played (see `watch`).
    """

    def __init__(
        self,
        cells: Sequence[PricedCell],
        shared: Sequence[str],
        objective: FleetObjective = "sum",
        *,
        table: LoadTable | None = None,
        tabled: Sequence[PricedCell] | None = None,
        prices: FleetPrices | None = None,
        progress: Progress | None = None,
        limit: float | None = None,
    ) -> None:
        self.cells, self.shared, self.objective = tuple(cells), tuple(shared), objective
        problems = [cell.problem for cell in cells]
        self.table = table or load_table(tabled or cells, shared, progress)
        self.prices = prices or FleetPrices(cells, shared)
        self.loads = Loads(self.table)
        self.rank = fleet_rank(objective, cells, limit)
        self._aimed = Loads(self.table, self.rank.limit)
        self._terms = [CellTerms(problem, shared) for problem in problems]
        self.placements = [problem.initial for problem in problems]
        self._at = self.loads.at(self.placements)
        self._declared = [prices_of(problem) for problem in problems]
        self.alone: list[dict[str, float]] = [{} for _ in problems]
        #: The same, as the objective has it in a search.
        self._aims: list[dict[str, float]] = [{} for _ in problems]
        for i, prices_alone in enumerate(self._declared):
            self._note_alone(i, {name: price.qos for name, price in prices_alone.items()})
        self.presents = [Present()] * len(self.cells)
        self._revisions = [-1] * len(self.cells)
        self._has_caps = any(problem.objective.caps != Caps() for problem in problems)
        names = sorted(cell.name for cell in cells)
        #: Place of each cell where they take turns, and how long one is.
        self.order = [names.index(cell.name) for cell in cells]
        self.turn_ns = max(round(problem.window_ms * 1e6) for problem in problems)
        self.absent: set[int] = set()
        self._watchdogs = [Watchdog(problem.window_cycles) for problem in problems]
        #: Candidates of each cell that are doubted at its last close.
        self._doubted: list[set[str]] = [set()] * len(self.cells)
        #: How often Φ has become another function; and of each cell what it was when it was last
        #: looked at.
        self._changes = 0
        #: How often any cell has moved.
        self._moves = 0
        self._looked = [(-1, -1)] * len(self.cells)
        self._refusals: list[dict[str, str]] = [{} for _ in self.cells]
        self.round = 0

    def __repr__(self) -> str:
        return f"<FleetLedger of {len(self.cells)} cells: round {self.round}>"

    def place(self, index: int, name: str) -> None:
        """Take note of where a cell is."""
        if name != self.placements[index]:
            self.placements[index] = name
            self._at = self.loads.at(self.placements)
            self._moves += 1
            self._changes += 1

    def watch(self, index: int, seen: SeenWindow, doubts: Doubts, estimator: CellEstimator) -> bool:
        """Compare a window with what was played; returns whether that is what was seen.

        A cell whose estimator learns leaves Φ when it is not, and comes back when it is again. As
        long as it is away, its estimator takes all load of shared nodes for foreign.
        """
        dog, name = self._watchdogs[index], self.placements[index]
        if dog.is_due(seen, self._moves):
            self._begin()
            cell = self.prices.price(tuple(self.placements)).cells[index]
            cycles = self.cells[index].problem.window_cycles
            if cell is not None:
                played = Expected.of(cell.windows, self._declared[index][name], cycles)
                if dog.compare(seen, played) and estimator.learns:
                    self.absent ^= {index}
                    self._changes += 1
                    estimator.share(self.shared, len(self.cells), known=dog.trusts)
                    doubts.change(name, seen.last_cycle, trusts=dog.trusts)
        doubted = doubts.at(seen.last_cycle)
        self._changes += doubted != self._doubted[index]
        self._doubted[index] = doubted
        return dog.trusts

    def _begin(self) -> None:
        """Have what plays know the presents; absent cells do not speak of shared nodes."""
        self.prices.begin(self.presents, self.absent)

    def note(self, index: int, estimates: Mapping[str, QoS], estimator: CellEstimator) -> None:
        """Take note of what a cell knows of itself, where that is new."""
        revision = estimator.revision
        if revision == self._revisions[index]:
            return
        self._revisions[index] = revision
        self._note_alone(index, estimates)
        if estimator.present is not None:
            self.presents[index] = estimator.present

    def _note_alone(self, index: int, estimates: Mapping[str, QoS]) -> None:
        costs = {name: self._terms[index].cost(qos) for name, qos in estimates.items()}
        self.alone[index] = costs
        self._aims[index] = {
            name: self.rank.aim(costs[name], qos.violation_rate) for name, qos in estimates.items()
        }

    def consider(self, index: int, decision: Decision, *, by_price: bool) -> Verdict:
        """Say where a cell is to be that its policy has decided on (see `Wish`)."""
        wished = decision.name
        if index in self.absent:
            return self._outside(index, decision)
        state = self._changes, self._revisions[index]
        if self._looked[index] != state:
            self._looked[index] = state
            self._refusals[index] = {}
        elif not decision.migrated or wished in self._refusals[index]:
            return self._refused(index, wished)
        if not by_price:
            names = [wished] if decision.migrated else []
        elif decision.costs and decision.reason != "dwell":
            names = self._promising(index)
        else:
            # It may be looked at again as soon as it is free to move.
            self._looked[index] = -1, -1
            return self._refused(index, wished)
        asked: tuple[float, float] | None = None
        for name in names:
            if name in self._doubted[index]:
                self._refusals[index][name] = WAS_NOT_AS_PLAYED
                continue
            before, after = self._played(index, name)
            asked = self._phi(before), self._phi(after)
            why = self._objection(index, name, before, after)
            if why is None:
                verdict = Verdict(name, None, (*asked, self.round))
                self.rank.settle(after)
                self.round += 1
                self.place(index, name)
                return verdict
            self._refusals[index][name] = why
        verdict = self._refused(index, wished, asked)
        self.round += asked is not None
        return verdict

    def _outside(self, index: int, decision: Decision) -> Verdict:
        """Let a cell that has left Φ do as it likes, except take more of a shared node."""
        candidates, here = self.cells[index].problem.candidates, self.placements[index]
        before, after = candidates[here], candidates[decision.name]
        if any(node in self.shared and before[task] != node for task, node in after.items()):
            return Verdict(here, NOT_AS_PLAYED, (None, None, self.round))
        self.place(index, decision.name)
        return Verdict(decision.name, None, (None, None, self.round))

    def _refused(
        self, index: int, wished: str, asked: tuple[float, float] | None = None
    ) -> Verdict:
        here = self.placements[index]
        why = None
        if wished != here:
            why = self._refusals[index].get(wished, "ledger: Φ would not fall")
        return Verdict(here, why, (*(asked or (None, None)), self.round))

    def _promising(self, index: int) -> list[str]:
        """Candidates by which the table's Φ falls by more than is owed; best first."""
        found, here = [], self.placements[index]
        at_stake = self.alone[index][here] + self._beyond_table(index)
        for name in self.cells[index].problem.candidates:
            if name != here:
                rise = self.loads.rise(self._at, index, here, name)
                rise += self.alone[index][name] - at_stake
                helps = self._helps_first(index, name)
                if helps or exceeds(-rise, self.owed(index, name)):
                    found.append((not (helps and self.rank.limit), rise, name))
        return [name for *_, name in sorted(found)[:LOOKS]]

    def _beyond_table(self, index: int) -> float:
        """J of a cell as played, less what the table says, where foreign load is on shared nodes.

        The table knows no foreign load beyond the declared: it takes such a node for idle.
        """
        known = [one for i, one in enumerate(self.presents) if i not in self.absent]
        if not any(one.threads.keys() & self.shared for one in known):
            return 0.0
        self._begin()
        cell, here = self.prices.price(tuple(self.placements)).cells[index], self.placements[index]
        load = self._at.loads.get(self.loads.resource(index, here) or "", 0.0)
        says = self.alone[index][here] + self.loads.wait(index, here, load)
        return 0.0 if cell is None else cell.cost - says

    def _helps_first(self, index: int, name: str) -> bool:
        """Whether the table expects a better rank before the sum counts."""
        if self.objective == "sum":
            return False
        before = self._aimed.costs(self.placements, self._aims)
        after = self._aimed.costs(moved(self.placements, index, name), self._aims)
        return self.rank.is_promising(before, after, self.absent)

    def owed(self, index: int, name: str) -> float:
        """What Φ has to fall by at least for a cell to move: Δ_min + α_S·S."""
        problem = self.cells[index].problem
        here, there = problem.candidates[self.placements[index]], problem.candidates[name]
        weight = problem.objective.weights.switching
        return problem.controller.min_improvement + weight * hamming(there, here)

    def _played(self, index: int, name: str) -> tuple[FleetPrice, FleetPrice]:
        self._begin()
        before = self.prices.price(tuple(self.placements))
        self.rank.settle(before)
        return before, self.prices.price(moved(self.placements, index, name))

    def _objection(
        self, index: int, name: str, before: FleetPrice, after: FleetPrice
    ) -> str | None:
        """Why a cell must not move, by what has been played."""
        why = self.rank.objection(before, after, self.owed(index, name), self.absent)
        if why is not None:
            return why
        if self._has_caps:
            for i, cell in enumerate(self.cells):
                if i in self.absent:
                    continue
                caps, one, other = cell.problem.objective, before.qos(i), after.qos(i)
                if one and other and excess(one, caps) <= 0 < excess(other, caps):
                    return f"cap of {cell.name}"
        return None

    def _phi(self, played: FleetPrice) -> float:
        """Φ of the cells that are in it."""
        return self.rank.phi(played, self.absent)


class Seat(Coordination):
    """A cell's place in a ledger."""

    def __init__(self, ledger: FleetLedger, index: int) -> None:
        self.ledger, self._index = ledger, index

    def __repr__(self) -> str:
        return f"<Seat of {self.ledger.cells[self._index].name}>"

    @property
    def knows_others(self) -> bool:
        """Whether the cell is in Φ."""
        return self._index not in self.ledger.absent

    def meet(self, estimator: CellEstimator) -> None:
        """Have the estimator take notice of the fleet."""
        if len(self.ledger.cells) > 1:
            estimator.share(self.ledger.shared, len(self.ledger.cells))

    def turns(self, release_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether it is the cell's turn at each cycle: one window after another, by name."""
        ledger = self.ledger
        turn = release_ns // ledger.turn_ns % len(ledger.cells)
        return np.equal(turn, ledger.order[self._index])

    def place(self, name: str) -> None:
        """Take note of where the cell is."""
        self.ledger.place(self._index, name)

    def consider(self, wish: Wish) -> Verdict:
        """Have the ledger look at what the policy has decided."""
        self.ledger.place(self._index, wish.incumbent)
        self.ledger.note(self._index, wish.estimates, wish.estimator)
        is_as_played = True
        if wish.seen is not None and wish.doubts is not None and len(self.ledger.cells) > 1:
            asked = wish.seen, wish.doubts, wish.estimator
            is_as_played = self.ledger.watch(self._index, *asked)
        verdict = self.ledger.consider(self._index, wish.decision, by_price=wish.by_price)
        if is_as_played or verdict.why or verdict.name != wish.incumbent:
            return verdict
        return verdict._replace(why=NOT_AS_PLAYED)
