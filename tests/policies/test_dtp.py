"""DTP against a second writing of Algorithm 1, and every corner case by hand."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cost import ERRORS, cost, excess
from dwell.errors import DwellError, MetricError, PlacementError, PolicyError
from dwell.model import Caps, Decision, Objective, Placement, QoS
from dwell.policies import DTP, check_policy
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, place, problem, qos
from tests.reference.algorithm_1 import algorithm_1

NO_CAPS = replace(OBJECTIVE, caps=Caps())

# Few values and many ties beside anything at all; some are over the caps (120 ms, 0.98).
latencies = st.sampled_from([10.0, 20.0, 40.0, 120.0, 150.0]) | st.floats(0, 400)
shares = st.sampled_from([0.0, 0.5, 1.0]) | st.floats(0, 1)
metrics = st.builds(
    QoS,
    l95_ms=latencies,
    violation_rate=shares,
    utilisation=st.fixed_dictionaries(dict.fromkeys(OBJECTIVE.tiers, shares)),
)
errors = st.none() | st.tuples(st.sampled_from([0.0, 2.0, 40.0]), st.sampled_from([0.0, 0.1]))
erring = st.builds(lambda one, error: replace(one, error=error), metrics, errors)
windows = st.lists(st.fixed_dictionaries(dict.fromkeys(CANDIDATES, metrics)), max_size=40)


def dtp(
    min_dwell: int = 0,
    min_improvement: float = 0.05,
    initial: str = "LOC",
    objective: Objective = OBJECTIVE,
) -> DTP:
    return DTP(
        candidates=CANDIDATES,
        initial=initial,
        objective=objective,
        min_dwell=min_dwell,
        min_improvement=min_improvement,
    )


def run(
    policy: DTP, shown: Sequence[Mapping[str, QoS]], observed: QoS | None = None
) -> list[Decision]:
    """Return its decisions; where None, the incumbent's estimate is what was observed."""
    decisions = []
    for window in shown:
        seen = observed or window[policy.incumbent]
        decisions.append(policy.decide(observed=seen, estimates=window))
    return decisions


# ------------------------------------------------------------------------------ the algorithm


@given(
    windows | st.lists(st.fixed_dictionaries(dict.fromkeys(CANDIDATES, erring)), max_size=40),
    st.none() | metrics,
    st.sampled_from(list(CANDIDATES)),
    st.integers(0, 4),
    st.sampled_from([0.0, 0.05, 0.5]),
    st.sampled_from([OBJECTIVE, NO_CAPS]),
)
def test_it_is_algorithm_1(
    shown: list[dict[str, QoS]],
    observed: QoS | None,
    initial: str,
    min_dwell: int,
    min_improvement: float,
    objective: Objective,
) -> None:
    """Whatever was observed: what is compared are estimates."""
    policy = dtp(min_dwell, min_improvement, initial, objective)
    expected = algorithm_1(shown, CANDIDATES, initial, objective, min_dwell, min_improvement)
    for decision, row in zip(run(policy, shown, observed), expected, strict=True):
        assert decision.name == row.placement
        assert decision.placement == CANDIDATES[row.placement]
        assert decision.migrated == row.migrated
        assert decision.reason == row.reason
        assert decision.dwell == row.dwell
        assert decision.costs == row.costs
        assert decision.delta_j == row.delta_j or math.isnan(decision.delta_j + row.delta_j)


@given(
    windows,
    st.integers(1, 12).flatmap(lambda width: st.tuples(st.just(width), st.integers(1, width))),
    st.integers(0, 3),
    st.integers(0, 40),
)
def test_it_is_algorithm_1_however_often_it_decides(
    shown: list[dict[str, QoS]], often: tuple[int, int], min_dwell: int, least_cycles: int
) -> None:
    width, every = often
    cell = problem()
    controller = replace(
        cell.controller,
        decide_cycles=every,
        min_dwell=min_dwell,
        min_dwell_cycles=least_cycles,
        min_improvement=0.05,
    )
    policy = DTP.from_problem(replace(cell, window_cycles=width, controller=controller))
    expected = algorithm_1(
        shown,
        CANDIDATES,
        policy.incumbent,
        cell.objective,
        min_dwell,
        0.05,
        W=width,
        d=every,
        least_cycles=least_cycles,
    )
    for decision, row in zip(run(policy, shown), expected, strict=True):
        assert (decision.name, decision.reason) == (row.placement, row.reason)
        assert (decision.dwell, decision.dwell * every) == (row.dwell, row.run)


