"""Cusum against a second writing of its rule, its bound, and its corner cases by hand."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cost import ERRORS
from dwell.errors import MetricError, PolicyError
from dwell.model import Caps, Decision, Objective, Placement, QoS, Targets, Weights
from dwell.policies import Cusum, check_policy
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, place, problem, qos
from tests.reference.algorithm_1 import doubt, price, worst

#: J is L95 in milliseconds, moves are free, and nothing is forbidden.
BARE = Objective(
    weights=Weights(latency=1, violations=0, robot=0, edge=0, switching=0),
    targets=Targets(latency_ms=1),
    caps=Caps(),
    tiers=OBJECTIVE.tiers,
)

latencies = st.sampled_from([10.0, 20.0, 40.0, 120.0, 150.0]) | st.floats(0, 400)
shares = st.sampled_from([0.0, 0.5, 1.0]) | st.floats(0, 1)
metrics = st.builds(
    QoS,
    l95_ms=latencies,
    violation_rate=shares,
    utilisation=st.fixed_dictionaries(dict.fromkeys(OBJECTIVE.tiers, shares)),
)
windows = st.lists(st.fixed_dictionaries(dict.fromkeys(CANDIDATES, metrics)), max_size=40)
thresholds = st.sampled_from([0.0, 0.4, 1.0, 5.0])
slacks = st.sampled_from([0.0, 0.05, 0.5])
memories = st.sampled_from([0.1, 0.7, 1.0])


def bare(threshold: float = 4.0, slack: float = 0.0, memory: float = 1.0) -> Cusum:
    return Cusum(
        candidates=CANDIDATES,
        initial="LOC",
        objective=BARE,
        threshold=threshold,
        slack=slack,
        memory=memory,
    )


def costs(loc: float, so: float, hyb: float) -> dict[str, QoS]:
    """Metrics whose J under `BARE` are these."""
    return estimates(qos(loc), qos(so), qos(hyb))


def run(policy: Cusum, shown: Sequence[Mapping[str, QoS]]) -> list[Decision]:
    """Return its decisions when the incumbent's estimate is what was observed."""
    decisions = []
    for window in shown:
        observed = window[policy.incumbent]
        decisions.append(policy.decide(observed=observed, estimates=window))
    return decisions


def names(policy: Cusum, shown: Sequence[Mapping[str, QoS]]) -> list[str]:
    return [decision.name for decision in run(policy, shown)]


# ----------------------------------------------------------------------------------- the rule


errors = st.none() | st.tuples(st.sampled_from([0.0, 2.0, 40.0]), st.sampled_from([0.0, 0.1]))
erring = st.builds(lambda one, error: replace(one, error=error), metrics, errors)


@given(
    windows | st.lists(st.fixed_dictionaries(dict.fromkeys(CANDIDATES, erring)), max_size=40),
    st.none() | metrics,
    thresholds,
    slacks,
    memories,
)
def test_it_is_the_rule_as_it_is_written_down(
    shown: list[dict[str, QoS]],
    observed: QoS | None,
    threshold: float,
    slack: float,
    memory: float,
) -> None:
    """Whatever was observed: what is compared are estimates."""
    policy = Cusum(
        candidates=CANDIDATES,
        initial="LOC",
        objective=OBJECTIVE,
        threshold=threshold,
        slack=slack,
        memory=memory,
    )
    now, dwell, sums = "LOC", 0, dict.fromkeys(CANDIDATES, 0.0)
    for window in shown:
        decision = policy.decide(observed=observed or window[now], estimates=window)
        J = {s: price(window[s], CANDIDATES[s], CANDIDATES[now], OBJECTIVE) for s in CANDIDATES}
        stays = price(window[now], CANDIDATES[now], CANDIDATES[now], OBJECTIVE)
        excess = {s: worst(window[s], OBJECTIVE) for s in CANDIDATES}
        within = [s for s in CANDIDATES if excess[s] <= 0]
        allowed = within or [s for s in CANDIDATES if excess[s] <= min(excess.values()) + 1e-6]
        for s in CANDIDATES:
            gain = stays - J[s] - (slack + doubt(window[s], window[now], OBJECTIVE))
            sums[s] = max(0.0, memory * sums[s] + gain) if s != now else 0.0
        due = [s for s in allowed if sums[s] > threshold + 1e-9]
        best = min(due, key=J.__getitem__, default=now)
        moves = best != now and stays - J[best] > 1e-9
        assert decision.delta_j == (stays - J[best] if due else 0.0)
        now = best if moves else now
        dwell = 0 if moves else dwell + 1
        if moves:
            sums = dict.fromkeys(CANDIDATES, 0.0)
        assert policy.sums == sums
        assert (decision.name, decision.migrated, decision.dwell) == (now, moves, dwell)
        assert decision.placement == CANDIDATES[now]
        left_out = any(J[s] < J[best] for s in CANDIDATES if s not in within)
        moved = "capped" if left_out else "migrate"
        assert decision.reason == ("infeasible" if not within else moved if moves else "hold")
        assert decision.costs == J
        assert policy.incumbent == now


