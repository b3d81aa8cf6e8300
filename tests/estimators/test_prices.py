"""Prices against what runs of a candidate that stays come to, and by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import pytest

import dwell
from dwell.estimators import prices
from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.prices import (
    MOST_CYCLES,
    SETTLING,
    Price,
    price_of,
    prices_of,
)
from dwell.estimators.sent_shadows import SentShadows, hindered
from dwell.kernels.random_draws import draw
from dwell.model import (
    Bursts,
    Constant,
    Execution,
    Exponential,
    Flow,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    Problem,
    QoS,
    Quota,
    Task,
)
from tests.cells.examples import EXAMPLES
from tests.cells.generated import make_problem
from tests.cells.random_dags import random_dag
from tests.reference.test_against import make_case

WIDTH = 50
R, E = Node("R", "robot", cores=1), Node("E", "edge", cores=4)


def on(ms: float, accelerator: str | None = None) -> Execution:
    return Execution(Constant(ms), accelerator=accelerator)


def only(problem: Problem) -> Price:
    (price,) = prices_of(problem).values()
    return price


# --------------------------------------------------------------------------------------- by hand


def test_two_branches_on_one_core_are_in_each_other_s_way() -> None:
    both = {"R": on(30.0), "E": on(30.0)}
    problem = make_problem(
        [R, E],
        [Task("left", both), Task("right", both), Task("join", {"R": on(1.0)})],
        [Flow("left", "join"), Flow("right", "join")],
        links=[Link("R", "E", Constant(5.0)), Link("E", "R", Constant(5.0))],
        candidates={"LOC": {}, "OFF": {"right": "E"}},
        period_ms=70.0,
        deadline_ms=50.0,
        window_cycles=WIDTH,
    )
    found = prices_of(problem)
    assert (found["LOC"].l95_ms, found["LOC"].violation_rate) == (61.0, 1.0)
    assert (found["OFF"].l95_ms, found["OFF"].violation_rate) == (36.0, 0.0)
    # Nothing is random, and as little as there is to play is enough.
    for price in found.values():
        assert (price.l95_error_ms, price.violation_error) == (0.0, 0.0)
        assert price.cycles == 25 * WIDTH


def test_five_tasks_on_one_accelerator_wait_for_it() -> None:
    node = Node("R", "robot", 4, accelerators={"gpu": 1})
    tasks = [Task(f"T{i}", {"R": on(30.0, "gpu")}) for i in range(5)]
    price = only(make_problem([node], tasks, period_ms=200.0, window_cycles=WIDTH))
    assert price.l95_ms == 150.0


def test_flows_on_a_link_wait_for_its_rate() -> None:
    tasks = [Task("A", {"R": on(1.0)}), Task("B", {"E": on(1.0)}), Task("C", {"E": on(1.0)})]
    # 100 kB at 20 Mbit/s take 40 ms each.
    flows = [Flow("A", "B", 100_000), Flow("A", "C", 100_000)]
    links = [Link("R", "E", Constant(2.0), rate_mbps=20.0)]
    problem = make_problem([R, E], tasks, flows, links=links, window_cycles=WIDTH)
    assert only(problem).l95_ms == 1 + 80 + 2 + 1


def test_a_join_of_unequal_branches_takes_the_longer_one() -> None:
    tasks = [Task(name, {"E": on(ms)}) for name, ms in (("A", 3.0), ("B", 20.0), ("C", 1.0))]
    flows = [Flow("A", "C"), Flow("B", "C")]
    assert only(make_problem([E], tasks, flows, window_cycles=WIDTH)).l95_ms == 21.0


def test_cycles_overlap_where_the_pipeline_is_longer_than_the_period() -> None:
    tasks = [Task(name, {"E": on(15.0)}) for name in "ABC"]
    flows = [Flow("A", "B"), Flow("B", "C")]
    problem = make_problem([E], tasks, flows, period_ms=20.0, window_cycles=WIDTH)
    price = only(problem)
    assert price.uncut_l95_ms == 45.0
    assert price.own["E"] == pytest.approx(45 / (20 * 4), rel=0.01)


def test_two_stages_share_one_quota() -> None:
    node = Node("R", "robot", quota=Quota(0.5, 100.0))
    problem = make_problem(
        [node],
        [Task("A", {"R": on(40.0)}), Task("B", {"R": on(40.0)})],
        [Flow("A", "B")],
        period_ms=200.0,
        deadline_ms=100.0,
        window_cycles=WIDTH,
    )
    assert (only(problem).l95_ms, only(problem).violation_rate) == (130.0, 1.0)


def test_what_cycles_take_in_the_end_is_known_where_windows_close_before() -> None:
    link = Link("R", "E", Constant(140.0))
    tasks = [Task("A", {"R": on(0.0)}), Task("B", {"E": on(0.0)})]
    problem = make_problem(
        [R, E], tasks, [Flow("A", "B")], links=[link], period_ms=10.0, window_cycles=10
    )
    price = only(problem)
    assert price.uncut_l95_ms == 140.0
    assert price.l95_ms == problem.censor_ms == 40.0


def test_what_others_take_of_a_node() -> None:
    bursts = Bursts(Exponential(3_000.0), Exponential(1_000.0), threads=1)
    nodes = [Node("R", "robot", 4, background=1.0), Node("E", "edge", 2, bursts=bursts)]
    task = Task("A", {"R": on(20.0), "E": on(20.0)})
    problem = make_problem(
        nodes, [task], candidates={"LOC": {}, "OFF": {"A": "E"}}, window_cycles=WIDTH
    )
    found = prices_of(problem, cycles=20_000)
    for price in found.values():
        assert price.foreign["R"] == pytest.approx(0.25)
        assert price.foreign_deviation["R"] == pytest.approx(0.0, abs=1e-6)
        # A quarter of the time one of two cores, in windows of 5 s.
        assert price.foreign["E"] == pytest.approx(0.125, abs=0.02)
        assert 0.03 < price.foreign_deviation["E"] < 0.25
    assert found["LOC"].own == {"R": pytest.approx(0.05), "E": 0.0}
    assert found["OFF"].own == {"R": 0.0, "E": pytest.approx(0.1)}


# -------------------------------------------------------------------------------------- overload


def test_what_never_keeps_pace_has_no_l95() -> None:
    problem = make_problem([R], [Task("A", {"R": on(150.0)})], window_cycles=WIDTH)
    price = only(problem)
    assert (price.violation_rate, price.uncut_l95_ms) == (1.0, math.inf)
    assert price.l95_ms == problem.censor_ms
    assert price.own["R"] == 1.0


def test_a_thousand_tasks_on_one_core_are_priced_by_few_cycles() -> None:
    tasks = [Task(f"T{i}", {"R": on(1000.0)}) for i in range(1000)]
    price = only(make_problem([R], tasks, window_cycles=WIDTH))
    assert (price.violation_rate, price.uncut_l95_ms) == (1.0, math.inf)
    assert price.cycles <= 25 * WIDTH


def test_a_link_that_loses_everything() -> None:
    tasks = [Task("A", {"R": on(1.0)}), Task("B", {"R": on(1.0), "E": on(1.0)})]
    problem = make_problem(
        [R, E],
        tasks,
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(1.0))],
        candidates={"LOC": {}, "OFF": {"B": "E"}},
        scenario=[LinkDisturbance("R", "E", loss=1.0)],
        window_cycles=WIDTH,
    )
    off = prices_of(problem, "disturbed")["OFF"]
    assert (off.violation_rate, off.violation_error, off.uncut_l95_ms) == (1.0, 0.0, math.inf)
    assert math.isnan(off.latency_ms)


# --------------------------------------------------------------------------- against the simulator


@pytest.mark.parametrize("seed", range(40))
def test_a_price_is_the_mean_of_the_windows_of_a_run(seed: int) -> None:
    problem = make_case(seed, ("fair", "fifo", "priority", "turns")).problem
    windows = SETTLING + 3
    realisation = draw(problem, scenario="baseline", seed=seed, windows=windows)
    for name in problem.candidates:
        price = price_of(CandidatePlayer([(problem, realisation)]), name)
        run = dwell.simulate_realisation(problem, realisation, policy=name, estimator=AsSeen())
        counted = run.windows[SETTLING:]
        assert price.l95_ms == counted["seen_l95_ms"].to_numpy().mean()
        assert price.violation_rate == counted["seen_violation_rate"].to_numpy().mean()


@pytest.mark.parametrize("seed", range(40))
def test_a_price_with_shadows_is_the_mean_of_the_windows_of_a_run_with_them(seed: int) -> None:
    problem = make_case(seed, ("fair", "fifo", "priority", "turns")).problem
    windows, fraction = SETTLING + 3, 0.5 / max(len(problem.candidates) - 1, 1)
    realisation = draw(problem, scenario="baseline", seed=seed, windows=windows)
    shadows = SentShadows(problem, realisation, fraction)
    player = CandidatePlayer([(problem, realisation)], shadows=shadows)
    for name in hindered(problem):
        price = price_of(player, name)
        run = dwell.simulate_realisation(
            problem, realisation, policy=name, estimator=AsSeen(fraction)
        )
        counted = run.windows[SETTLING:]
        assert price.l95_ms == counted["seen_l95_ms"].to_numpy().mean()
        assert price.violation_rate == counted["seen_violation_rate"].to_numpy().mean()


def test_candidates_that_shadows_do_not_hinder_have_the_same_price_with_them() -> None:
    problem = random_dag(40)
    plain, with_shadows = prices_of(problem), prices_of(problem, shadow_fraction=0.05)
    same = {name for name in problem.candidates if with_shadows[name] is plain[name]}
    assert same == set(problem.candidates) - hindered(problem) == {"LOC"}
    # Own work is what it is without; shadow jobs are no foreign load.
    for name, price in with_shadows.items():
        assert price.own == pytest.approx(plain[name].own, rel=0.01)
        assert price.foreign == pytest.approx(plain[name].foreign, abs=1e-6)
    assert with_shadows["C2"].l95_ms > 1.2 * plain["C2"].l95_ms


class AsSeen:
    """An estimator that expects of every candidate what the window showed."""

    def __init__(self, shadow_fraction: float = 0.0) -> None:
        self.shadow_fraction = shadow_fraction

    def start(self, problem: Problem) -> None:
        """Remember the candidates."""
        self.names = tuple(problem.candidates)

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Expect the window of all."""
        return dict.fromkeys(self.names, observed)


