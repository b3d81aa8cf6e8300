"""Ranks of fleet prices: which cells count as served, and when more of them are better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from dwell.cellfile import from_document
from dwell.control.fleet_rank import MostServed, fleet_rank
from dwell.control.ledger import FleetLedger
from dwell.estimators.fleet_prices import CellPrice, FleetPrice, FleetPrices, PricedCell
from dwell.estimators.measured import Site
from dwell.estimators.present import Present
from dwell.estimators.protocol import CellEstimator
from dwell.model import Decision, FrozenDict, Problem, QoS
from dwell.model.fleet import FleetObjective

PERIOD_MS, EARLY_MS, LATE_MS = 20.0, 5.0, 15.0


def cell_of(least: float = 0.05) -> Problem:
    """Return a cell whose robot is cheap, and whose edge misses no deadline."""
    return from_document(
        {
            "dwell": 1,
            "name": "cell",
            "period_ms": PERIOD_MS,
            "deadline_ms": 10,
            "window_cycles": 20,
            "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge"}},
            "tasks": {"a": {"on": {"R": {"exec_ms": EARLY_MS}, "E": {"exec_ms": EARLY_MS}}}},
            "candidates": {"LOC": {"a": "R"}, "SO": {"a": "E"}},
            "objective": {
                "weights": {
                    "latency": 0, "violations": 1, "robot": 0, "edge": 1, "switching": 0,
                },
                "targets": {"latency_ms": 10},
            },
            "controller": {"min_improvement": least},
        }
    )  # fmt: skip


def price_of(rates: Sequence[float], costs: Sequence[float], windows: int = 100) -> FleetPrice:
    """Return a price of cells whose windows all have the same V_D."""
    cells = [
        CellPrice(QoS(1.0, rate, {}), cost, np.full((windows, 2), (1.0, rate)))
        for rate, cost in zip(rates, costs, strict=True)
    ]
    return FleetPrice(tuple(cells), 0.0, {})


def rank_of(objective: FleetObjective, count: int, limit: float = 0.05) -> MostServed:
    cells = [PricedCell(f"cell-{i}", cell_of()) for i in range(count)]
    rank = fleet_rank(objective, cells, limit)
    assert isinstance(rank, MostServed)
    return rank


def test_one_more_served_cell_is_better_whatever_it_costs() -> None:
    rank = rank_of("served", 2)
    neither, one = price_of([0.2, 0.2], [1.0, 1.0]), price_of([0.0, 0.9], [1.0, 100.0])
    assert rank.objection(neither, one, 50.0) is None
    assert rank.objection(one, neither, 0.0) == "ledger: fewer cells would be served"
    assert rank.of(one) < rank.of(neither)


def test_among_equal_counts_the_sum_falls_by_what_is_owed() -> None:
    rank = rank_of("served", 2)
    before, after = price_of([0.0, 0.9], [1.0, 2.0]), price_of([0.9, 0.0], [1.0, 1.75])
    assert rank.objection(before, after, 0.2) is None
    assert rank.objection(before, after, 0.25) is not None


def test_a_cell_that_has_left_is_not_counted() -> None:
    rank = rank_of("served", 2)
    before, after = price_of([0.9, 0.9], [2.0, 2.0]), price_of([0.0, 0.9], [2.0, 2.0])
    assert rank.objection(before, after, 0.1) is None
    assert rank.objection(before, after, 0.1, {0}) is not None


@pytest.mark.parametrize("begins_served", [True, False])
def test_within_two_errors_of_the_limit_a_cell_is_as_before(begins_served: bool) -> None:
    """Of 2,000 cycles a V_D of 5 % has a standard error of 0.49 %."""
    rank = rank_of("served", 1)
    rank.settle(price_of([0.01 if begins_served else 0.09], [1.0]))
    for rate in (0.044, 0.056, 0.047, 0.053):
        price = price_of([rate], [1.0])
        assert rank.served(price) == [begins_served]
        rank.settle(price)
    for rate, is_served in ((0.035, True), (0.065, False), (0.053, False), (0.035, True)):
        rank.settle(price_of([rate], [1.0]))
        assert rank.served(price_of([0.05], [1.0])) == [is_served]


def test_at_first_a_cell_at_the_limit_is_served() -> None:
    rank = rank_of("served", 3)
    assert rank.served(price_of([0.05, 0.051, 0.0], [1.0] * 3)) == [True, False, True]


class Knows(CellEstimator):
    """Knows the V_D on the robot; the edge misses nothing."""

    def __init__(self) -> None:
        self.revision = 0
        self._present = Present()

    @property
    def present(self) -> Present:
        """What is played on the robot."""
        return self._present

    def show(self, rate: float, rng: np.random.Generator) -> Mapping[str, QoS]:
        """Return estimates where the robot is late in some share of the cycles."""
        demand_ms = np.where(rng.permutation(2000) < 2000 * rate, LATE_MS, EARLY_MS)
        self.revision += 1
        self._present = Present(demands=FrozenDict({Site("a", "R"): demand_ms}))
        used = {"R": 0.25, "E": 0.0}
        return {"LOC": QoS(EARLY_MS, rate, used), "SO": QoS(EARLY_MS, 0.0, used)}

    def start(self, problem: Problem) -> None:
        """Know nothing."""

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> Mapping[str, QoS]:
        """Estimate nothing."""
        return {}


def moves_of(objective: FleetObjective, rates: Sequence[float]) -> list[str]:
    """Return the moves of a cell whose robot has these V_D, one after another."""
    problem = cell_of()
    cells = [PricedCell("cell", problem)]
    prices = FleetPrices(cells, ["E"], cycles=2000)
    ledger = FleetLedger(cells, ["E"], objective, prices=prices, limit=0.05)
    estimator, rng, moves = Knows(), np.random.default_rng(1), []
    for rate in rates:
        here = ledger.placements[0]
        ledger.note(0, estimator.show(rate, rng), estimator)
        costs = FrozenDict(dict.fromkeys(problem.candidates, 0.0))
        decision = Decision(problem.candidates[here], here, False, "hold", costs)
        name = ledger.consider(0, decision, by_price=True).name
        if name != here:
            moves.append(name)
    return moves


@pytest.mark.parametrize("at_first", [0.01, 0.5])
def test_a_cell_at_the_limit_moves_at_most_twice_in_300_windows(at_first: float) -> None:
    rates = np.random.default_rng(2).uniform(0.047, 0.053, 300).tolist()
    assert len(moves_of("served", [at_first, *rates])) <= 2


def test_a_cell_leaves_a_placement_that_does_not_serve_it() -> None:
    """The edge costs more, so that the sum keeps the cell on its robot."""
    rates = [0.01, 0.09, 0.01, 0.09]
    assert moves_of("served", rates) == ["SO", "LOC", "SO"]
    assert moves_of("sum", rates) == []
