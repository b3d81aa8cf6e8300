"""Fleets whose cells may send each cycle through two copies, one of them on a shared node."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.control.ledger import FleetLedger
from dwell.estimators.fleet_prices import CYCLES, FleetPrices
from dwell.estimators.prices import SEED
from dwell.model import Decision, Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun
from dwell.sim.fleet import phased, priced_cells
from dwell.study.capacity import capacity_of

CELL: dict[str, Any] = {
    "dwell": 1,
    "name": "hedge",
    "period_ms": 20,
    "deadline_ms": 12,
    "window_cycles": 50,
    "nodes": {"R": {"tier": "robot", "cores": 2}, "E": {"tier": "edge", "cores": 1}},
    "links": [
        {"from": "R", "to": "E", "delay_ms": 2, "loss": 0.02},
        {"from": "E", "to": "R", "delay_ms": 2},
    ],
    "tasks": {
        "camera": {"on": {"R": {"exec_ms": 0.5}}},
        "work": {
            "on": {
                "R": {"exec_ms": {"lognormal": {"mean": 8, "cv": 0.3}}},
                "E": {"exec_ms": {"lognormal": {"mean": 5, "cv": 0.3}}},
            }
        },
        "act": {"on": {"R": {"exec_ms": 0.1}}},
    },
    "flows": [
        {"from": "camera", "to": "work", "bytes": 1000},
        {"from": "work", "to": "act", "bytes": 100},
    ],
    "candidates": {
        "LOC": {"work": "R"},
        "SO": {"work": "E"},
        "BOTH": {"replicas": ["LOC", "SO"]},
    },
    "objective": {
        "weights": {"latency": 1.0, "violations": 10.0, "robot": 0.5, "edge": 0.5},
        "targets": {"latency_ms": 12, "robot": 0.5, "edge": 0.5},
    },
    "controller": {"policy": "LOC", "fallbacks": ["LOC"]},
}
CANDIDATES = (*CELL["candidates"],)


@pytest.fixture(scope="module")
def cell() -> Problem:
    return from_document(CELL)


def hall(*entries: FleetEntry) -> Fleet:
    return Fleet("hall", entries, ("E",), (0.0, 7.0), "none")


def staying(cell: Problem, placed: tuple[str, ...], windows: int) -> FleetRun:
    """Simulate cells that stay at a candidate each, with the draws of prices."""
    fleet = hall(*(FleetEntry(cell, 1, policy=name) for name in placed))
    return dwell.simulate_fleet(fleet, seed=SEED, windows=windows)


def phi_of(run: FleetRun, placed: tuple[str, ...]) -> float:
    """Return Φ by the page, from the windows after the first."""
    phi, of_edge = 0.0, []
    for one, name in zip(run.cells.values(), placed, strict=True):
        weights, targets = one.problem.objective.weights, one.problem.objective.targets
        windows = {key: np.array(values[1:]) for key, values in one.windows.to_dict().items()}
        phi += float(windows["seen_l95_ms"].mean()) / float(targets.latency_ms or 0)
        phi += weights.violations * float(windows["seen_violation_rate"].mean())
        phi += weights.robot * float(windows["u_R"].mean()) / targets.robot
        if name != "LOC":
            of_edge.append(weights.edge * float(windows["u_E"].mean()) / targets.edge)
    # The first cell on E measures E.
    return phi + next(iter(of_edge), 0.0)


def test_phi_follows_from_runs_that_stay(cell: Problem) -> None:
    fleet = hall(FleetEntry(cell, 2))
    prices = FleetPrices(priced_cells(fleet, phased(fleet, SEED)), fleet.shared)
    windows = 1 + -(-CYCLES // (2 * cell.window_cycles))
    phi = {placed: prices.price(placed).phi for placed in product(CANDIDATES, repeat=2)}
    assert phi == {
        placed: pytest.approx(phi_of(staying(cell, placed, windows), placed), rel=1e-9)
        for placed in phi
    }


def test_a_cell_outside_phi_adds_no_second_copy_to_a_shared_node(cell: Problem) -> None:
    fleet = hall(FleetEntry(cell, 2))
    ledger = FleetLedger(priced_cells(fleet, phased(fleet, SEED)), fleet.shared)
    ledger.absent.add(0)
    costs = dict.fromkeys(CANDIDATES, 1.0)
    to_both = Decision(cell.candidates["BOTH"], "BOTH", True, "migrate", costs)
    assert ledger.consider(0, to_both, by_price=True).name == "LOC"
    ledger.place(0, "SO")
    assert ledger.consider(0, to_both, by_price=True).name == "BOTH"


def test_a_second_copy_on_a_shared_node_limits_the_number_of_cells(cell: Problem) -> None:
    fleet = Fleet("hall", (FleetEntry(cell),), ("E",), "even", "none")
    found = capacity_of(fleet, policy="BOTH", most=2, seeds=[1], cycles=200, processes=1)
    assert found.robots <= 2
