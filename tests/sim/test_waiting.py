"""Waiting: what cycles that missed have waited for, on nodes and on links."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dwell.cellfile import from_document
from dwell.model import (
    Constant,
    Execution,
    Fabric,
    Flow,
    Link,
    Pipeline,
    Placement,
    Problem,
    Task,
)
from dwell.sim.fleet import waiting_in_fleet
from dwell.sim.static_fleet import StaticFleet
from dwell.sim.waiting import Waiting
from tests.cells.fleets import fleet_of, one_job, within


def ms(waited: Waiting) -> dict[tuple[str, str], float]:
    return {what: value / 1e6 for what, value in waited.items()}


def behind(problem: Problem, rate_mbps: float) -> Problem:
    """Return a cell whose messages queue: a larger one, and a slow link to the edge."""
    fabric, pipeline = problem.fabric, problem.pipeline
    slow = Link("R", "E", Constant(0.5), rate_mbps=rate_mbps)
    flows = tuple(replace(flow, payload_bytes=1_000) for flow in pipeline.flows)
    return replace(
        problem,
        pipeline=replace(pipeline, flows=flows),
        fabric=Fabric(fabric.nodes, {**fabric.links, "R->E": slow}),
    )


def test_one_after_another_each_waits_for_those_before() -> None:
    """Three jobs of 2 ms at once with D = 3: the second waits 2 ms, the third 4."""
    fleet = fleet_of((within(one_job(), 3.0), 3))
    fleet = fleet.changed(policy="OFF", estimator="profile")
    waited = waiting_in_fleet(fleet, seed=1, duration_ns=fleet.duration_ns(2))
    assert ms(waited) == {("resource", "E"): pytest.approx(40 * (2 + 4))}


def test_a_static_fleet_waits_the_same() -> None:
    fleet = fleet_of((within(one_job(scheduler="fair"), 3.0), 3), phases="even")
    fleet = replace(fleet, entries=(replace(fleet.entries[0], count=4),))
    length = {"seed": 1, "duration_ns": fleet.duration_ns(2)}
    fleet = fleet.changed(policy="OFF", estimator="profile")
    assert StaticFleet(**length).waiting(fleet) == waiting_in_fleet(fleet, **length)


def test_a_message_behind_others_waits_for_its_link() -> None:
    """8,000 bits at 0.75 Mbit/s take 10.7 ms of a period of 10: every message waits 0.7 ms more."""
    cell = within(behind(one_job(), 0.75), 10.0)
    fleet = fleet_of((cell, 1)).changed(policy="OFF")
    waited = ms(waiting_in_fleet(fleet, seed=1, duration_ns=fleet.duration_ns(2)))
    assert set(waited) == {("link", "R->E")}
    # Of the last cycles some are on their way when the run ends.
    by_cycle = [2 / 3 * cycle for cycle in range(40)]
    assert sum(by_cycle[:36]) < waited["link", "R->E"] <= sum(by_cycle) + 1e-6


def test_nothing_is_waited_for_where_nothing_is_missed() -> None:
    fleet = fleet_of((one_job(), 3)).changed(policy="OFF", estimator="profile")
    assert waiting_in_fleet(fleet, seed=1, duration_ns=fleet.duration_ns(2)) == {}


def test_idle_cycles_have_missed_nothing() -> None:
    """The sink runs in every second cycle; in the others one sampled task waits for another."""
    on = {"E": Execution(Constant(1.0))}
    tasks = {
        "sink": Task("sink", {"E": Execution(Constant(3.0))}, every=2),
        "first": Task("first", on),
        "second": Task("second", on),
    }
    flows = tuple(Flow(name, "sink", 0, sampled=True) for name in ("first", "second"))
    cell = one_job()
    pipeline = Pipeline(tasks, flows, cell.pipeline.period_ms, 2.0)
    placed = {"OFF": Placement(dict.fromkeys(tasks, "E"))}
    fleet = fleet_of((replace(cell, pipeline=pipeline, candidates=placed), 1))
    length = {"seed": 1, "duration_ns": fleet.duration_ns(2)}
    for waited in (
        waiting_in_fleet(fleet.changed(policy="OFF", estimator="profile"), **length),
        StaticFleet(**length).waiting(fleet.changed(policy="OFF")),
    ):
        assert ms(waited) == {("resource", "E"): pytest.approx(20 * (3 + 4))}


def test_old_data_have_waited_in_their_cycle_of_origin() -> None:
    """Each second cell's detection waits 15 ms for the first's; its fourth use is 60 ms old."""
    document = {
        "dwell": 1,
        "name": "loop",
        "period_ms": 10,
        "window_cycles": 20,
        "warmup_windows": 1,
        "nodes": {"R": {"tier": "robot"}, "E": {"tier": "edge", "scheduler": "fifo"}},
        "links": [{"from": "R", "to": "E", "both_ways": True, "delay_ms": 0}],
        "tasks": {
            "camera": {"every": 4, "on": {"R": {"exec_ms": 0}}},
            "imu": {"on": {"R": {"exec_ms": 0}}},
            "detect": {"on": {"E": {"exec_ms": 15}}},
            "control": {"on": {"R": {"exec_ms": 0}}},
        },
        "flows": [
            {"from": "camera", "to": "detect"},
            {"from": "detect", "to": "control", "sampled": True},
            {"from": "imu", "to": "control"},
        ],
        "chains": {"see-act": {"from": "camera", "to": "control", "max_age_ms": 55}},
        "candidates": {"OFF": {}},
    }
    fleet = fleet_of((from_document(document), 2)).changed(policy="OFF")
    length = {"seed": 1, "duration_ns": fleet.duration_ns(2)}
    assert ms(StaticFleet(**length).waiting(fleet)) == {("resource", "E"): pytest.approx(5 * 15)}