@given(windows, st.sampled_from([0.4, 1.0, 5.0]), slacks, memories)
def test_migrations_are_bounded_by_what_they_are_worth(
    shown: list[dict[str, QoS]], threshold: float, slack: float, memory: float
) -> None:
    policy = Cusum(
        candidates=CANDIDATES,
        objective=OBJECTIVE,
        threshold=threshold,
        slack=slack,
        memory=memory,
    )
    worth, migrations = 0.0, 0
    for window in shown:
        now = policy.incumbent
        decision = policy.decide(observed=window[now], estimates=window)
        gain = decision.costs[now] - min(decision.costs.values()) - slack
        worth += max(0.0, gain)
        migrations += decision.migrated
        assert migrations * threshold <= worth * (1 + 1e-12)


def test_the_bound_on_migrations_is_nearly_reached() -> None:
    policy, migrations = bare(threshold=1.0), 0
    for _ in range(40):
        shown = {name: qos(1.001 * (name == policy.incumbent)) for name in CANDIDATES}
        migrations += run(policy, [shown])[0].migrated
    assert migrations == 40


@given(metrics, slacks, memories, st.sampled_from([OBJECTIVE, BARE]))
def test_it_never_moves_on_equal_costs(
    same: QoS, slack: float, memory: float, objective: Objective
) -> None:
    policy = Cusum(
        candidates=CANDIDATES, objective=objective, threshold=0.0, slack=slack, memory=memory
    )
    assert names(policy, [estimates(same, same, same)] * 10) == ["LOC"] * 10


@given(windows, st.permutations(list(CANDIDATES)))
def test_the_order_of_the_estimates_means_nothing(
    shown: list[dict[str, QoS]], order: list[str]
) -> None:
    shuffled = [{name: window[name] for name in order} for window in shown]
    one, other = (Cusum(candidates=CANDIDATES, objective=OBJECTIVE) for _ in range(2))
    for mine, its in zip(run(one, shown), run(other, shuffled), strict=True):
        assert (mine.name, mine.reason, mine.costs) == (its.name, its.reason, its.costs)


# ------------------------------------------------------------------------------------ by hand


def test_small_advantages_add_up_and_fade() -> None:
    policy = bare(threshold=4.0, slack=1.0, memory=0.5)
    # An advantage of 4 is 3 beyond the slack: 3, 4.5.
    assert names(policy, [costs(14, 20, 10)]) == ["LOC"]
    assert policy.sums == {"LOC": 0.0, "SO": 0.0, "HYB": 3.0}
    # Nothing for a window: half of it is left, without another slack.
    assert names(policy, [costs(10, 20, 10)]) == ["LOC"]
    assert policy.sums["HYB"] == 0.5
    assert names(policy, [costs(14, 20, 10)] * 2) == ["LOC", "HYB"]
    assert set(policy.sums.values()) == {0.0}


def test_a_sum_must_exceed_the_threshold() -> None:
    assert names(bare(threshold=4.0), [costs(12, 20, 10)] * 3) == ["LOC", "LOC", "HYB"]


@pytest.mark.parametrize("tenths", range(1, 100))
def test_a_sum_equal_to_the_threshold_never_moves(tenths: int) -> None:
    """Ten windows with a tenth of the threshold each add up to it, but for rounding."""
    shown = costs(10 + tenths / 10, 200, 10)
    assert names(bare(threshold=float(tenths)), [shown] * 11) == ["LOC"] * 10 + ["HYB"]


def test_a_large_advantage_moves_at_once_however_late_the_last_move_was() -> None:
    policy = bare(threshold=4.0, slack=1.0)
    shown = [costs(15.1, 20, 10), costs(10, 20, 15.1), costs(15.1, 20, 10)]
    assert names(policy, shown) == ["HYB", "LOC", "HYB"]


