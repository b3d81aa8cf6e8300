"""WorkFunction against every history there is, its bound under the theory's conditions, corners."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cost import ERRORS
from dwell.errors import MetricError, PolicyError
from dwell.model import Caps, ControllerSettings, Objective, Placement, QoS, Targets, Weights
from dwell.policies import WorkFunction
from tests.cells.paper import CANDIDATES, OBJECTIVE, estimates, problem, qos
from tests.reference.algorithm_1 import price, switching, worst

NODES = tuple(OBJECTIVE.tiers)
#: One task, three nodes: every two candidates are at distance 1.
EQUIDISTANT = {node: Placement({"perception": node}) for node in NODES}
Costs = Sequence[float]


def bare(switching: float) -> Objective:
    """Return an objective whose J is L95 in milliseconds plus the price of the move."""
    return Objective(
        weights=Weights(latency=1, violations=0, robot=0, edge=0, switching=switching),
        targets=Targets(latency_ms=1),
        caps=Caps(),
        tiers=OBJECTIVE.tiers,
    )


def shown(candidates: Mapping[str, Placement], costs: Costs) -> dict[str, QoS]:
    """Metrics whose J under `bare`, without a move, is `costs`."""
    return dict(zip(candidates, map(qos, costs), strict=True))


def feed(policy: WorkFunction, costs: Costs) -> str:
    """Show a window with exact estimates; return the name decided."""
    window = shown(policy.candidates, costs)
    return policy.decide(observed=window[policy.incumbent], estimates=window).name


# Multiples of 1/8 add up without rounding; few values make many ties.
eighths = st.sampled_from([0.0, 0.125, 0.25, 0.5, 1.0]) | st.integers(0, 40).map(lambda n: n / 8)


@dataclass(frozen=True)
class Case:
    """Candidates, the first being the initial one, and the costs of windows."""

    candidates: dict[str, Placement]
    weight: float
    windows: list[list[float]]

    def distance(self, one: int, other: int) -> float:
        names = list(self.candidates)
        return self.weight * switching(self.candidates[names[one]], self.candidates[names[other]])

    def policy(self) -> WorkFunction:
        return WorkFunction(candidates=self.candidates, objective=bare(self.weight))


@st.composite
def cases(draw: st.DrawFn, fewest: int = 1, longest: int = 5, distinct: bool = False) -> Case:
    """Draw a case; candidates may be the same placement unless they are to be distinct."""
    nodes = st.tuples(*[st.sampled_from(NODES)] * 4)
    placed = draw(st.lists(nodes, min_size=fewest, max_size=4, unique=distinct))
    tasks = ("sensing", "perception", "planning", "control")
    candidates = {
        f"C{i}": Placement(dict(zip(tasks, where, strict=True))) for i, where in enumerate(placed)
    }
    costs = st.lists(eighths, min_size=len(placed), max_size=len(placed))
    weights = st.sampled_from([0.5, 1.0, 4.0] if distinct else [0.0, 0.5, 1.0, 4.0])
    return Case(candidates, draw(weights), draw(st.lists(costs, max_size=longest)))


# ------------------------------------------------------------------------------ the algorithm


def every_history(case: Case, windows: int) -> list[float]:
    """w_k by candidate: the cheapest of all n ** k ways to spend the windows so far."""
    n = len(case.candidates)
    work = [math.inf] * n
    for history in itertools.product(range(n), repeat=windows):
        spent, here = 0.0, 0
        for costs, there in zip(case.windows, history, strict=False):
            spent += case.distance(here, there) + costs[there]
            here = there
        for end in range(n):
            work[end] = min(work[end], spent + case.distance(here, end))
    return work


def literal_choice(case: Case, before: Costs, costs: Costs, after: Costs, now: int) -> int:
    """The choice as it is defined, with ties that move."""
    could = [s for s, w in enumerate(after) if w == before[s] + costs[s]]
    total = {s: after[s] + case.distance(s, now) for s in could}
    ties = [s for s in could if total[s] == min(total.values())]
    moves = [s for s in ties if case.distance(s, now) > 0]
    if now in ties:
        return moves[0] if moves else now
    return ties[0]


@given(cases())
def test_it_is_the_work_function_over_all_histories(case: Case) -> None:
    policy, names, now = case.policy(), list(case.candidates), 0
    work = every_history(case, 0)
    assert list(policy.work.values()) == work
    for k, costs in enumerate(case.windows):
        after = every_history(case, k + 1)
        now = literal_choice(case, work, costs, after, now)
        assert feed(policy, costs) == names[now]
        assert list(policy.work.values()) == [w - min(after) for w in after]
        work = after


# Few values and many ties beside anything at all; some are over the caps (120 ms, 0.98).
latencies = st.sampled_from([10.0, 20.0, 40.0, 120.0, 150.0]) | st.floats(0, 400)
shares = st.sampled_from([0.0, 0.5, 1.0]) | st.floats(0, 1)
metrics = st.builds(
    QoS,
    l95_ms=latencies,
    violation_rate=shares,
    utilisation=st.fixed_dictionaries(dict.fromkeys(OBJECTIVE.tiers, shares)),
)
windows = st.lists(st.fixed_dictionaries(dict.fromkeys(CANDIDATES, metrics)), max_size=30)


@given(windows, st.sampled_from(list(CANDIDATES)))
def test_caps_and_the_record(played: list[dict[str, QoS]], initial: str) -> None:
    policy = WorkFunction(candidates=CANDIDATES, initial=initial, objective=OBJECTIVE)
    now, dwell = initial, 0
    for window in played:
        before = policy.work
        decision = policy.decide(observed=window[now], estimates=window)
        excess = {c: worst(window[c], OBJECTIVE) for c in CANDIDATES}
        allowed = [c for c in CANDIDATES if excess[c] <= max(0, min(excess.values()) + 1e-6)]
        totals = {
            c: before[c]
            + price(window[c], CANDIDATES[c], CANDIDATES[c], OBJECTIVE)
            + OBJECTIVE.weights.switching * switching(CANDIDATES[c], CANDIDATES[now])
            for c in CANDIDATES
        }
        assert decision.name in allowed or decision.name == now
        if decision.name in allowed:
            assert totals[decision.name] <= min(totals[c] for c in allowed) * (1 + 1e-8)
        infeasible = min(excess.values()) > 0
        moves = decision.name != now
        dwell = 0 if moves else dwell + 1
        assert decision.migrated == moves
        J = decision.costs
        left_out = any(J[c] < J[decision.name] for c in CANDIDATES if excess[c] > 0)
        moved = "capped" if left_out else "migrate"
        assert decision.reason == ("infeasible" if infeasible else moved if moves else "hold")
        assert decision.placement == CANDIDATES[decision.name]
        assert decision.dwell == dwell
        assert math.isnan(decision.delta_j)
        assert decision.costs == {
            c: price(window[c], CANDIDATES[c], CANDIDATES[now], OBJECTIVE) for c in CANDIDATES
        }
        now = decision.name
        assert now == policy.incumbent


def test_it_stays_bounded_over_long_runs() -> None:
    rng = random.Random(1)
    policy = WorkFunction(candidates=CANDIDATES, objective=bare(0.5))
    for _ in range(5000):
        feed(policy, [rng.expovariate(10 ** rng.uniform(-4, 4)) for _ in CANDIDATES])
        assert min(policy.work.values()) == 0
        assert max(policy.work.values()) <= 0.5 * 0.5


# ------------------------------------------------------------------ the bound, and where it ends


def optimum(case: Case, played: Sequence[Costs]) -> tuple[float, int]:
    """Cost of the best sequence in hindsight, and where it ends."""
    n = len(case.candidates)
    work = [case.distance(0, s) for s in range(n)]
    for costs in played:
        work = [min(work[x] + costs[x] + case.distance(x, s) for x in range(n)) for s in range(n)]
    return min(work), work.index(min(work))


def bound(case: Case, played: Sequence[Costs]) -> float:
    """(2n - 1) times the optimum, plus 2 * sum(d(end, s) - d(initial, s))."""
    best, end = optimum(case, played)
    n = len(case.candidates)
    extra = sum(case.distance(end, s) - case.distance(0, s) for s in range(n))
    return (2 * n - 1) * best + 2 * extra


def spend(case: Case, played: Iterator[Costs], policy: WorkFunction, late: bool) -> float:
    """Cost of the policy when it sees a window before (`late`: after) it is spent."""
    names, now, total = list(case.candidates), 0, 0.0
    for costs in played:
        there = names.index(feed(policy, costs))
        total += costs[now if late else there] + case.distance(now, there)
        now = there
    return total


def against(
    case: Case, policy: WorkFunction, charge: float, windows: int, played: list[Costs]
) -> Iterator[Costs]:
    """Yield windows that charge the incumbent and nobody else; `played` keeps them."""
    for _ in range(windows):
        played.append([charge * (name == policy.incumbent) for name in case.candidates])
        yield played[-1]


@given(cases(fewest=2, longest=60, distinct=True))
def test_it_is_competitive_when_it_sees_costs_before_it_moves(case: Case) -> None:
    total = spend(case, iter(case.windows), case.policy(), late=False)
    assert total <= bound(case, case.windows)


@given(cases(fewest=2, longest=0, distinct=True), st.sampled_from([0.125, 0.5, 1.0, 8.0]))
def test_it_is_competitive_against_the_cruellest_costs(case: Case, charge: float) -> None:
    played: list[Costs] = []
    policy = case.policy()
    total = spend(case, against(case, policy, charge, 300, played), policy, late=False)
    assert total <= bound(case, played)


@pytest.mark.parametrize("n", [2, 3])
def test_the_bound_is_nearly_reached(n: int) -> None:
    case = Case(dict(itertools.islice(EQUIDISTANT.items(), n)), 1.0, [])
    policy = case.policy()
    played: list[Costs] = []
    total = spend(case, against(case, policy, 1 / 64, 20_000, played), policy, late=False)
    best, _ = optimum(case, played)
    assert 2 * n - 1.2 < total / best <= 2 * n - 1


def test_one_window_late_there_is_no_bound() -> None:
    case = Case(dict(itertools.islice(EQUIDISTANT.items(), 2)), 1.0, [])
    for charge in (100.0, 1000.0):
        policy = case.policy()
        played: list[Costs] = []
        total = spend(case, against(case, policy, charge, 50, played), policy, late=True)
        best, _ = optimum(case, played)
        assert total / best > charge


# ------------------------------------------------------------------------------- corner cases


def test_a_tie_moves() -> None:
    # HYB is 0.25 away: there and back, so to speak, it takes 0.5 to make up for the move.
    for cost, name in ((0.5 - 1e-6, "LOC"), (0.5, "HYB")):
        policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=bare(1.0))
        assert feed(policy, [cost, 9.0, 0.0]) == name


@pytest.mark.parametrize("order", list(itertools.permutations(EQUIDISTANT)))
def test_ties_of_others_go_to_the_first_candidate(order: tuple[str, ...]) -> None:
    candidates = {name: EQUIDISTANT[name] for name in order}
    policy = WorkFunction(candidates=candidates, initial="R1", objective=bare(1.0))
    costs = [2.0 * (name == "R1") for name in order]
    assert feed(policy, costs) == next(name for name in order if name != "R1")


@pytest.mark.parametrize("weight", [0.1, 0.3, 0.7, 1.1, 1.9])
def test_rounding_hides_no_tie(weight: float) -> None:
    two = {name: EQUIDISTANT[name] for name in ("R1", "E")}
    policy = WorkFunction(candidates=two, objective=bare(weight))
    names = [feed(policy, [0.1, 0.0]) for _ in range(round(20 * weight))]
    assert names == ["R1"] * (len(names) - 1) + ["E"]


@pytest.mark.parametrize("weight", [0.0, 1e-15])
def test_equals_do_not_take_turns_where_moves_are_free(weight: float) -> None:
    policy = WorkFunction(candidates=CANDIDATES, objective=bare(weight))
    assert [feed(policy, [5.0, 5.0, 5.0]) for _ in range(4)] == ["LOC"] * 4
    assert [feed(policy, [5.0, 4.0, 4.0]) for _ in range(4)] == ["SO"] * 4


def test_a_placement_of_two_names_keeps_the_one_it_has() -> None:
    twins = {"LOC": CANDIDATES["LOC"], "SAME": CANDIDATES["LOC"]}
    policy = WorkFunction(candidates=twins, initial="SAME", objective=bare(1.0))
    assert [feed(policy, [1.0, 1.0]) for _ in range(3)] == ["SAME"] * 3


def test_small_advantages_add_up() -> None:
    policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=OBJECTIVE)
    window = estimates(
        qos(20.0), qos(40.0), qos(19.0)
    )  # HYB is better by 0.025, a move costs 0.125
    names = [policy.decide(observed=qos(20.0), estimates=window).name for _ in range(10)]
    assert names == ["LOC"] * 9 + ["HYB"]


def test_the_cost_of_the_incumbent_is_its_estimate() -> None:
    policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=bare(1.0))
    window = shown(CANDIDATES, [0.0, 9.0, 0.0])
    assert policy.decide(observed=qos(3.0), estimates=window).name == "LOC"
    decision = policy.decide(observed=qos(0.0), estimates={**window, "LOC": qos(3.0)})
    assert decision.name == "HYB"
    assert decision.costs == {"LOC": 3.0, "SO": 9.5, "HYB": 0.25}


def erring(costs: Costs, error_ms: float) -> dict[str, QoS]:
    """Metrics as those of `shown`, whose L95 has a standard error."""
    window = shown(CANDIDATES, costs)
    return {name: replace(one, error=(error_ms, 0.0)) for name, one in window.items()}


@pytest.mark.parametrize("every", [10, 50])
@pytest.mark.parametrize(("error_ms", "moves"), [(0.0, True), (0.70, True), (0.71, False)])
def test_an_advantage_within_its_error_never_moves_however_long_it_lasts(
    error_ms: float, moves: bool, every: int
) -> None:
    policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=bare(4.0))
    policy.start(problem(controller=ControllerSettings(decide_cycles=every)))
    window = erring([11.0, 20.0, 10.0], error_ms)
    assert ERRORS == 1.0
    names = [policy.decide(observed=qos(), estimates=window).name for _ in range(50)]
    assert names[-1] == ("HYB" if moves else "LOC")


@given(cases(fewest=2))
def test_errors_of_0_change_nothing(case: Case) -> None:
    plain, exact = case.policy(), case.policy()
    for costs in case.windows:
        window = shown(case.candidates, costs)
        known = {name: replace(one, error=(0.0, 0.0)) for name, one in window.items()}
        one = plain.decide(observed=qos(), estimates=window)
        other = exact.decide(observed=qos(), estimates=known)
        assert (one, plain.work) == (replace(other, delta_j=one.delta_j), exact.work)


def test_an_incumbent_over_a_cap_is_left_whatever_the_errors() -> None:
    capped = replace(bare(1.0), caps=Caps(latency_ms=4.0))
    policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=capped)
    decision = policy.decide(observed=qos(), estimates=erring([4.125, 4.0, 4.25], 9.0))
    assert (decision.name, decision.reason) == ("SO", "capped")


def test_what_is_over_a_cap_is_not_chosen_but_remembered() -> None:
    capped = replace(bare(1.0), caps=Caps(latency_ms=4.0))
    policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=capped)
    window = shown(CANDIDATES, [4.125, 4.0, 4.25])
    decision = policy.decide(observed=window["LOC"], estimates=window)
    assert (decision.name, decision.reason) == ("SO", "capped")
    assert policy.work == {"LOC": 0.0, "SO": 0.375, "HYB": 0.25}


@pytest.mark.parametrize(("initial", "migrated"), [("LOC", True), ("SO", False)])
def test_where_none_is_eligible_the_nearest_to_its_caps_is(initial: str, migrated: bool) -> None:
    capped = replace(bare(1.0), caps=Caps(latency_ms=4.0))
    policy = WorkFunction(candidates=CANDIDATES, initial=initial, objective=capped)
    window = shown(CANDIDATES, [9.0, 8.0, 8.5])
    decision = policy.decide(observed=window[initial], estimates=window)
    assert (decision.name, decision.reason) == ("SO", "infeasible")
    assert decision.migrated == migrated


def test_start_forgets_and_adopt_remembers() -> None:
    policy = WorkFunction(candidates=CANDIDATES, initial="LOC", objective=bare(1.0))
    fresh = policy.work
    assert fresh == {"LOC": 0.0, "SO": 0.5, "HYB": 0.25}
    feed(policy, [0.25, 0.25, 0.125])
    remembered = policy.work
    policy.adopt("SO")
    assert (policy.incumbent, policy.work) == ("SO", remembered)
    feed(policy, [0.0, 0.0, 9.0])
    policy.start(problem())
    assert (policy.incumbent, policy.work) == ("LOC", fresh)


def test_one_candidate() -> None:
    policy = WorkFunction(candidates={"LOC": CANDIDATES["LOC"]}, objective=OBJECTIVE)
    decision = policy.decide(observed=qos(90.0), estimates={"LOC": qos(90.0)})
    assert (decision.name, decision.reason, decision.dwell) == ("LOC", "hold", 1)
    assert repr(policy) == "WorkFunction(initial='LOC')"


def test_errors_of_its_parameters() -> None:
    with pytest.raises(PolicyError, match="did you mean 'HYB'"):
        WorkFunction(candidates=CANDIDATES, initial="HYP", objective=OBJECTIVE)
    with pytest.raises(PolicyError, match="candidates is empty"):
        WorkFunction(candidates={}, objective=OBJECTIVE)
    with pytest.raises(PolicyError, match="every candidate must place the same tasks"):
        WorkFunction(candidates={**CANDIDATES, **EQUIDISTANT}, objective=OBJECTIVE)
    with pytest.raises(PolicyError, match="objective is None"):
        WorkFunction(candidates=CANDIDATES, objective=None)  # type: ignore[arg-type]
    with pytest.raises(PolicyError, match="the adopted placement is 'EDGE'"):
        WorkFunction(candidates=CANDIDATES, objective=OBJECTIVE).adopt("EDGE")


GOOD = estimates(qos(5.0), qos(), qos())


@pytest.mark.parametrize(
    ("observed", "window", "message"),
    [
        (None, GOOD, "observed is None"),
        (
            qos(5.0),
            {**GOOD, "LOC": QoS(5.0, 0.0, {"R1": 0.5})},
            "the estimate of LOC has no utilisation of E",
        ),
        (
            qos(5.0),
            {**GOOD, "SO": QoS(1e308, 0.0, {"R1": 1.7e308, "E": 0.0, "R2": 0.0})},
            "no finite J",
        ),
        (qos(5.0), None, "estimates is None"),
        (qos(5.0), {"LOC": qos(), "HYB": qos()}, "nothing for candidate SO"),
        (qos(5.0), {**GOOD, "HYB": 3}, "the estimate of HYB is 3"),
    ],
)
def test_errors_of_metrics_change_nothing(
    observed: QoS, window: dict[str, QoS], message: str
) -> None:
    policy = WorkFunction(candidates=CANDIDATES, objective=OBJECTIVE)
    policy.decide(observed=qos(5.0), estimates=GOOD)
    work = policy.work
    with pytest.raises(MetricError, match=message):
        policy.decide(observed=observed, estimates=window)
    assert (policy.work, policy.incumbent) == (work, "LOC")
    assert policy.decide(observed=qos(5.0), estimates=GOOD).dwell == 2
