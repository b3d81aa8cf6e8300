"""ATPThresholds: one task toggled by thresholds alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest

from dwell.errors import MetricError, PolicyError
from dwell.model import Objective, Placement, QoS, Targets, Tier
from dwell.policies import ATPThresholds
from dwell.policies.atp_thresholds import find_pairs
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, place, problem, qos

CALM, SLOW = qos(40.0, 1.0, 0.7, 0.7), qos(40.1)
BUSY_ROBOT, BUSY_EDGE = qos(robot=0.71), qos(edge=0.71)


def atp(
    min_dwell: int = 0,
    initial: str = "LOC",
    candidates: Mapping[str, Placement] = CANDIDATES,
    objective: Objective = OBJECTIVE,
) -> ATPThresholds:
    return ATPThresholds(
        candidates=candidates, initial=initial, objective=objective, min_dwell=min_dwell
    )


def names(policy: ATPThresholds, observed: Sequence[QoS]) -> list[str]:
    return [policy.decide(observed=window).name for window in observed]


# ------------------------------------------------------------------------------------ toggling


def test_on_the_robot_a_threshold_must_be_exceeded() -> None:
    assert names(atp(), [CALM, BUSY_EDGE]) == ["LOC", "LOC"]
    assert names(atp(), [SLOW]) == ["HYB"]
    assert names(atp(), [BUSY_ROBOT]) == ["HYB"]


def test_offloaded_a_threshold_must_be_exceeded() -> None:
    assert names(atp(initial="HYB"), [CALM, BUSY_ROBOT]) == ["HYB", "HYB"]
    assert names(atp(initial="HYB"), [SLOW]) == ["LOC"]
    assert names(atp(initial="HYB"), [BUSY_EDGE]) == ["LOC"]


def test_it_never_asks_what_the_other_side_would_show() -> None:
    policy = atp()
    shown = estimates(qos(50.0), qos(500.0), qos(500.0))
    assert policy.decide(observed=shown["LOC"], estimates=shown).name == "HYB"


def test_both_sides_over_a_threshold_make_it_toggle_within_the_dwell() -> None:
    decisions = [policy.decide(observed=SLOW) for policy in [atp(2)] for _ in range(7)]
    assert [d.name for d in decisions] == ["LOC", "LOC", "HYB", "HYB", "HYB", "LOC", "LOC"]
    reasons = ["dwell", "dwell", "migrate", "dwell", "dwell", "migrate", "dwell"]
    assert [d.reason for d in decisions] == reasons
    assert [d.dwell for d in decisions] == [1, 2, 0, 1, 2, 0, 1]
    assert [d.migrated for d in decisions] == [reason == "migrate" for reason in reasons]


def test_decisions_are_complete() -> None:
    policy = atp()
    shown = estimates(qos(20.0), qos(20.0), qos(20.0))
    decision = policy.decide(observed=SLOW, estimates=shown)
    assert decision.placement == CANDIDATES["HYB"]
    assert decision.costs == {"LOC": 0.5, "SO": 0.75, "HYB": 0.625}
    assert math.isnan(decision.delta_j)
    assert policy.decide(observed=CALM).reason == "hold"


def test_thresholds_of_its_own() -> None:
    policy = ATPThresholds(
        candidates=CANDIDATES,
        objective=OBJECTIVE,
        latency_ms=10.0,
        robot=math.inf,
        edge=0.2,
        min_dwell=0,
    )
    assert names(policy, [qos(10.0, robot=1.0), qos(10.1)]) == ["LOC", "HYB"]
    assert names(policy, [qos(10.0, edge=0.2), qos(1.0, edge=0.21)]) == ["HYB", "LOC"]


def test_a_cloud_weighed_apart_has_its_own_threshold() -> None:
    tiers: dict[str, Tier] = {"R1": "robot", "R2": "robot", "E": "edge", "C": "cloud"}
    weights = replace(OBJECTIVE.weights, cloud=0.1)
    apart = replace(
        OBJECTIVE,
        tiers=tiers,
        weights=weights,
        targets=Targets(40.0, cloud=0.3),
    )
    together = replace(OBJECTIVE, tiers=tiers)
    candidates = {"LOC": place("R1", "R2"), "CLOUD": place("C", "R2")}
    for edge, cloud, with_apart, with_together in [
        (1.0, 0.0, "CLOUD", "LOC"),
        (0.0, 0.31, "LOC", "CLOUD"),
        (0.0, 0.3, "CLOUD", "CLOUD"),
    ]:
        shown = QoS(1.0, 0.0, {"R1": 0.0, "R2": 0.0, "E": edge, "C": cloud})
        assert names(atp(0, "CLOUD", candidates, apart), [shown]) == [with_apart]
        assert names(atp(0, "CLOUD", candidates, together), [shown]) == [with_together]


def test_from_neither_side_it_goes_by_where_the_task_is() -> None:
    # SO has perception on the edge, as HYB does: it is the offloaded side of LOC | HYB.
    policy = ATPThresholds(
        candidates=CANDIDATES, initial="SO", objective=OBJECTIVE, local="LOC", min_dwell=0
    )
    assert policy.pair == ("LOC", "HYB", "perception")
    assert names(policy, [BUSY_ROBOT, BUSY_EDGE]) == ["SO", "LOC"]


def test_start_and_adopt() -> None:
    policy = atp(1)
    assert names(policy, [SLOW, SLOW]) == ["LOC", "HYB"]
    policy.adopt("LOC")
    assert names(policy, [SLOW, SLOW]) == ["LOC", "HYB"]
    policy.start(problem())
    assert names(policy, [SLOW, SLOW]) == ["LOC", "HYB"]


# ---------------------------------------------------------------------------------------- pairs


def test_pairs_differ_in_one_task_between_robot_and_edge() -> None:
    assert find_pairs(CANDIDATES, OBJECTIVE.tiers) == (
        ("LOC", "HYB", "perception"),
        ("HYB", "SO", "planning"),
    )


@pytest.mark.parametrize(
    ("initial", "pair"),
    [
        ("LOC", ("LOC", "HYB", "perception")),
        ("HYB", ("LOC", "HYB", "perception")),
        ("SO", ("HYB", "SO", "planning")),
    ],
)
def test_the_pair_contains_the_initial_candidate(initial: str, pair: tuple[str, str, str]) -> None:
    assert atp(initial=initial).pair == pair


def test_a_side_may_be_named() -> None:
    policy = ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, offload="SO", min_dwell=0)
    assert policy.pair == ("HYB", "SO", "planning")
    # It starts on LOC, which has planning on the robot.
    assert names(policy, [SLOW]) == ["SO"]


def test_without_a_pair_around_the_initial_candidate_it_takes_another() -> None:
    candidates = {name: CANDIDATES[name] for name in ("LOC", "HYB")}
    policy = atp(0, "ODD", {"ODD": place("R2", "E"), **candidates})
    assert policy.pair == ("LOC", "HYB", "perception")
    assert names(policy, [BUSY_EDGE, BUSY_ROBOT, BUSY_EDGE]) == ["ODD", "HYB", "LOC"]


def test_moves_between_robots_make_no_pair() -> None:
    candidates = {"A": place("R1", "R2"), "B": place("R2", "R2"), "C": place("E", "E")}
    assert find_pairs(candidates, OBJECTIVE.tiers) == ()
    with pytest.raises(PolicyError, match="no pair qualifies among A, B, C"):
        atp(initial="A", candidates=candidates)


# --------------------------------------------------------------------------------------- errors


def test_wrong_parameters_are_named() -> None:
    with pytest.raises(PolicyError, match="min_dwell is -1"):
        atp(min_dwell=-1)
    with pytest.raises(PolicyError, match=r"initial is 'HIB', .* did you mean 'HYB'"):
        atp(initial="HIB")
    with pytest.raises(PolicyError, match="latency_ms is -1"):
        ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, latency_ms=-1)
    with pytest.raises(PolicyError, match="robot is nan"):
        ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, robot=math.nan)
    with pytest.raises(PolicyError, match=r"edge is -0\.5"):
        ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, edge=-0.5)
    with pytest.raises(PolicyError, match="offload is 'NOWHERE'"):
        ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, offload="NOWHERE")
    with pytest.raises(PolicyError, match="no pair with local='LOC', offload='SO' qualifies"):
        ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, local="LOC", offload="SO")


def test_missing_metrics_are_an_error() -> None:
    with pytest.raises(MetricError, match="observed is None"):
        atp().decide(observed=None)  # type: ignore[arg-type]
    with pytest.raises(MetricError, match="observed has no utilisation of E"):
        atp().decide(observed=QoS(1.0, 0.0, {"R1": 0.0, "R2": 0.0}))
    with pytest.raises(MetricError, match="nothing for candidate SO"):
        atp().decide(observed=qos(), estimates={"LOC": qos()})