@pytest.mark.parametrize(("advantage", "last"), [(1.7 - 1e-9, "LOC"), (1.7 + 1e-3, "HYB")])
def test_an_advantage_below_its_share_never_moves(advantage: float, last: str) -> None:
    policy = bare(threshold=4.0, slack=0.5, memory=0.7)
    assert names(policy, [costs(10 + advantage, 20, 10)] * 1000)[-1] == last


@pytest.mark.parametrize(("error", "last"), [(1.9, "HYB"), (2.1, "LOC")])
def test_an_advantage_within_its_error_never_adds_up(error: float, last: str) -> None:
    assert ERRORS == 1.0
    shown = costs(12, 20, 10) | {"HYB": replace(qos(10), error=(error, 0.0))}
    assert names(bare(threshold=4.0), [shown] * 1000)[-1] == last


def test_the_cheapest_of_those_due_is_chosen_not_the_one_with_the_largest_sum() -> None:
    policy = bare(threshold=4.0)
    run(policy, [costs(13, 10, 20)])
    decision = run(policy, [costs(20, 16, 10)])[0]
    assert (decision.name, decision.delta_j) == ("HYB", 10.0)


def test_the_sum_of_a_candidate_over_its_cap_goes_on_and_waits_until_it_is_cheaper() -> None:
    capped = replace(BARE, caps=Caps(latency_ms=120, utilisation=0.9))
    policy = Cusum(candidates=CANDIDATES, objective=capped, threshold=4.0, slack=0.0, memory=1.0)
    hot = QoS(10.0, 0.0, {"R1": 0.1, "E": 0.95, "R2": 0.1})
    shown = estimates(qos(14.0), qos(20.0), hot)
    assert names(policy, [shown] * 3) == ["LOC"] * 3
    assert policy.sums["HYB"] == 12.0
    # Once it is within its cap, one window is enough, if it is cheaper in that.
    waits, moves = run(policy, [costs(10, 20, 10), costs(10.1, 20, 10)])
    assert (waits.name, waits.reason, waits.delta_j) == ("LOC", "hold", 0.0)
    assert (moves.name, moves.reason) == ("HYB", "migrate")


def test_where_none_is_eligible_the_least_excess_is_compared() -> None:
    policy = Cusum(candidates=CANDIDATES, objective=OBJECTIVE)
    shown = estimates(qos(110.0, 0.9, 1.0), qos(20.0, 0.0, 1.0), qos(30.0, 0.0, 1.0))
    decision = run(policy, [shown])[0]
    assert (decision.name, decision.reason, decision.migrated) == ("SO", "infeasible", True)
    stays = run(policy, [shown])[0]
    assert (stays.name, stays.reason, stays.dwell) == ("SO", "infeasible", 1)


def test_candidates_pay_for_the_move_and_the_incumbent_does_not() -> None:
    policy = Cusum(candidates=CANDIDATES, objective=OBJECTIVE, threshold=4.0, slack=0.0)
    first = run(policy, [estimates(qos(400.0, 1.0), qos(20.0), qos(20.0))])[0]
    assert first.name == "HYB"
    # 10 + 3 - 0.5 - 0.125 was the advantage of HYB; that of LOC over HYB is 0 now, not 0.125.
    assert first.delta_j == pytest.approx(12.375)
    second = run(policy, [estimates(qos(20.0), qos(20.0), qos(20.0))])[0]
    assert second.costs == {"LOC": 0.625, "SO": 0.625, "HYB": 0.5}
    assert set(policy.sums.values()) == {0.0}


def test_one_candidate_always_holds() -> None:
    policy = Cusum(candidates={"LOC": place("R1", "R2")}, objective=OBJECTIVE)
    for k in range(1, 4):
        decision = policy.decide(observed=qos(50.0), estimates={"LOC": qos(50.0)})
        assert (decision.name, decision.reason, decision.dwell) == ("LOC", "hold", k)


# ------------------------------------------------------------------- what others do with it


def test_start_makes_it_forget() -> None:
    policy = bare()
    shown = [costs(13, 20, 10)] * 3
    first = run(policy, shown)
    assert policy.incumbent == "HYB"
    run(policy, [costs(10, 20, 13)])
    policy.start(problem())
    assert (policy.incumbent, set(policy.sums.values())) == ("LOC", {0.0})
    assert repr(run(policy, shown)) == repr(first)


