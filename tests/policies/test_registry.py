"""Policies by name."""

from __future__ import annotations

import pytest

from dwell.errors import PolicyError
from dwell.model import ControllerSettings
from dwell.policies import ATP, DTP, Cusum, LatencyFirst, Policy, Static, WorkFunction, by_name
from dwell.policies.registry import REGISTRY
from tests.cells.paper import CANDIDATES, OBJECTIVE, place, problem

SETTINGS = ControllerSettings(initial="HYB", min_dwell=7, min_improvement=0.25, escape=True)


@pytest.mark.parametrize("name", [*REGISTRY, *CANDIDATES])
def test_every_name_makes_a_policy(name: str) -> None:
    assert isinstance(by_name(name, problem()), Policy)


def test_parameters_come_from_the_problem() -> None:
    dtp = by_name("dtp", problem(controller=SETTINGS))
    assert isinstance(dtp, DTP)
    assert (dtp.initial, dtp.min_dwell, dtp.min_improvement) == ("HYB", 7, 0.25)
    assert dtp.escape
    assert (dtp.candidates, dtp.objective) == (CANDIDATES, OBJECTIVE)
    atp = by_name("atp", problem(controller=SETTINGS))
    assert isinstance(atp, ATP)
    assert (atp.initial, atp.min_dwell, atp.latency_ms) == ("HYB", 7, 40.0)
    fastest = by_name("latency-first", problem(controller=SETTINGS))
    assert isinstance(fastest, LatencyFirst)
    assert fastest.initial == "HYB"
    in_hindsight = by_name("work-function", problem(controller=SETTINGS))
    assert isinstance(in_hindsight, WorkFunction)
    assert (in_hindsight.initial, in_hindsight.objective) == ("HYB", OBJECTIVE)
    cumulative = by_name("cusum", problem(controller=SETTINGS))
    assert isinstance(cumulative, Cusum)
    assert (cumulative.initial, cumulative.slack) == ("HYB", 0.25)


def test_dtp_does_not_escape_unless_it_is_told_to() -> None:
    dtp = by_name("dtp", problem())
    assert isinstance(dtp, DTP)
    assert not dtp.escape


def test_a_candidate_by_name_is_static_whatever_the_initial_one_is() -> None:
    static = by_name("SO", problem(controller=SETTINGS))
    assert isinstance(static, Static)
    assert (static.initial, static.incumbent) == ("SO", "SO")


def test_an_unknown_name_is_answered_with_the_nearest_and_all() -> None:
    known = "dtp, atp, atp-thresholds, latency-first, work-function, cusum, replicate, LOC, SO, HYB"
    expected = f"unknown policy 'dpt'; did you mean 'dtp'.*{known}"
    with pytest.raises(PolicyError, match=expected):
        by_name("dpt", problem())


@pytest.mark.parametrize(
    ("initial", "pair"),
    [("LOC", ("LOC", "HYB")), ("HYB", ("LOC", "HYB")), ("SO", ("HYB", "SO"))],
)
def test_atp_toggles_around_the_initial_candidate(initial: str, pair: tuple[str, str]) -> None:
    atp = by_name("atp", problem(controller=ControllerSettings(initial=initial)))
    assert isinstance(atp, ATP)
    assert atp.pair[:2] == pair


@pytest.mark.parametrize(
    ("perception_ms", "planning_ms", "task"),
    [(18.0, 9.0, "perception"), (9.0, 18.0, "planning"), (9.0, 9.0, "perception")],
)
def test_atp_toggles_the_task_that_is_heaviest_on_the_robot(
    perception_ms: float, planning_ms: float, task: str
) -> None:
    cell = problem(
        controller=ControllerSettings(initial="HYB"),
        perception_ms=perception_ms,
        planning_ms=planning_ms,
    )
    atp = by_name("atp", cell)
    assert isinstance(atp, ATP)
    assert atp.pair.task == task


def test_atp_without_a_pair_explains_itself() -> None:
    candidates = {"FAR": place("E", "E"), "LOC": place("R1", "R2")}
    with pytest.raises(PolicyError, match="differ in exactly one task"):
        by_name("atp", problem(candidates))
    one = {"LOC": place("R1", "R2")}
    with pytest.raises(PolicyError, match="among LOC"):
        by_name("atp", problem(one))


def test_a_name_that_is_a_policys_and_a_candidates_is_refused() -> None:
    with pytest.raises(PolicyError, match="'dtp' is a policy's name and a candidate's"):
        by_name("dtp", problem({"dtp": place("R1", "R2"), "SO": place("E", "E")}))