@pytest.mark.parametrize("seed", range(12))
def test_a_price_is_what_long_runs_of_random_dags_come_to(seed: int) -> None:
    problem = random_dag(seed)
    realisation = draw(problem, scenario="baseline", seed=1_000 + seed, windows=1_000)
    for name, price in prices_of(problem).items():
        long = price_of(CandidatePlayer([(problem, realisation)]), name)
        l95_error_ms = math.hypot(price.l95_error_ms, long.l95_error_ms)
        assert abs(price.l95_ms - long.l95_ms) <= 4 * l95_error_ms + 1e-9
        error = math.hypot(price.violation_error, long.violation_error)
        assert abs(price.violation_rate - long.violation_rate) <= 4 * error + 1e-9


# ----------------------------------------------------------------------------------- how much


def chain(cv: float, *, width: int = WIDTH) -> Problem:
    tasks = [Task(name, {"E": Execution(LogNormal(10.0, cv))}) for name in "AB"]
    return make_problem([E], tasks, [Flow("A", "B")], deadline_ms=30.0, window_cycles=width)


def test_more_is_played_where_more_is_random() -> None:
    calm, wild = only(chain(0.02)), only(chain(1.0))
    assert calm.cycles == 25 * WIDTH < wild.cycles <= MOST_CYCLES
    assert wild.l95_error_ms <= 0.01 * wild.l95_ms
    assert wild.violation_error <= 0.0025