@given(windows, st.integers(0, 4))
def test_the_bound_on_migrations_holds_for_any_metrics(
    shown: list[dict[str, QoS]], min_dwell: int
) -> None:
    decisions = run(dtp(min_dwell, 0.0), shown)
    at = [k for k, decision in enumerate(decisions) if decision.migrated]
    assert len(at) <= len(shown) // (min_dwell + 1)
    assert all(later - earlier > min_dwell for earlier, later in itertools.pairwise(at))


@pytest.mark.parametrize("min_dwell", [0, 1, 3])
def test_the_bound_on_migrations_is_reached(min_dwell: int) -> None:
    good, bad = qos(10.0), qos(100.0)
    policy = dtp(min_dwell)
    migrations = 0
    for _ in range(41):
        shown = {name: bad if name == policy.incumbent else good for name in CANDIDATES}
        migrations += run(policy, [shown])[0].migrated
    assert migrations == 41 // (min_dwell + 1)


@given(st.lists(metrics, min_size=3, max_size=3), st.integers(0, 3))
def test_constant_exact_costs_cause_at_most_one_migration(shown: list[QoS], min_dwell: int) -> None:
    decisions = run(dtp(min_dwell), [estimates(*shown)] * 20)
    assert sum(decision.migrated for decision in decisions) <= 1


@given(windows, st.permutations(list(CANDIDATES)))
def test_the_order_of_the_estimates_means_nothing(
    shown: list[dict[str, QoS]], order: list[str]
) -> None:
    shuffled = [{name: window[name] for name in order} for window in shown]
    for one, other in zip(run(dtp(), shown), run(dtp(), shuffled), strict=True):
        assert (one.name, one.reason, one.costs) == (other.name, other.reason, other.costs)


# ------------------------------------------------------------------------------- corner cases


def test_the_first_windows_are_dwell_windows() -> None:
    shown = estimates(qos(100.0), qos(10.0), qos(10.0))
    decisions = run(dtp(3), [shown] * 4)
    assert [d.reason for d in decisions] == ["dwell", "dwell", "dwell", "migrate"]
    assert [d.dwell for d in decisions] == [1, 2, 3, 0]
    assert [d.name for d in decisions] == ["LOC", "LOC", "LOC", "HYB"]


def test_dwell_windows_are_priced_for_the_record() -> None:
    shown = estimates(qos(100.0), qos(10.0), qos(20.0))
    decision = run(dtp(3), [shown])[0]
    assert decision.costs == {
        name: cost(shown[name], CANDIDATES[name], CANDIDATES["LOC"], OBJECTIVE)
        for name in CANDIDATES
    }
    assert math.isnan(decision.delta_j)


def test_dwell_windows_need_no_estimates() -> None:
    policy = dtp(1)
    decision = policy.decide(observed=qos(100.0))
    assert (decision.reason, decision.costs, decision.dwell) == ("dwell", {}, 1)
    with pytest.raises(MetricError, match="estimates is None after the dwell"):
        policy.decide(observed=qos(100.0))


def test_an_improvement_must_exceed_the_threshold() -> None:
    # Without switching cost, 40 ms less is J less by exactly 1.
    free = replace(NO_CAPS, weights=replace(OBJECTIVE.weights, switching=0.0))
    shown = estimates(qos(80.0), qos(40.0), qos(80.0))
    still = run(dtp(0, 1.0, objective=free), [shown])[0]
    assert (still.name, still.reason, still.delta_j) == ("LOC", "hold", 1.0)
    moved = run(dtp(0, 1.0 - 2e-9, objective=free), [shown])[0]
    assert (moved.name, moved.reason, moved.migrated) == ("SO", "migrate", True)