def test_it_adopts_where_the_guard_moved_the_cell() -> None:
    policy = bare()
    run(policy, [costs(13, 20, 10)])
    with pytest.raises(PolicyError, match="'NOWHERE', which is no candidate"):
        policy.adopt("NOWHERE")
    assert policy.sums["HYB"] == 3.0
    policy.adopt("SO")
    assert (policy.incumbent, set(policy.sums.values())) == ("SO", {0.0})
    assert names(policy, [costs(13, 15, 12)]) == ["SO"]
    assert policy.sums == {"LOC": 2.0, "SO": 0.0, "HYB": 3.0}


def test_it_keeps_its_word_in_awkward_windows() -> None:
    assert check_policy(Cusum(candidates=CANDIDATES, objective=OBJECTIVE), problem()) == ()


# ------------------------------------------------------------------------------------- errors

GOOD = costs(13, 20, 10)
BARE_NODE = QoS(10.0, 0.0, {"E": 0.1, "R2": 0.1})


@pytest.mark.parametrize(
    ("observed", "shown", "message"),
    [
        (qos(13.0), {"LOC": qos(13.0), "SO": qos(20.0)}, "estimates has nothing for candidate HYB"),
        (qos(13.0), None, "estimates is None"),
        (None, GOOD, "observed is None; it must be a QoS"),
        (qos(13.0), {**GOOD, "SO": BARE_NODE}, "the estimate of SO has no utilisation of R1"),
        (qos(13.0), {**GOOD, "SO": None}, "the estimate of SO is None; it must be a QoS"),
        (qos(13.0), {**GOOD, "HYB": qos(1.7e308)}, "the estimate of HYB, .*, has no finite J"),
    ],
)
def test_metrics_that_are_wrong_change_nothing(
    observed: QoS, shown: dict[str, QoS], message: str
) -> None:
    heavy = replace(OBJECTIVE, weights=replace(OBJECTIVE.weights, latency=1e3))
    policy = Cusum(candidates=CANDIDATES, objective=heavy, threshold=1e6)
    run(policy, [GOOD] * 2)
    sums, before = policy.sums, repr(run(policy, [GOOD]))
    again = Cusum(candidates=CANDIDATES, objective=heavy, threshold=1e6)
    run(again, [GOOD] * 2)
    assert again.sums == sums
    with pytest.raises(MetricError, match=message):
        again.decide(observed=observed, estimates=shown)
    assert again.sums == sums
    assert repr(run(again, [GOOD])) == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial": "HIB"}, "initial is 'HIB', which is no candidate; did you mean 'HYB'"),
        ({"threshold": -0.1}, "threshold is -0.1; it must be a number"),
        ({"threshold": float("inf")}, "threshold is inf"),
        ({"slack": -1}, "slack is -1; it must be a number"),
        ({"slack": float("nan")}, "slack is nan"),
        ({"memory": 0.0}, "memory is 0.0; it must be a number above 0"),
        ({"memory": 1.1}, "memory is 1.1"),
        ({"objective": None}, "objective is None; it must be an Objective"),
        ({"candidates": {}}, "candidates is empty"),
        (
            {"candidates": {"LOC": place("R1", "R2"), "X": Placement({"tracking": "E"})}},
            "candidates.X places tracking but candidates.LOC places sensing, perception",
        ),
    ],
)
def test_wrong_parameters_are_named(changes: dict[str, object], message: str) -> None:
    good: dict[str, object] = {"candidates": CANDIDATES, "objective": OBJECTIVE}
    with pytest.raises(PolicyError, match=message):
        Cusum(**{**good, **changes})  # type: ignore[arg-type]


def test_it_shows_its_parameters() -> None:
    shown = "Cusum(initial='LOC', threshold=4, slack=0, memory=1)"
    assert repr(bare()) == shown
    assert list(itertools.islice(bare().sums, 3)) == list(CANDIDATES)


def test_a_cell_divides_the_threshold_by_its_decisions_per_window() -> None:
    cell = problem()
    for share in (1, 4):
        every = cell.window_cycles // share
        settings = replace(cell.controller, decide_cycles=every)
        policy = Cusum.from_problem(replace(cell, controller=settings))
        assert policy.threshold == pytest.approx(0.4 * every / cell.window_cycles)