def test_long_windows_are_played_in_pieces() -> None:
    long, usual = only(chain(0.5, width=1_000_000)), only(chain(0.5, width=4_000))
    assert long == usual


def test_a_number_of_cycles_that_was_asked_for() -> None:
    (price,) = prices_of(chain(1.0), cycles=101).values()
    assert price.cycles == (SETTLING + 3) * WIDTH


def test_what_does_not_matter_is_not_played_again() -> None:
    problem = chain(1.0)
    other = replace(problem, name="other", controller=replace(problem.controller, min_dwell=7))
    assert prices_of(other) is prices_of(problem)
    assert prices_of(problem, seed=2) is not prices_of(problem)


def test_a_scenario_has_prices_of_its_own() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    stressed = prices_of(problem, "robot-cpu-stress")
    assert stressed["LOC"].violation_rate > prices_of(problem)["LOC"].violation_rate + 0.5


def test_prices_are_handed_over_and_few_are_kept() -> None:
    problem = chain(0.7)
    first = prices_of(problem)
    handed = prices.KNOWN_PRICES.known
    for seed in range(prices.KEPT):
        prices_of(problem, seed=seed, cycles=1)
    assert len(prices.KNOWN_PRICES.known) == prices.KEPT
    again = prices_of(problem)
    assert again is not first
    assert again == first
    prices.KNOWN_PRICES.add(handed)
    assert prices_of(problem) is first