@pytest.mark.parametrize("l95_ms", range(10, 100, 5))
def test_an_improvement_equal_to_the_threshold_never_moves(l95_ms: int) -> None:
    """5 ms of 100 are 0.05 of J: in floats sometimes a little more, sometimes a little less."""
    objective = replace(
        NO_CAPS,
        weights=replace(OBJECTIVE.weights, switching=0.0),
        targets=replace(OBJECTIVE.targets, latency_ms=100.0),
    )
    here, there = qos(float(l95_ms)), qos(l95_ms - 5.0)
    shown = [estimates(here, there, here)]
    assert run(dtp(0, 0.05, objective=objective), shown)[0].name == "LOC"
    assert algorithm_1(shown, CANDIDATES, "LOC", objective, 0, 0.05)[0].placement == "LOC"
    # A gain that is larger by more than rounding moves.
    assert run(dtp(0, 0.05 - 1e-8, objective=objective), shown)[0].name == "SO"
    assert algorithm_1(shown, CANDIDATES, "LOC", objective, 0, 0.05 - 1e-8)[0].placement == "SO"


def test_an_improvement_must_exceed_the_error_of_the_difference_too() -> None:
    free = replace(NO_CAPS, weights=replace(OBJECTIVE.weights, switching=0.0))
    assert ERRORS == 1.0

    def name(here: tuple[float, float] | None, there: tuple[float, float] | None) -> str:
        # 40 ms less, and J less by 1.
        loc, so = replace(qos(80.0), error=here), replace(qos(40.0), error=there)
        return run(dtp(0, 0.5, objective=free), [estimates(loc, so, qos(80.0))])[0].name

    assert name(None, None) == name((0.0, 0.0), None) == "SO"
    # 40 ms are 1 of J, as is a third of V_D; the two of one estimate are added.
    assert name((19.9, 0.0), None) == name(None, (19.9, 0.0)) == "SO"
    assert name((20.1, 0.0), None) == name(None, (20.1, 0.0)) == "LOC"
    assert (name((9.9, 0.25 / 3), None), name((10.1, 0.25 / 3), None)) == ("SO", "LOC")
    # Those of two estimates are not: 12 and 16 make 20.
    assert (name((12.0, 0.0), (15.9, 0.0)), name((12.0, 0.0), (16.1, 0.0))) == ("SO", "LOC")


def test_the_cheapest_is_tested_and_no_other_in_its_place() -> None:
    shown = estimates(qos(80.0), replace(qos(20.0), error=(90.0, 0.0)), qos(30.0))
    decision = run(dtp(), [shown])[0]
    assert (decision.name, decision.reason) == ("LOC", "hold")
    assert decision.delta_j == decision.costs["LOC"] - decision.costs["SO"]


def test_the_incumbents_cost_carries_the_switch_of_the_last_decision() -> None:
    policy = dtp(0, 0.0)
    shown = estimates(qos(100.0), qos(100.0), qos(20.0))
    # LOC -> HYB moves one task of four: 0.5 * 0.25 is charged to HYB's estimate, and once more
    # to HYB as the incumbent in the window after.
    first = policy.decide(observed=shown["LOC"], estimates=shown)
    assert first.name == "HYB"
    assert first.delta_j == pytest.approx(2.5 - 0.5 - 0.125)
    second = policy.decide(observed=shown["HYB"], estimates=shown)
    assert second.reason == "hold"
    assert second.delta_j == pytest.approx(0.125)
    third = policy.decide(observed=shown["HYB"], estimates=shown)
    assert (third.reason, third.delta_j) == ("hold", 0.0)


def test_candidates_pay_for_the_move_from_the_incumbent() -> None:
    decision = run(dtp(), [estimates(*[qos(20.0)] * 3)])[0]
    assert decision.costs == {"LOC": 0.5, "SO": 0.75, "HYB": 0.625}


def test_the_best_being_the_incumbent_is_a_hold_and_does_not_restart_the_dwell() -> None:
    policy = dtp(0, 0.0)
    policy.adopt("SO")
    shown = estimates(qos(30.0), qos(20.0), qos(30.0))
    # Delta J of the first window is what the move before it has cost, and means nothing.
    decisions = [policy.decide(observed=qos(110.0), estimates=shown) for _ in range(3)]
    assert [d.reason for d in decisions] == ["hold"] * 3
    assert [d.dwell for d in decisions] == [1, 2, 3]
    assert [d.delta_j for d in decisions] == [0.25, 0.0, 0.0]


