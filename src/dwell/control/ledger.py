"""Ledger: the placements of a fleet's cells, and the moves that are good for all.

The ledger considers the decisions of the cells one after another. The *presents* of the cells
(their measured conditions, see `dwell.estimators.present`) and the placements are constant from
one decision to the next. If anything has changed for a cell that may move, a table of loads
proposes candidates, and the kernel simulates the fleet without and with the move on the same
samples. The cell moves if

* the simulated Φ falls by more than the cost of the move, Δ_min + α_S·S, and
* no cell exceeds a cap that it kept before.

When every cell has decided since a change, the ledger searches moves of several cells (see
`dwell.control.fleet_search`). The best placements become a *set* of moves if Φ falls by more than
the cost of all moves. Each member moves at its next decision, and the search waits until all have
moved.

A move counts at once, before a window with it has ended. Under constant conditions Φ depends only
on the placements, and every move or set lowers it by more than the smallest Δ_min. Their number is
therefore finite with any table, and at most (first Φ − smallest Φ) / smallest Δ_min.

A cell whose windows contradict the simulation leaves Φ until they agree again (see
`dwell.control.watchdog`). Its load still counts. The bound on the number of moves applies between
two such changes.

The objective decides which of two prices is better (see `dwell.control.fleet_rank`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dwell.control.coordination import NOT_ASKED, Asked, Coordination, Verdict, Wish
from dwell.control.fleet_rank import fleet_rank
from dwell.control.fleet_search import FleetSearch
from dwell.control.neighbours import Rank
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
from dwell.estimators.cell_terms import CellTerms
from dwell.estimators.fleet_prices import CellPrice, FleetPrice, FleetPrices, PricedCell
from dwell.estimators.load_table import LoadTable, load_table
from dwell.estimators.present import Present
from dwell.estimators.prices import prices_of
from dwell.estimators.protocol import CellEstimator
from dwell.model import Caps, Decision, QoS
from dwell.model.fleet import FleetObjective
from dwell.model.progress import Progress

__all__ = ["FleetLedger", "Loads", "PricedCell", "Seat"]

#: Number of a cell's candidates to simulate per decision, best by the table.
LOOKS = 2
SET_UNDER_WAY = "ledger: Φ would change, a set is under way"


class FleetLedger:
    """Placements of all cells of a fleet, and permission for moves that help the whole fleet.

    Parameters
    ----------
    cells : sequence of PricedCell
    shared : sequence of str
        Nodes that all cells share.
    objective : {"sum", "worst", "served"}
    table : LoadTable, optional
        Table that proposes moves; None to compute it from `tabled`.
    tabled : sequence of PricedCell, optional
        Cells with the phases for the table; None for `cells`.
    prices : FleetPrices, optional
        Simulates the fleet.
    progress : callable, optional
        Called with the number of simulated levels of the table, and their total.
    limit : float, optional
        Largest V_D of a cell that is served, with the objective ``served``.
    moves : bool
        Whether a cell may move; without moves the table has no columns.

    Attributes
    ----------
    placements : list of str
        Placement of every cell.
    presents : list of Present
        Measured conditions of every cell.
    alone : list of mapping of str to float
        By cell and candidate, J without other cells, switching and shared nodes.
    loads : Loads
        Sums over the table.
    round : int
        Number of the round; a new round begins after a simulation of the fleet.
    absent : set of int
        Cells that have left Φ, because their windows contradict the simulation (see `watch`).
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
        moves: bool = True,
    ) -> None:
        self.cells, self.shared, self.objective = tuple(cells), tuple(shared), objective
        problems = [cell.problem for cell in cells]
        if table is None and not moves:
            table = LoadTable(cells, shared, with_columns=False)
        self.table = table or load_table(tabled or cells, shared, progress)
        self.prices = prices or FleetPrices(cells, shared)
        self.loads = Loads(self.table)
        self.rank = fleet_rank(objective, cells, limit)
        self._aimed = self.loads
        if self.rank.limit is not None:
            self._aimed = Loads(self.table, self.rank.limit)
        self._terms = [CellTerms(problem, shared) for problem in problems]
        self.placements = [problem.initial for problem in problems]
        self._at = self.loads.at(self.placements)
        self._declared = [prices_of(problem) for problem in problems]
        self.alone: list[dict[str, float]] = [{} for _ in problems]
        #: `alone` with the objective's additions for a search.
        self._aims: list[dict[str, float]] = [{} for _ in problems]
        for i, prices_alone in enumerate(self._declared):
            self._note_alone(i, {name: price.qos for name, price in prices_alone.items()})
        self.presents = [Present()] * len(self.cells)
        self._revisions = [-1] * len(self.cells)
        self._has_caps = any(problem.objective.caps != Caps() for problem in problems)
        names = sorted(cell.name for cell in cells)
        #: Position of each cell in the order of turns, and the length of a turn.
        self.order = [names.index(cell.name) for cell in cells]
        self.turn_ns = max(round(problem.window_ms * 1e6) for problem in problems)
        self.absent: set[int] = set()
        self._watchdogs = [Watchdog(problem.window_cycles) for problem in problems]
        self._expected: list[tuple[CellPrice, Expected] | None] = [None] * len(cells)
        #: Doubted candidates of each cell at the end of its last window.
        self._doubted: list[set[str]] = [set()] * len(self.cells)
        #: Number of changes of placements, of doubts and of the cells in Φ.
        self._changes = 0
        #: Number of moves of all cells.
        self._moves = 0
        self._looked = [(-1, -1)] * len(self.cells)
        self._refusals: list[dict[str, str]] = [{} for _ in self.cells]
        self.round = 0
        self._search = FleetSearch(self.prices, self._aimed, self.rank, 1 + LOOKS)
        #: Pending moves of a set, and the Φ and round for their rows.
        self._set: dict[int, str] = {}
        self._asked: Asked = NOT_ASKED

    def __repr__(self) -> str:
        return f"<FleetLedger of {len(self.cells)} cells: round {self.round}>"

    def place(self, index: int, name: str) -> None:
        """Record the placement of a cell; a change begins if another was recorded."""
        if name != self.placements[index]:
            self._put(index, name)
            self._change()

    def keep(self, index: int, name: str) -> None:
        """Record that a cell is still on its guard's fallback, because its move is not proven."""
        if name != self.placements[index]:
            self._put(index, name)

    def _put(self, index: int, name: str) -> None:
        self.placements[index] = name
        self._at = self.loads.at(self.placements)
        self._moves += 1
        self._changes += 1
        self._search.move(index)

    def _change(self) -> None:
        """Drop the set, and begin a change."""
        self.round += bool(self._set)
        self._set.clear()
        self._search.change()

    def watch(self, index: int, seen: SeenWindow, doubts: Doubts, estimator: CellEstimator) -> bool:
        """Compare a window with the simulation, and return whether the cell's model is trusted.

        A cell whose estimator learns leaves Φ while its model is not trusted. During this time its
        estimator treats the load of the other cells on shared nodes as foreign.
        """
        dog, name = self._watchdogs[index], self.placements[index]
        if dog.is_due(seen, self._moves):
            self._begin()
            price = self._search.play(tuple(self.placements))
            cell = None if price is None else price.cells[index]
            if cell is not None:
                played = self._expect(index, cell)
                if dog.compare(seen, played) and estimator.learns:
                    self.absent ^= {index}
                    self._changes += 1
                    self._change()
                    estimator.share(self.shared, len(self.cells), known=dog.trusts)
                    doubts.change(name, seen.last_cycle, trusts=dog.trusts)
        doubted = doubts.at(seen.last_cycle)
        self._changes += doubted != self._doubted[index]
        self._doubted[index] = doubted
        return dog.trusts

    def _expect(self, index: int, played: CellPrice) -> Expected:
        """Return the expected windows of a cell at its placement, computed once per simulation."""
        known = self._expected[index]
        if known is None or known[0] is not played:
            price = self._declared[index][self.placements[index]]
            cycles = self.cells[index].problem.due_cycles
            known = played, Expected.of(played.windows, price, cycles)
            self._expected[index] = known
        return known[1]

    def _begin(self) -> None:
        """Pass the measured conditions to the simulation; absent cells add none of shared nodes."""
        self.prices.begin(self.presents, self.absent)

    def note(self, index: int, estimates: Mapping[str, QoS], estimator: CellEstimator) -> None:
        """Record the estimates and measured conditions of a cell, if they are new."""
        revision = estimator.revision
        if revision == self._revisions[index]:
            return
        self._revisions[index] = revision
        self._note_alone(index, estimates)
        if estimator.present is not None:
            self.presents[index] = estimator.present
        self._search.change()

    def _note_alone(self, index: int, estimates: Mapping[str, QoS]) -> None:
        costs = {name: self._terms[index].cost(qos) for name, qos in estimates.items()}
        self.alone[index] = costs
        self._aims[index] = {
            name: self.rank.aim(costs[name], qos.violation_rate) for name, qos in estimates.items()
        }

    def consider(
        self, index: int, decision: Decision, *, by_price: bool, on_fallback: bool = False
    ) -> Verdict:
        """Return the verdict on a decision of a cell's policy (see `Wish`)."""
        here, is_absent = self.placements[index], index in self.absent
        may_move = by_price and bool(decision.costs) and decision.reason != "dwell"
        in_sets = by_price and not is_absent
        self._search.decide(index, free=may_move and not on_fallback if in_sets else None)
        if is_absent:
            verdict = self._outside(index, decision)
        elif self._set:
            return self._of_set(index, decision.name)
        elif by_price and not may_move:
            verdict = self._refused(index, decision.name)
        else:
            verdict = self._of_one(index, decision, by_price=by_price, on_fallback=on_fallback)
        if self._search.is_due and not self._set:
            self._find_set()
            if index in self._set and verdict.name == here:
                return self._of_set(index, decision.name)
        return verdict

    def _of_set(self, index: int, wished: str) -> Verdict:
        """Make the move of a member of the set; other cells stay until all have moved."""
        name = self._set.get(index)
        if name is None:
            why = SET_UNDER_WAY if wished != self.placements[index] else None
            return Verdict(self.placements[index], why, (None, None, self.round))
        if not self._search.is_free(index):
            self._change()
            return self._refused(index, wished)
        del self._set[index]
        self._put(index, name)
        self.round += not self._set
        return Verdict(name, None, self._asked)

    def _of_one(
        self, index: int, decision: Decision, *, by_price: bool, on_fallback: bool
    ) -> Verdict:
        """Return the verdict on moves of this cell only."""
        wished = decision.name
        state = self._changes, self._revisions[index]
        if self._looked[index] != state:
            self._looked[index] = state
            self._refusals[index] = {}
        elif not decision.migrated or wished in self._refusals[index]:
            return self._refused(index, wished)
        # Other decisions do not belong to the search; the limit on simulations excludes them.
        is_limited = by_price and not on_fallback
        play = self._search.play if is_limited else self.prices.price
        is_led = is_limited and self._search.is_open and self.objective == "sum"
        if not by_price:
            names = [wished] if decision.migrated else []
        else:
            names = self._promising(index)
            if is_led:
                names = self._led(index, names, wished)
        self._begin()
        here = tuple(self.placements)
        asked: tuple[float, float] | None = None
        for name in names:
            if name in self._doubted[index]:
                self._refusals[index][name] = WAS_NOT_AS_PLAYED
                continue
            there = moved(here, index, name)
            before = play(here)
            if before is None:
                break
            self.rank.settle(before)
            after = play(there)
            if after is None:
                break
            asked = self._phi(before), self._phi(after)
            why = self._objection(there, before, after)
            if why is None:
                verdict = Verdict(name, None, (*asked, self.round))
                self.rank.settle(after)
                self.round += 1
                self._put(index, name)
                self._search.spend()
                return verdict
            self._refusals[index][name] = why
            if is_led and not why.startswith("cap "):
                break
        verdict = self._refused(index, wished, asked)
        self.round += asked is not None
        return verdict

    def _find_set(self) -> None:
        """Search moves of several cells that lower Φ together."""
        here = tuple(self.placements)
        owed = [self._owed(i, self._takes(i)) for i in range(len(self.cells))]
        self._begin()

        def rank(price: FleetPrice, due: float) -> Rank:
            if self._over_cap(self.prices.price(here), price):
                return (math.inf,)
            return self.rank.of(price, due, self.absent)

        best = self._search.best(here, self._aims, owed, rank)
        if best == here:
            return
        before, after = self.prices.price(here), self.prices.price(best)
        if self._objection(best, before, after) is None:
            self.rank.settle(after)
            self._set = {i: name for i, name in enumerate(best) if name != here[i]}
            self._asked = self._phi(before), self._phi(after), self.round
        else:
            self.round += 1

    def _led(self, index: int, names: Sequence[str], wished: str) -> list[str]:
        """Return the cell's candidate in the table's best placements, if it is among `names`.

        The policy's candidate follows, because the table ignores caps.
        """
        if not names or not self._search.has_plays:
            return []
        owed = [self._owed(i, costs) for i, costs in enumerate(self.alone)]
        jump = self._search.jump(tuple(self.placements), self._aims, owed)[index]
        return [one for one in dict.fromkeys((jump, wished)) if one in names and jump in names]

    def _takes(self, index: int) -> Sequence[str]:
        """Return the candidates that a cell may take as a member of a set."""
        here = self.placements[index]
        if not self._search.is_free(index):
            return [here]
        return [one for one in self.alone[index] if one == here or one not in self._doubted[index]]

    def _owed(self, index: int, names: Iterable[str]) -> dict[str, float]:
        return {name: self.owed(index, name) for name in names}

    def _outside(self, index: int, decision: Decision) -> Verdict:
        """Permit any move of a cell outside Φ that adds no task to a shared node."""
        candidates, here = self.cells[index].problem.candidates, self.placements[index]
        before, after = candidates[here], candidates[decision.name]
        if any(node in self.shared for _, node in {*after.sites} - {*before.sites}):
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
        """Return up to `LOOKS` candidates that pay off by the table, best first."""
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
        """Return simulated minus tabulated J of a cell; 0 without foreign load on shared nodes.

        The table includes only the declared foreign load.
        """
        known = [one for i, one in enumerate(self.presents) if i not in self.absent]
        if not any(one.threads.keys() & self.shared for one in known):
            return 0.0
        self._begin()
        price, here = self._search.play(tuple(self.placements)), self.placements[index]
        cell = None if price is None else price.cells[index]
        load = self._at.loads.get(self.loads.resource(index, here) or "", 0.0)
        says = self.alone[index][here] + self.loads.wait(index, here, load)
        return 0.0 if cell is None else cell.cost - says

    def _helps_first(self, index: int, name: str) -> bool:
        """Whether the table predicts a better first part of the rank, before the sum."""
        if self.objective == "sum":
            return False
        before = self._aimed.costs(self.placements, self._aims)
        after = self._aimed.costs(moved(self.placements, index, name), self._aims)
        return self.rank.is_promising(before, after, self.absent)

    def owed(self, index: int, name: str) -> float:
        """Return the least fall of Φ for a move of a cell, Δ_min + α_S·S; 0 if it stays."""
        if name == self.placements[index]:
            return 0.0
        problem = self.cells[index].problem
        here, there = problem.candidates[self.placements[index]], problem.candidates[name]
        weight = problem.objective.weights.switching
        return problem.controller.min_improvement + weight * hamming(there, here)

    def _objection(
        self, there: tuple[str, ...], before: FleetPrice, after: FleetPrice
    ) -> str | None:
        """Return the reason against placements from simulated prices, or None."""
        owed = sum(self.owed(i, name) for i, name in enumerate(there))
        why = self.rank.objection(before, after, owed, self.absent)
        return self._over_cap(before, after) if why is None else why

    def _over_cap(self, before: FleetPrice, after: FleetPrice) -> str | None:
        """Return the first cell that would newly exceed its caps, as a reason, or None."""
        if self._has_caps:
            for i, cell in enumerate(self.cells):
                if i in self.absent:
                    continue
                caps, one, other = cell.problem.objective, before.qos(i), after.qos(i)
                if one and other and excess(one, caps) <= 0 < excess(other, caps):
                    return f"cap of {cell.name}"
        return None

    def _phi(self, played: FleetPrice) -> float:
        """Return Φ without absent cells."""
        return self.rank.phi(played, self.absent)


