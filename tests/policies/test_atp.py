"""ATP: thresholds open the question, a cost of three terms answers it, on means of windows."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cost import ERRORS
from dwell.errors import MetricError, PolicyError
from dwell.model import Problem, QoS
from dwell.policies import ATP, ATPThresholds, by_name, check_policy
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, problem, qos

SLOW = 50.0  # milliseconds; the threshold is 40


def timed(period_ms: float, window_cycles: int = 10) -> Problem:
    """The cell with windows of another length."""
    base = problem()
    pipeline = replace(base.pipeline, period_ms=period_ms, deadline_ms=period_ms)
    controller = replace(base.controller, decide_cycles=window_cycles)
    return replace(base, pipeline=pipeline, window_cycles=window_cycles, controller=controller)


def atp(min_dwell: int = 0, window_ms: float = 2000.0, every_ms: float = 2000.0) -> ATP:
    policy = ATP(candidates=CANDIDATES, objective=OBJECTIVE, min_dwell=min_dwell, every_ms=every_ms)
    policy.start(timed(window_ms / 10))
    return policy


def play(policy: ATP, shown: Sequence[Mapping[str, QoS]]) -> list[tuple[str, str]]:
    """Return placement and reason of every window."""
    decisions: list[tuple[str, str]] = []
    for window in shown:
        decision = policy.decide(observed=window[policy.incumbent], estimates=window)
        decisions.append((decision.name, decision.reason))
    return decisions


# -------------------------------------------------------------------------- question and answer


def test_a_threshold_alone_moves_nothing() -> None:
    same = estimates(qos(SLOW), qos(SLOW), qos(SLOW))
    assert play(atp(), [same] * 3) == [("LOC", "hold")] * 3
    by_thresholds = ATPThresholds(candidates=CANDIDATES, objective=OBJECTIVE, min_dwell=0)
    assert by_thresholds.decide(observed=qos(SLOW), estimates=same).name == "HYB"


def test_a_cheaper_side_alone_moves_nothing() -> None:
    assert play(atp(), [estimates(qos(40.0), qos(1.0), qos(1.0))]) == [("LOC", "hold")]


def test_a_threshold_and_a_cheaper_side_move_it() -> None:
    shown = estimates(qos(SLOW), qos(1.0), qos(30.0))
    assert play(atp(), [shown]) == [("HYB", "migrate")]


def test_violations_are_in_neither() -> None:
    """The other side misses every deadline, and is cheaper by latency."""
    shown = estimates(qos(SLOW, 0.0), qos(1.0), qos(20.0, 1.0))
    assert play(atp(), [shown]) == [("HYB", "migrate")]
    assert shown["HYB"].violation_rate == 1.0
    shown = estimates(qos(30.0, 1.0), qos(1.0), qos(20.0))
    assert play(atp(), [shown]) == [("LOC", "hold")]


def test_the_switch_has_its_price() -> None:
    """One task of two, times 0.5; 10 ms are 0.25 of the target."""
    assert OBJECTIVE.weights.switching == 0.5
    price_ms = 40.0 * 0.5 * 0.25
    for l95_ms, name in ((SLOW - price_ms - 0.01, "HYB"), (SLOW - price_ms + 0.01, "LOC")):
        moved = ATP(candidates=CANDIDATES, objective=OBJECTIVE, min_dwell=0)
        share = len(CANDIDATES["LOC"].moved(CANDIDATES["HYB"])) / len(CANDIDATES["LOC"])
        assert share == 0.25
        shown = estimates(qos(SLOW), qos(1.0), qos(l95_ms))
        assert moved.decide(observed=shown["LOC"], estimates=shown).name == name


@pytest.mark.parametrize("l95_ms", range(101, 120))
def test_a_switch_that_costs_all_that_it_saves_is_not_made(l95_ms: int) -> None:
    """The switch costs 0.125, or 12.5 ms of 100: in floats sometimes a little less."""
    objective = replace(OBJECTIVE, targets=replace(OBJECTIVE.targets, latency_ms=100.0))
    policy = ATP(candidates=CANDIDATES, objective=objective, min_dwell=0)
    shown = estimates(qos(float(l95_ms)), qos(1.0), qos(l95_ms - 12.5))
    assert play(policy, [shown]) == [("LOC", "hold")]


@pytest.mark.parametrize(("error_ms", "name"), [(9.9, "HYB"), (10.1, "LOC")])
@pytest.mark.parametrize("of", ["LOC", "HYB"])
def test_it_must_save_more_than_its_error_in_latency(of: str, error_ms: float, name: str) -> None:
    """Of V_D it does not look at, nor at the error; the switch costs 5 ms."""
    assert ERRORS == 1.0
    shown = estimates(qos(SLOW), qos(1.0), qos(SLOW - 15.0))
    shown[of] = replace(shown[of], error=(error_ms, 1.0))
    assert play(atp(), [shown]) == [(name, "migrate" if name == "HYB" else "hold")]
    two = [shown, {**shown, of: replace(shown[of], error=None)}]
    assert play(atp(window_ms=1000.0), two)[-1] == ("HYB", "migrate")


def test_thresholds_are_of_what_was_observed_and_costs_of_what_was_estimated() -> None:
    policy, fast = atp(), estimates(qos(20.0), qos(1.0), qos(10.0))
    assert policy.decide(observed=qos(20.0), estimates=fast).name == "LOC"
    # 10 ms less, of which the switch costs 5.
    decision = policy.decide(observed=qos(SLOW), estimates=fast)
    assert decision.name == "HYB"
    assert decision.delta_j == pytest.approx(0.125)


def test_what_moving_saves_is_recorded() -> None:
    shown = estimates(qos(SLOW, 0.5), qos(1.0), qos(30.0))
    decision = atp().decide(observed=shown["LOC"], estimates=shown)
    assert decision.delta_j == pytest.approx(20.0 / 40.0 - 0.5 * 0.25)
    assert decision.costs["LOC"] == pytest.approx(50 / 40 + 3 * 0.5)
    calm = estimates(qos(1.0), qos(1.0), qos(1.0))
    assert math.isnan(atp().decide(observed=calm["LOC"], estimates=calm).delta_j)


# ------------------------------------------------------------------------------- every two seconds


@pytest.mark.parametrize(
    ("window_ms", "every_ms", "windows"),
    [
        (2000.0, 2000.0, 1),
        (1000.0, 2000.0, 2),
        (300.0, 2000.0, 7),
        (3333.0, 2000.0, 1),
        (100_000.0, 2000.0, 1),
        (500.0, 1000.0, 2),
        (1500.0, 2000.0, 1),
    ],
)
def test_windows_are_taken_together(window_ms: float, every_ms: float, windows: int) -> None:
    policy = atp(window_ms=window_ms, every_ms=every_ms)
    shown = estimates(qos(SLOW), qos(1.0), qos(1.0))
    assert play(policy, [shown] * windows) == [("LOC", "hold")] * (windows - 1) + [
        ("HYB", "migrate")
    ]


def test_the_mean_counts_and_not_the_last_window() -> None:
    fast, slow = (estimates(qos(ms), qos(1.0), qos(1.0)) for ms in (20.0, 70.0))
    assert play(atp(window_ms=1000.0), [slow, fast]) == [("LOC", "hold"), ("HYB", "migrate")]
    assert play(atp(window_ms=1000.0), [fast, fast, slow, slow])[-1] == ("HYB", "migrate")
    fine = estimates(qos(20.0), qos(1.0), qos(1.0))
    assert play(atp(window_ms=500.0), [slow, fine, fine, fine])[-1] == ("LOC", "hold")


def test_a_dwell_is_counted_in_windows_and_a_move_begins_anew() -> None:
    away = estimates(qos(SLOW), qos(1.0), qos(SLOW))
    away["HYB"] = qos(SLOW)
    back = {**away, "LOC": qos(1.0)}
    policy = atp(3, 1000.0)
    shown = [estimates(qos(SLOW), qos(1.0), qos(1.0))] * 4 + [back] * 5
    reasons = ["dwell", "dwell", "dwell", "migrate", "dwell", "dwell", "dwell", "migrate", "dwell"]
    assert [reason for _, reason in play(policy, shown)] == reasons


def test_somebody_elses_move_begins_anew() -> None:
    policy = atp(window_ms=1000.0)
    slow = estimates(qos(SLOW), qos(1.0), qos(1.0))
    play(policy, [slow])
    policy.adopt("LOC")
    assert play(policy, [slow, slow]) == [("LOC", "hold"), ("HYB", "migrate")]


def test_never_started_it_decides_at_every_close() -> None:
    policy = ATP(candidates=CANDIDATES, objective=OBJECTIVE, min_dwell=0)
    assert play(policy, [estimates(qos(SLOW), qos(1.0), qos(1.0))]) == [("HYB", "migrate")]


# ---------------------------------------------------------------------------- the rule, once more

METRICS = st.tuples(
    st.sampled_from([5.0, 39.0, 40.0, 41.0, 80.0]), *[st.sampled_from([0.0, 0.5, 0.71, 1.0])] * 2
)


@given(
    st.lists(st.tuples(METRICS, METRICS, METRICS), min_size=1, max_size=30),
    st.integers(0, 3),
    st.sampled_from([300.0, 1000.0, 2000.0, 5000.0]),
)
def test_it_is_the_rule_as_it_is_written_down(
    shown: list[tuple[tuple[float, float, float], ...]], min_dwell: int, window_ms: float
) -> None:
    policy = atp(min_dwell, window_ms)
    size = max(1, round(2000.0 / window_ms))
    now, dwell = "LOC", 0
    seen: list[tuple[tuple[float, float, float], ...]] = []
    weights, targets = OBJECTIVE.weights, OBJECTIVE.targets

    def cost(metrics: Sequence[float], moved: float) -> float:
        l95_ms, robot, edge = metrics
        return (
            weights.latency * l95_ms / targets.latency_ms
            + weights.robot * robot / targets.robot
            + weights.edge * edge / targets.edge
            + weights.switching * moved
        )

    for row in shown:
        window = {
            name: qos(ms, 0.3, robot, edge)
            for name, (ms, robot, edge) in zip(CANDIDATES, row, strict=True)
        }
        decision = policy.decide(observed=window[now], estimates=window)
        seen.append(row)
        expected, reason = now, "dwell" if dwell < min_dwell else "hold"
        if len(seen) == size:
            columns = dict(zip(CANDIDATES, zip(*seen, strict=True), strict=True))
            mean = {
                name: [sum(values) / size for values in zip(*column, strict=True)]
                for name, column in columns.items()
            }
            here = mean[now]
            busy = here[1] > targets.robot if now == "LOC" else here[2] > targets.edge
            other = "HYB" if now == "LOC" else "LOC"
            asked = here[0] > targets.latency_ms or busy
            if reason == "hold" and asked and cost(mean[other], 0.25) < cost(here, 0.0):
                expected, reason = other, "migrate"
            seen = []
        dwell = 0 if expected != now else dwell + 1
        now = expected
        assert (decision.name, decision.reason, decision.dwell) == (expected, reason, dwell)


# ------------------------------------------------------------------------------------- contracts


def test_it_keeps_its_word_in_awkward_windows() -> None:
    for window_ms in (500.0, 2000.0):
        cell = timed(window_ms / 10)
        assert check_policy(by_name("atp", cell), cell) == ()


def test_a_copy_goes_its_own_way() -> None:
    policy = atp(window_ms=1000.0)
    slow = estimates(qos(SLOW), qos(1.0), qos(1.0))
    play(policy, [slow])
    twin = copy.deepcopy(policy)
    assert play(twin, [slow]) == [("HYB", "migrate")]
    assert play(policy, [slow]) == [("HYB", "migrate")]


def test_the_answer_needs_estimates() -> None:
    policy = atp(window_ms=1000.0)
    assert policy.decide(observed=qos(20.0)).reason == "hold"
    with pytest.raises(MetricError, match="estimates is None in 2 of the 2 windows decided on"):
        policy.decide(observed=qos(90.0))
    # Nothing has changed: the same window again, and one in which nothing asks.
    assert policy.decide(observed=qos(20.0)).reason == "hold"


@pytest.mark.parametrize("every_ms", [0.0, -1.0, math.nan, math.inf])
def test_the_time_between_decisions_is_checked(every_ms: float) -> None:
    with pytest.raises(PolicyError, match="every_ms is"):
        ATP(candidates=CANDIDATES, objective=OBJECTIVE, every_ms=every_ms)
