"""Prices, estimates and warnings of cells with several rates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dwell import simulate
from dwell.cellfile.cell import from_document
from dwell.estimators import warnings_of
from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.measured import Site
from dwell.estimators.present import Present
from dwell.estimators.prices import RATE, prices_of
from dwell.kernels.arrays import CellArrays
from dwell.kernels.random_draws import draw
from dwell.model import Problem
from dwell.study.summary import summarise
from tests.cells.rated import drawn, idle_cell, inner_loop

SEEDS = range(6)


@pytest.mark.parametrize("problem", [from_document(inner_loop()), idle_cell()], ids=["all", "idle"])
def test_a_price_is_the_mean_of_runs_that_stay(problem: Problem) -> None:
    windows = 240 if problem.pipeline.has_idle_cycles else 80
    asked: dict[str, Any] = {"estimator": "profile", "windows": windows}
    for name, price in prices_of(problem).items():
        runs = [
            summarise(simulate(problem, policy=name, **asked, seed=seed), problem, {}).row
            for seed in SEEDS
        ]
        l95_ms = np.mean([float(row["l95_ms"]) for row in runs])
        violation_rate = np.mean([float(row["violation_rate"]) for row in runs])
        assert price.l95_ms == pytest.approx(l95_ms, rel=0.02)
        assert price.violation_rate == pytest.approx(violation_rate, abs=0.015)


def test_a_price_with_idle_cycles_is_as_precise_as_others() -> None:
    problem = idle_cell()
    problem = replace(problem, pipeline=replace(problem.pipeline, deadline_ms=9.5))
    price = prices_of(problem)["SO"]
    assert 0.2 < price.violation_rate < 0.8
    assert price.violation_error <= RATE


def test_own_work_counts_each_run() -> None:
    own = prices_of(from_document(inner_loop()))["LOC"].own
    # camera 2 ms and detect 60 ms in ten cycles, imu 2 ms and control 3 ms in each, on two cores.
    assert own["R"] == pytest.approx((0.2 + 6 + 2 + 3) / 20, rel=0.02)


def test_a_run_of_a_slow_task_takes_the_measured_values_in_turn() -> None:
    problem = from_document(inner_loop())
    real = draw(problem, seed=1, windows=2)
    site = Site("detect", "E")
    player = CandidatePlayer([(problem, real)], measures=True, log_jobs=True)
    player.begin({0: Present({site: np.array([1.0, 2.0, 3.0])})})
    jobs = CellArrays(player.play({0: "SO"})).logs().jobs[0, ::10, 2]
    assert (jobs["end_ns"] - jobs["start_ns"]).tolist() == [1e6 * (1 + k % 3) for k in range(8)]


def test_what_is_not_due_is_no_loss() -> None:
    problem = from_document(inner_loop())
    prices = prices_of(problem)
    run = simulate(problem, policy="dtp", estimator="corrected", seed=1, windows=60)
    for name, price in prices.items():
        estimated = run.decisions[f"est_violation_rate_{name}"].to_numpy()[20:]
        assert estimated.mean() == pytest.approx(price.violation_rate, abs=0.02)


def test_a_sampled_message_that_no_shadow_gets_is_no_loss() -> None:
    """With control alone on E, its shadows do not get the detections, which both share."""
    cell = inner_loop(controller={"shadow_fraction": 0.1})
    cell["candidates"] = {"LOC": {"detect": "R", "control": "R"}}
    cell["candidates"]["FAR"] = {"detect": "R", "control": "E"}
    run = simulate(from_document(cell), policy="LOC", estimator="corrected", seed=1, windows=30)
    assert (run.decisions["est_violation_rate_FAR"].to_numpy() < 0.2).all()


def test_a_message_that_a_slower_task_does_not_wait_for_is_no_loss_of_a_shadow() -> None:
    """Control waits for each tenth result of a filter, which a shadow computes on E."""
    controller = {"shadow_fraction": 0.2, "decide_cycles": 80}
    cell = inner_loop(deadline_ms=30, window_cycles=80, controller=controller)
    for name in ("camera", "detect"):
        del cell["tasks"][name]
    on = {node: {"exec_ms": drawn(1)} for node in ("R", "E")}
    cell["tasks"] |= {"clock": {"on": {"R": {"exec_ms": 1}}, "every": 10}, "filter": {"on": on}}
    cell["tasks"]["control"]["every"] = 10
    pairs = ("imu", "filter"), ("filter", "control"), ("clock", "control")
    cell["flows"] = [{"from": source, "to": target} for source, target in pairs]
    cell["candidates"] = {"LOC": {"filter": "R", "control": "R"}}
    cell["candidates"]["FAR"] = {"filter": "E", "control": "R"}
    run = simulate(from_document(cell), policy="LOC", estimator="corrected", seed=1, windows=20)
    assert (run.decisions["est_violation_rate_FAR"].to_numpy() < 0.2).all()


def test_the_controller_leaves_a_slow_node() -> None:
    slow = [{"node": "E", "at_s": 4, "stress_threads": 60}]
    problem = from_document(inner_loop(scenarios={"slow": slow}, controller={"initial": "ALL"}))
    run = simulate(problem, scenario="slow", policy="dtp", seed=1, windows=40)
    assert run.windows["placement"].to_list()[-1] != "ALL"


def warned(document: dict[str, Any]) -> list[str]:
    return [fault.path for fault in warnings_of(from_document(document))]


def test_a_time_between_decisions_without_a_run_of_a_sink_is_a_warning() -> None:
    cell = inner_loop(controller={"decide_cycles": 5})
    assert "controller.decide_cycles" not in warned(cell)
    cell["flows"][2]["sampled"] = False
    cell["tasks"]["control"]["every"] = 10
    assert "controller.decide_cycles" in warned(cell)


@pytest.mark.parametrize(("max_age_ms", "expected"), [(1, True), (25, True), (80, False)])
@pytest.mark.parametrize("latency", [None, "see"])
def test_a_chain_that_the_guard_does_not_wait_for_long_enough_is_a_warning(
    max_age_ms: float, expected: bool, latency: str | None
) -> None:
    """The picture behind a command is up to 150 ms old on the edge server."""
    chains = {"see": {"from": "camera", "to": "control", "max_age_ms": max_age_ms}}
    cell = inner_loop(chains=chains, controller={"guard_cycles": 2, "fallbacks": ["LOC"]})
    cell["objective"] |= {"latency": latency} if latency else {}
    assert ("chains.see.max_age_ms" in warned(cell)) == expected


def test_an_offset_beyond_the_deadline_is_a_warning_on_the_way_to_a_sink_only() -> None:
    cell = inner_loop()
    cell["tasks"]["imu"] = {**cell["tasks"]["imu"], "offset_ms": 8}
    cell["tasks"]["camera"]["offset_ms"] = 9
    paths = warned(cell)
    assert "tasks.imu.offset_ms" in paths
    assert "tasks.camera.offset_ms" not in paths


def test_a_slow_task_needs_its_share_of_a_core() -> None:
    cell = inner_loop(nodes={"R": {"tier": "robot"}, "E": {"tier": "edge"}})
    cell["tasks"]["detect"]["on"]["R"]["exec_ms"] = 40
    assert "candidates.LOC" not in warned(cell)
    cell["tasks"]["camera"]["every"] = 5
    assert "candidates.LOC" in warned(cell)