class Seat(Coordination):
    """Coordination of one cell by a ledger."""

    def __init__(self, ledger: FleetLedger, index: int) -> None:
        self.ledger, self._index = ledger, index

    def __repr__(self) -> str:
        return f"<Seat of {self.ledger.cells[self._index].name}>"

    @property
    def knows_others(self) -> bool:
        """Whether the cell is in Φ."""
        return self._index not in self.ledger.absent

    def meet(self, estimator: CellEstimator) -> None:
        """Pass the shared nodes and the number of cells to the estimator."""
        if len(self.ledger.cells) > 1:
            estimator.share(self.ledger.shared, len(self.ledger.cells))

    def turns(self, release_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return whether each cycle is in the cell's turn; cells take turns of a window by name."""
        ledger = self.ledger
        turn = release_ns // ledger.turn_ns % len(ledger.cells)
        return np.equal(turn, ledger.order[self._index])

    def place(self, name: str) -> None:
        """Record the placement of the cell."""
        self.ledger.place(self._index, name)

    def consider(self, wish: Wish) -> Verdict:
        """Return the ledger's verdict on a decision of the policy."""
        put = self.ledger.keep if wish.on_fallback else self.ledger.place
        put(self._index, wish.incumbent)
        self.ledger.note(self._index, wish.estimates, wish.estimator)
        is_as_played = True
        if wish.seen is not None and wish.doubts is not None and len(self.ledger.cells) > 1:
            asked = wish.seen, wish.doubts, wish.estimator
            is_as_played = self.ledger.watch(self._index, *asked)
        verdict = self.ledger.consider(
            self._index, wish.decision, by_price=wish.by_price, on_fallback=wish.on_fallback
        )
        if is_as_played or verdict.why or verdict.name != wish.incumbent:
            return verdict
        return verdict._replace(why=NOT_AS_PLAYED)