@pytest.mark.parametrize("initial", list(CANDIDATES))
def test_ties_go_to_the_incumbent(initial: str) -> None:
    free = replace(NO_CAPS, weights=replace(OBJECTIVE.weights, switching=0.0))
    policy = dtp(0, 0.0, initial, free)
    decision = policy.decide(observed=qos(100.0), estimates=estimates(*[qos(20.0)] * 3))
    assert (decision.name, decision.reason) == (initial, "hold")


def test_ties_of_others_go_to_the_first_candidate() -> None:
    free = replace(NO_CAPS, weights=replace(OBJECTIVE.weights, switching=0.0))
    shown = estimates(qos(100.0), qos(20.0), qos(20.0))
    assert run(dtp(0, 0.0, "LOC", free), [shown])[0].name == "SO"
    turned = DTP(
        candidates={name: CANDIDATES[name] for name in ("HYB", "SO", "LOC")},
        initial="LOC",
        objective=free,
        min_dwell=0,
    )
    assert run(turned, [shown])[0].name == "HYB"


def test_a_candidate_over_the_latency_cap_is_not_eligible() -> None:
    far = replace(OBJECTIVE, weights=replace(OBJECTIVE.weights, latency=0.0))
    shown = estimates(qos(100.0, 0.9), qos(120.1, 0.0), qos(120.0, 0.5))
    decision = run(dtp(objective=far), [shown])[0]
    assert decision.costs["SO"] < decision.costs["HYB"]
    assert (decision.name, decision.reason) == ("HYB", "capped")


def test_a_candidate_over_the_utilisation_cap_of_one_node_is_not_eligible() -> None:
    hot = QoS(20.0, 0.0, {"R1": 0.1, "E": 0.981, "R2": 0.1})
    warm = QoS(20.0, 0.2, {"R1": 0.1, "E": 0.98, "R2": 0.1})
    decision = run(dtp(), [estimates(qos(100.0, 0.5), hot, warm)])[0]
    assert decision.costs["SO"] < decision.costs["HYB"]
    assert (decision.name, decision.reason) == ("HYB", "capped")


def test_an_incumbent_over_its_cap_is_left_only_for_an_improvement() -> None:
    over, within = qos(119.0, 0.0, robot=0.99), qos(119.0, 0.0, robot=0.97)
    decision = run(dtp(min_improvement=0.05), [estimates(over, over, within)])[0]
    assert decision.costs["HYB"] > decision.costs["LOC"]
    assert (decision.name, decision.reason, decision.migrated) == ("LOC", "hold", False)


def test_where_none_is_eligible_the_least_excess_is_compared_by_cost() -> None:
    # A stressed robot shows U = 1 under every placement.
    shown = estimates(qos(110.0, 0.9, 1.0), qos(20.0, 0.0, 1.0), qos(30.0, 0.0, 1.0))
    decision = run(dtp(), [shown])[0]
    assert decision.costs["SO"] == min(decision.costs.values())
    assert (decision.name, decision.reason, decision.migrated) == ("SO", "infeasible", True)
    assert decision.dwell == 0


def test_where_none_is_eligible_a_greater_excess_is_out_however_cheap() -> None:
    cheap = replace(OBJECTIVE, weights=replace(OBJECTIVE.weights, latency=0.0))
    shown = estimates(qos(150.0, 0.9), qos(130.0, 0.5), qos(150.0, 0.0))
    decision = run(dtp(objective=cheap), [shown])[0]
    assert (decision.name, decision.reason) == ("SO", "infeasible")


def test_excesses_within_a_millionth_are_equal() -> None:
    # 120 * (1 + 1e-6 / 2) is within 1e-6 of the cap itself, which is exceeded a little too.
    least = math.nextafter(120.0, 121.0)
    near, beyond = 120.0 * (1 + 0.5e-6), 120.0 * (1 + 3e-6)
    shown = estimates(qos(least, 0.5), qos(near, 0.2), qos(beyond, 0.0))
    decision = run(dtp(), [shown])[0]
    assert decision.costs["HYB"] < decision.costs["SO"] < decision.costs["LOC"]
    assert (decision.name, decision.reason) == ("SO", "infeasible")


