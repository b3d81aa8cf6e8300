"""What a measured run says of itself: left-out windows, what was played, candidates."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from dwell import simulate
from dwell.model import (
    Constant,
    Episodes,
    Exponential,
    NodeDisturbance,
    Placement,
)
from dwell_lab.validation.measured_run import excluded_windows, read_measured
from lab.tests.validation.test_validation import measured, with_meta
from tests.cells.small import make_problem

WINDOWS = 102


@pytest.mark.parametrize(
    ("settings", "after"),
    [
        ({"min_dwell": 3}, {5, 6, 7, 8, 9, 10, 50, 51, 52, 53, 101}),
        ({"min_dwell": None}, {5, 6, 7, 8, 9, 10, 50, 51, 52, 53, 101}),
        ({"min_dwell": None, "estimator": "corrected"}, {5, 7, 50, 101}),
        ({"min_dwell": 0, "min_dwell_cycles": 1}, {5, 6, 7, 8, 50, 51, 101}),
    ],
)
def test_of_a_policy_that_moves_what_was_decided_on_them_is_left_out_too(
    settings: dict[str, Any], after: set[int]
) -> None:
    problem = make_problem()
    problem = replace(problem, controller=replace(problem.controller, **settings))
    last = WINDOWS - 1
    for policy, left_out in (("LOC", {5, 7, 50, last}), ("dtp", after)):
        (name, run), *_ = measured(problem, "baseline", policy, 101).items()
        told = {"excluded": [5, 7, 50, last]}
        one = read_measured(name, with_meta(run, pressure=told), problem)
        assert set(one.excluded) == left_out


@pytest.mark.parametrize(
    ("meta", "expected"),
    [
        ({}, set()),
        ({"excluded_windows": [3, 4]}, {3, 4}),
        ({"pressure": {"excluded": [9]}}, {9}),
    ],
)
def test_ways_to_name_windows(meta: dict[str, Any], expected: set[int]) -> None:
    assert excluded_windows(meta) == expected


def test_the_warm_up_is_that_of_the_run() -> None:
    problem = make_problem()
    (name, run), *_ = measured(replace(problem, warmup_windows=9), "baseline", "LOC", 1).items()
    assert read_measured(name, run, problem).problem.warmup_windows == 9


def test_disturbances_are_simulated_when_they_were_played() -> None:
    problem = make_problem()
    problem = replace(
        problem,
        scenarios={
            "late": (
                NodeDisturbance("R1", at_s=5.0, for_s=10.0, stress_threads=4),
                NodeDisturbance("E", at_s=0.0, stress_threads=1),
            )
        },
    )
    run = simulate(problem, scenario="late", policy="LOC", seed=1, windows=WINDOWS)
    late, early = run.meta["problem"]["scenarios"]["late"]
    told = [{**late, "at_s": 6.5, "for_s": 9.0}, {**early, "at_s": -0.5, "for_s": 40.0}]
    found = read_measured("run", with_meta(run, played=told), problem)
    assert found.problem.scenario("late") == (
        NodeDisturbance("R1", at_s=6.5, for_s=9.0, stress_threads=4),
        NodeDisturbance("E", at_s=0.0, for_s=math.inf, stress_threads=1),
    )


def test_episodes_and_ramps_are_simulated_as_they_were_played() -> None:
    episodes = Episodes("wind", Exponential(3.0), Constant(1.0))
    windy = NodeDisturbance("R1", stress_threads=4, episodes=episodes)
    rising = NodeDisturbance("E", at_s=2.0, for_s=9.0, ramp_s=4.0, stress_threads=4)
    problem = replace(make_problem(), scenarios={"drawn": (windy, rising)})
    run = simulate(problem, scenario="drawn", policy="LOC", seed=1, windows=WINDOWS)
    wind, rise = run.meta["problem"]["scenarios"]["drawn"]
    del wind["episodes"]
    told = [{**wind, "at_s": at_s, "for_s": 1.0} for at_s in (2.5, 6.0)]
    told.append({**rise, "at_s": 2.1, "for_s": 7.9, "ramp_s": 3.95})
    found = read_measured("run", with_meta(run, played=told), problem)
    plain = NodeDisturbance("R1", for_s=1.0, stress_threads=4)
    assert found.problem.scenario("drawn") == (
        replace(plain, at_s=2.5),
        replace(plain, at_s=6.0),
        replace(rising, at_s=2.1, for_s=7.9, ramp_s=3.95),
    )


def test_candidates_are_those_of_the_run() -> None:
    problem = make_problem()
    fewer = {name: problem.candidates[name] for name in ("LOC", "SO")}
    run = simulate(replace(problem, candidates=fewer), policy="dtp", seed=1, windows=6)
    found = read_measured("run", run, problem)
    assert list(found.problem.candidates) == ["LOC", "SO"]


def test_where_it_began_and_its_fallbacks_come_with_a_runs_candidates() -> None:
    problem = make_problem()
    settings = replace(problem.controller, initial="LOC", fallbacks=("LOC", "HYB"))
    problem = replace(problem, controller=settings)
    unseen = Placement({"sensing": "R1", "perception": "R1", "planning": "E", "control": "R2"})
    theirs = replace(settings, policy="ROB-EDGE", initial="ROB-EDGE", fallbacks=("ROB-EDGE",))
    alone = replace(problem, candidates={"ROB-EDGE": unseen}, controller=theirs)
    run = simulate(alone, policy="ROB-EDGE", seed=1, windows=6)
    found = read_measured("run", run, problem)
    assert list(found.problem.candidates) == ["ROB-EDGE"]
    assert found.problem.initial == "ROB-EDGE"
    assert found.problem.controller.fallbacks == ("ROB-EDGE",)
