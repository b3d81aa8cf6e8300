"""Fleets of cells with several rates, sampled flows and deadlines beyond the period."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from polars.testing import assert_frame_equal

import dwell
from dwell.cellfile.cell import from_document
from dwell.estimators.fleet_prices import CYCLES, FleetPrices
from dwell.estimators.prices import SEED
from dwell.model import Placement, Problem
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun
from dwell.sim.fleet import phased, priced_cells
from dwell.sim.static_fleet import StaticFleet
from dwell.study.capacity import MANY_CYCLES, capacity_of, long_runs
from dwell.study.fleet_plan import plan_fleet
from tests.cells.rated import drawn, idle_cell, inner_loop

TABLES = ("cycles", "windows", "decisions", "jobs")


def loop(**changes: Any) -> Problem:
    """Return a control loop whose edge server is small."""
    cell = inner_loop(**changes)
    cell["nodes"]["E"]["cores"] = 1
    cell["links"][0] |= {"rate_mbps": 20, "in_order": True}
    stress = [{"node": "R", "at_s": 1, "for_s": 2, "stress_threads": 6}]
    cell["scenarios"] = {"stress": stress}
    return from_document(cell)


def late() -> Problem:
    """Return a cell with idle cycles, and a deadline of two and a half periods."""
    problem = idle_cell()
    controller = replace(problem.controller, initial="SO")
    pipeline = replace(problem.pipeline, deadline_ms=50.0)
    return replace(problem, name="late", pipeline=pipeline, controller=controller)


def overloaded() -> Problem:
    """Return a cell with idle cycles in which each other cycle misses its deadline."""
    cell = inner_loop(period_ms=20, deadline_ms=4, window_cycles=10)
    cell["tasks"] = {
        "camera": {"on": {"R": {"exec_ms": 1}}, "every": 5},
        "detect": {"on": {"R": {"exec_ms": 1}, "E": {"exec_ms": 5}}},
    }
    cell["flows"] = [{"from": "camera", "to": "detect"}]
    cell["candidates"] = {"LOC": {"detect": "R"}, "SO": {"detect": "E"}}
    return from_document(cell)


def hall(*entries: FleetEntry, **more: Any) -> Fleet:
    settings: dict[str, Any] = {"phases": "even", "coordination": "none", "shared": ("E",)}
    return Fleet("hall", entries, **settings | more)


def violation_rates(run: FleetRun) -> list[float]:
    windows = [one.arrays("windows") for one in run.cells.values()]
    return [float(one["violation_rate"][~one["warmup"]].mean()) for one in windows]


@pytest.mark.parametrize("coordination", ["none", "ledger"])
@pytest.mark.parametrize(("problem", "scenario"), [(loop(), "stress"), (late(), "baseline")])
def test_a_fleet_of_one_is_that_cell(problem: Problem, scenario: str, coordination: str) -> None:
    asked: dict[str, Any] = {"policy": "dtp+corrected", "seed": 3, "windows": 12, "jobs": True}
    alone = dwell.simulate(problem, scenario=scenario, **asked)
    fleet = hall(FleetEntry(problem, 1, scenario), phases="sync", coordination=coordination)
    (run,) = dwell.simulate_fleet(fleet, **asked).cells.values()
    assert alone.decisions["migrated"].any()
    for table in TABLES if coordination == "none" else ("cycles", "windows", "jobs"):
        assert_frame_equal(getattr(run, table), getattr(alone, table))


@pytest.mark.parametrize("ends_together", [True, False])
def test_cells_that_share_nothing_are_as_alone(ends_together: bool) -> None:
    """The second cell has forwards of its own."""
    second = loop(deadline_ms=40 if ends_together else 7)
    fleet = hall(FleetEntry(late()), FleetEntry(second, 1, "stress"), shared=())
    asked: dict[str, Any] = {"policy": "dtp+corrected", "seed": 3, "jobs": True}
    runs = [*dwell.simulate_fleet(fleet, windows=5, phases="sync", **asked).cells.values()]
    alone = [
        dwell.simulate(late(), windows=5, **asked),
        dwell.simulate(second, scenario="stress", windows=15, **asked),
    ]
    assert alone[1].decisions["migrated"].any()
    for run, one in zip(runs, alone, strict=True):
        # The last cycles of a cell that ends first go on while the other cell is simulated.
        for table in TABLES if ends_together else ("decisions",):
            assert_frame_equal(getattr(run, table), getattr(one, table))


def test_random_phases_are_below_the_base_period() -> None:
    run = dwell.simulate_fleet(hall(FleetEntry(loop(), 3), phases="random"), windows=4)
    assert len(set(run.phases_ms.values())) == 3
    for name, one in run.cells.items():
        first_ns = int(one.cycles["release_ns"][0])
        assert first_ns == pytest.approx(1e6 * run.phases_ms[name], abs=1)
        assert 0 <= first_ns < 10e6


@pytest.mark.parametrize("policy", ["SO", "LOC"])
def test_static_fleets_count_no_idle_cycles(policy: str) -> None:
    fleet = hall(FleetEntry(overloaded(), 2), FleetEntry(late(), 1))
    static = StaticFleet(seed=2, duration_ns=fleet.duration_ns(4))
    found = [float(missed.mean()) for missed in static.play(fleet.changed(policy=policy)).missed]
    run = dwell.simulate_fleet(fleet, seed=2, windows=4, policy=policy, estimator="profile")
    assert found == pytest.approx(violation_rates(run), abs=1e-12)
    assert found[0] == (1.0 if policy == "SO" else 0.0)


@pytest.mark.parametrize("policy", ["SO", "dtp"])
def test_a_capacity_is_of_the_cycles_in_which_a_sink_is_due(policy: str) -> None:
    cell = overloaded()
    placed = {name: Placement({"camera": "R", "detect": "E"}) for name in ("SO", "E2")}
    fleet = hall(FleetEntry(replace(cell, candidates=placed)), phases="sync")
    found = capacity_of(fleet, policy=policy, most=1, seeds=[1], cycles=20, processes=1)
    assert found.alone == 1.0
    assert {limit.name for limit in [found.limits] if limit} <= {"R->E", "E", "R"}


def test_a_run_of_a_capacity_study_has_enough_cycles_with_a_sink() -> None:
    """A sink is due in each fifth cycle."""
    fleet = hall(FleetEntry(overloaded()), phases="sync")
    (fault,) = long_runs(fleet, cycles=MANY_CYCLES // 5 + 2)
    assert "2,000,010 cycles" in fault.message
    assert not [*long_runs(fleet, cycles=MANY_CYCLES // 5)]


def phi_of_windows(fleet: Fleet, run: FleetRun) -> float:
    """Return Φ of a run with fixed placements, by the page, from its windows after the first."""
    phi, shared = 0.0, 0.0
    for one in run.cells.values():
        weights, targets = one.problem.objective.weights, one.problem.objective.targets
        windows = {name: np.array(values[1:]) for name, values in one.windows.to_dict().items()}
        assert targets.latency_ms
        phi += float(windows["seen_l95_ms"].mean()) / targets.latency_ms
        phi += weights.violations * float(windows["seen_violation_rate"].mean())
        phi += weights.robot * float(windows["u_R"].mean()) / targets.robot
        shared += weights.edge / targets.edge / len(run.cells)
    (first,) = [*run.cells.values()][:1]
    return phi + shared * float(np.mean(first.windows["u_E"][1:].to_numpy()))


def test_phi_of_a_ledger_follows_from_runs_that_stay() -> None:
    """Each Φ in the record of a fleet of two, derived from runs of the kernel's own draws."""
    cell = loop(controller={"initial": "ALL", "decide_cycles": 40})
    fleet = hall(FleetEntry(cell, 2), coordination="ledger", phases=(0.0, 4.0))
    run = dwell.simulate_fleet(fleet, seed=1, windows=8, policy="dtp+profile")
    rows = [
        (row["phi_before"], row["phi_after"], index, row["placement"])
        for index, one in enumerate(run.cells.values())
        for row in one.decisions.sort("window").iter_rows(named=True)
        if row["phi_before"] is not None and row["migrated"]
    ]
    assert rows
    windows = 1 + -(-CYCLES // (2 * cell.window_cycles))
    known: dict[tuple[str, ...], float] = {}

    def phi(placed: tuple[str, ...]) -> float:
        if placed not in known:
            entries = [FleetEntry(cell, 1, policy=name) for name in placed]
            stays = hall(*entries, phases=(0.0, 4.0))
            found = dwell.simulate_fleet(stays, seed=SEED, windows=windows)
            known[placed] = phi_of_windows(stays, found)
        return known[placed]

    here = ["ALL", "ALL"]
    for before, after, index, name in sorted(rows, key=lambda row: -row[0]):
        there = [*here]
        there[index] = name
        assert before == pytest.approx(phi(tuple(here)), rel=1e-9)
        assert after == pytest.approx(phi(tuple(there)), rel=1e-9)
        here = there


def test_a_plan_is_the_best_of_all_placements() -> None:
    fleet = hall(FleetEntry(loop(), 2))
    plan = plan_fleet(fleet)
    prices = FleetPrices(priced_cells(fleet, phased(fleet, 1)), fleet.shared)
    every = {placed: prices.price(placed).phi for placed in product(loop().candidates, repeat=2)}
    placed = tuple(plan.placements.values())
    assert every[placed] == min(every.values()) < max(every.values())
    assert 2 * plan.phi == pytest.approx(every[placed], rel=0.03)


def test_windows_that_are_longer_than_the_longest_played_hold_a_run_of_each_sink() -> None:
    cell = inner_loop(window_cycles=6000, period_ms=1, deadline_ms=10)
    cell["tasks"]["imu"]["every"] = 5000
    cell["tasks"]["control"]["on"]["R"]["exec_ms"] = drawn(1)
    run = dwell.simulate(from_document(cell), policy="dtp+corrected", seed=1, windows=1)
    assert run.decisions.height == 1