def test_hysteresis_holds_where_none_is_eligible() -> None:
    shown = estimates(qos(20.0, 0.1, 1.0), qos(20.0, 0.0, 1.0), qos(20.0, 0.1, 1.0))
    decision = run(dtp(min_improvement=0.1), [shown])[0]
    assert (decision.name, decision.reason, decision.migrated) == ("LOC", "infeasible", False)
    assert decision.delta_j == pytest.approx(3 * 0.1 - 0.5 * 0.5)
    assert decision.dwell == 1


def test_the_reason_is_dwell_before_infeasible() -> None:
    shown = estimates(*[qos(200.0, 1.0, 1.0)] * 3)
    assert [d.reason for d in run(dtp(1), [shown] * 2)] == ["dwell", "infeasible"]


def test_one_candidate_always_holds() -> None:
    policy = DTP(candidates={"LOC": place("R1", "R2")}, objective=OBJECTIVE, min_dwell=0)
    for k in range(1, 4):
        decision = policy.decide(observed=qos(50.0), estimates={"LOC": qos(50.0)})
        assert (decision.name, decision.reason, decision.dwell) == ("LOC", "hold", k)


def test_start_makes_it_forget() -> None:
    policy = dtp()
    shown = estimates(qos(100.0), qos(100.0), qos(10.0))
    first = run(policy, [shown] * 3)
    assert policy.incumbent == "HYB"
    policy.start(problem())
    assert policy.incumbent == "LOC"
    assert repr(run(policy, [shown] * 3)) == repr(first)


def test_it_adopts_where_the_guard_moved_the_cell() -> None:
    policy = dtp(2)
    shown = estimates(qos(20.0), qos(20.0), qos(20.0))
    run(policy, [shown] * 4)
    policy.adopt("SO")
    decision = policy.decide(observed=shown["SO"], estimates=shown)
    assert (decision.name, decision.reason, decision.dwell) == ("SO", "dwell", 1)
    assert decision.costs == {"LOC": 0.75, "SO": 0.5, "HYB": 0.625}
    with pytest.raises(PolicyError, match="'NOWHERE', which is no candidate"):
        policy.adopt("NOWHERE")


# ------------------------------------------------------------------------------------- escape

OVER, FINE, DEAR = qos(130.0, 0.5), qos(20.0), qos(110.0, 1.0)


def fleeing(min_dwell: int = 3, min_improvement: float = 0.05) -> DTP:
    return DTP(
        candidates=CANDIDATES,
        objective=OBJECTIVE,
        min_dwell=min_dwell,
        min_improvement=min_improvement,
        escape=True,
    )


def test_an_incumbent_over_its_cap_escapes_from_a_dwell_window() -> None:
    shown = estimates(OVER, qos(30.0), FINE)
    stays = run(dtp(3), [shown])[0]
    assert (stays.name, stays.reason) == ("LOC", "dwell")
    decision = run(fleeing(), [shown])[0]
    assert (decision.name, decision.reason, decision.dwell) == ("HYB", "migrate", 0)
    assert decision.delta_j == pytest.approx(3.25 + 1.5 - 0.5 - 0.125)


def test_it_escapes_without_an_improvement_to_the_cheapest_within_the_caps() -> None:
    # What is within its caps is dearer than the incumbent, and one is dearer still.
    hot = qos(20.0, 0.0, robot=0.99)
    shown = estimates(hot, qos(115.0, 1.0), DEAR)
    decision = run(fleeing(0, 5.0), [shown])[0]
    assert (decision.name, decision.reason, decision.migrated) == ("HYB", "capped", True)
    assert decision.delta_j < 0


def test_it_never_escapes_to_a_candidate_over_its_caps() -> None:
    decisions = run(fleeing(2), [estimates(OVER, qos(121.0), qos(20.0, 0.0, 1.0))] * 3)
    assert [d.reason for d in decisions] == ["dwell", "dwell", "infeasible"]
    assert [d.name for d in decisions[:2]] == ["LOC", "LOC"]


def test_the_escape_looks_at_what_was_observed_not_at_its_estimate() -> None:
    shown = estimates(FINE, FINE, FINE)
    assert fleeing().decide(observed=OVER, estimates=shown).name == "HYB"
    shown = estimates(OVER, FINE, FINE)
    assert fleeing().decide(observed=FINE, estimates=shown).reason == "dwell"


def test_without_estimates_there_is_nowhere_to_escape_to() -> None:
    assert fleeing().decide(observed=OVER).reason == "dwell"


@given(windows, st.integers(0, 4), st.sampled_from([0.0, 0.5]))
def test_the_escape_is_all_that_differs(
    shown: list[dict[str, QoS]], min_dwell: int, min_improvement: float
) -> None:
    policy = fleeing(min_dwell, min_improvement)
    for window in shown:
        now, twin = policy.incumbent, copy.deepcopy(policy)
        twin.escape = False
        usual = twin.decide(observed=window[now], estimates=window)
        decision = policy.decide(observed=window[now], estimates=window)
        within = [name for name in CANDIDATES if excess(window[name], OBJECTIVE) <= 0]
        if now in within or not within:
            assert repr(decision) == repr(usual)
        else:
            assert decision.name == min(within, key=decision.costs.__getitem__)
            J = decision.costs
            left_out = any(J[c] < J[decision.name] for c in CANDIDATES if c not in within)
            assert (decision.reason, decision.dwell) == ("capped" if left_out else "migrate", 0)


def test_with_the_escape_it_keeps_its_word_in_awkward_windows() -> None:
    assert check_policy(fleeing(), problem()) == ()


# ------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"initial": "HIB"}, "initial is 'HIB', which is no candidate; did you mean 'HYB'"),
        ({"min_dwell": -1}, "min_dwell is -1; it must be a whole number"),
        ({"min_dwell": 1.5}, "min_dwell is 1.5; it must be a whole number"),
        ({"min_dwell": True}, "min_dwell is True"),
        ({"min_improvement": -0.1}, "min_improvement is -0.1; it must be a number"),
        ({"min_improvement": math.nan}, "min_improvement is nan"),
        ({"min_improvement": math.inf}, "min_improvement is inf"),
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
        DTP(**{**good, **changes})  # type: ignore[arg-type]


def test_a_candidate_must_be_a_placement() -> None:
    with pytest.raises(PlacementError):
        DTP(candidates={"LOC": Placement({})}, objective=OBJECTIVE)


@pytest.mark.parametrize("min_dwell", [0, 3])
@pytest.mark.parametrize(
    ("observed", "given", "message"),
    [
        (None, estimates(qos(), qos(), qos()), "observed is None; it must be a QoS"),
        (qos(), {}, "nothing for candidate LOC"),
        (qos(), {"LOC": qos(), "HYB": qos()}, "nothing for candidate SO"),
        (qos(), {"LOC": qos(), "SO": None, "HYB": qos()}, "the estimate of SO is None"),
        (qos(), [qos()], "it must map every candidate to a QoS"),
        (
            qos(),
            estimates(QoS(1.0, 0.0, {"R1": 0.1, "R2": 0.1}), qos(), qos()),
            "the estimate of LOC has no utilisation of E",
        ),
        (
            qos(),
            estimates(qos(), qos(), QoS(1.0, 0.0, {"E": 0.0, "R2": 0.1})),
            "the estimate of HYB has no utilisation of R1",
        ),
    ],
)
def test_missing_metrics_are_an_error_and_change_nothing(
    min_dwell: int, observed: QoS, given: dict[str, QoS], message: str
) -> None:
    policy = dtp(min_dwell)
    with pytest.raises(MetricError, match=message):
        policy.decide(observed=observed, estimates=given)
    shown = estimates(qos(100.0), qos(10.0), qos(20.0))
    assert repr(run(policy, [shown])) == repr(run(dtp(min_dwell), [shown]))


def test_a_cost_that_is_not_finite_is_an_error() -> None:
    heavy = replace(NO_CAPS, weights=replace(OBJECTIVE.weights, latency=1e9))
    with pytest.raises(MetricError, match="has no finite J"):
        dtp(objective=heavy).decide(observed=qos(), estimates=estimates(qos(1e305), qos(), qos()))


@pytest.mark.parametrize("value", [math.nan, -1.0, math.inf])
def test_bad_metrics_do_not_even_exist(value: float) -> None:
    with pytest.raises(DwellError):
        qos(value)
    with pytest.raises(DwellError):
        qos(1.0, value)
    with pytest.raises(DwellError):
        qos(1.0, 0.0, robot=value)
