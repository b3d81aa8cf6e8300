"""Presents that are played: by hand, and against runs of the scenario that a present is."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from random import Random

import numpy as np
import pytest
from numpy.typing import NDArray

from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.declared_cell import declared_of
from dwell.estimators.measured import Message, Part, Site
from dwell.estimators.present import Present
from dwell.estimators.prices import RATE, Price, price_of, prices_of
from dwell.estimators.stepwise_player import KEPT, RECENT, StepwisePlayer
from dwell.kernels.random_draws import draw
from dwell.model import (
    Bursts,
    Constant,
    Disturbance,
    Execution,
    Flow,
    FrozenDict,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Problem,
    QoS,
    Task,
)
from tests.cells.generated import make_problem, random_problem
from tests.cells.random_dags import random_dag

Floats = NDArray[np.float64]

WIDTHS = (5, 20, 50, 5000)
R, E = Node("R", "robot", cores=1), Node("E", "edge", cores=4)


def on(ms: float) -> Execution:
    return Execution(Constant(ms))


def present(
    demands: Mapping[Part, list[float]] | None = None,
    threads: Mapping[str, float] | None = None,
    down: Collection[str] = (),
) -> Present:
    known = {part: np.array(values) for part, values in (demands or {}).items()}
    return Present(FrozenDict(known), FrozenDict(threads or {}), frozenset(down))


def played(problem: Problem, what: Present, steps: int = 10) -> dict[str, QoS]:
    playing = StepwisePlayer(problem)
    playing.begin(what)
    playing.go_on(what, list(problem.candidates), steps)
    return {name: playing.played(name) for name in problem.candidates}


def errors_of(qos: QoS) -> tuple[float, float]:
    assert qos.error is not None
    return qos.error


def only(problem: Problem, what: Present) -> QoS:
    (one,) = played(problem, what).values()
    return one


def branches(window_cycles: int = 20) -> Problem:
    """Two branches of 30 ms that a task of 1 ms joins, the right one on the robot or the edge."""
    both = {"R": on(30.0), "E": on(30.0)}
    return make_problem(
        [R, E],
        [Task("left", both), Task("right", both), Task("join", {"R": on(1.0)})],
        [Flow("left", "join"), Flow("right", "join")],
        links=[Link("R", "E", Constant(5.0)), Link("E", "R", Constant(5.0))],
        candidates={"LOC": {}, "OFF": {"right": "E"}},
        period_ms=120.0,
        deadline_ms=50.0,
        window_cycles=window_cycles,
    )


def across(link: Link, window_cycles: int = 20) -> Problem:
    """Two flows of 100 kB to two tasks of 1 ms on the edge."""
    return make_problem(
        [R, E],
        [Task("A", {"R": on(1.0)}), Task("B", {"E": on(1.0)}), Task("C", {"E": on(1.0)})],
        [Flow("A", "B", 100_000), Flow("A", "C", 100_000)],
        links=[link],
        deadline_ms=90.0,
        window_cycles=window_cycles,
    )


TO_B, TO_C = Message("A", "B", "R->E"), Message("A", "C", "R->E")


# ---------------------------------------------------------------------------------- as declared


def test_as_declared_nothing_is_played() -> None:
    assert StepwisePlayer(branches()).cycles == 0
    assert repr(Present()) == "<Present: as declared>"


def test_the_declared_demands_are_those_that_windows_would_show() -> None:
    problem = across(Link("R", "E", Constant(2.0), rate_mbps=20.0))
    declared = declared_of(problem)
    assert {part: set(one.values) for part, one in declared.references.items()} == {
        Site("A", "R"): {1.0},
        Site("B", "E"): {1.0},
        Site("C", "E"): {1.0},
        # Neither the 40 ms that each takes on the link nor waiting for the other are of them.
        TO_B: {2.0},
        TO_C: {2.0},
    }
    assert set(declared.windows["LOC"].l95_ms) == {84.0}
    assert set(declared.windows["LOC"].violation_rate) == {0.0}
    assert declared_of(problem) is declared


@pytest.mark.parametrize("seed", range(10))
def test_a_present_that_is_as_declared_has_the_declared_price(seed: int) -> None:
    problem = random_dag(seed)
    references = declared_of(problem).references
    demands = FrozenDict({part: one.values for part, one in references.items()})
    for what in (Present(), Present(demands)):
        for name, one in played(problem, what).items():
            price = prices_of(problem)[name]
            is_as(one, price)
            assert one.utilisation == pytest.approx(price.own, rel=0.05)


# --------------------------------------------------------------------------------------- by hand


@pytest.mark.parametrize("width", WIDTHS)
def test_two_tasks_on_one_core(width: int) -> None:
    what = present({Site("right", "R"): [40.0], Site("right", "E"): [20.0]})
    found = played(branches(width), what)
    assert (found["LOC"].l95_ms, found["LOC"].violation_rate) == (71.0, 1.0)
    assert (found["OFF"].l95_ms, found["OFF"].violation_rate) == (31.0, 0.0)
    assert errors_of(found["LOC"])[0] == errors_of(found["OFF"])[0] == 0.0
    assert found["LOC"].uncut_l95_ms == 71.0
    assert found["OFF"].utilisation == pytest.approx({"R": 31 / 120, "E": 20 / 480})
    assert repr(what) == ("<Present: Site(task='right', node='R'), Site(task='right', node='E')>")


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(
    ("threads", "l95_ms"), [(0.1, 36.0), (0.9, 62.0), (1.0, 62.0), (2.0, 93.0)]
)
def test_a_task_beside_foreign_threads(width: int, threads: float, l95_ms: float) -> None:
    found = played(branches(width), present(threads={"R": threads}))["OFF"]
    assert (found.l95_ms, found.uncut_l95_ms) == (l95_ms, l95_ms)
    assert found.utilisation["R"] == pytest.approx(31 / 120)


@pytest.mark.parametrize("width", [20, 50, 5000])
def test_a_fraction_of_a_thread_is_there_for_a_share_of_the_periods(width: int) -> None:
    found = played(branches(width), present(threads={"R": 0.5}))["OFF"]
    assert (found.l95_ms, found.violation_rate) == (62.0, 0.5)


@pytest.mark.parametrize(("fewer", "l95_ms"), [(-2.0, 31.0), (-1.0, 62.0), (-9.0, 31.0)])
def test_fewer_threads_than_those_of_bursts(fewer: float, l95_ms: float) -> None:
    bursts = Bursts(Constant(1000.0), Constant(1000.0), threads=4)
    node = replace(R, bursts=bursts)
    problem = make_problem([node], [Task("A", {"R": on(31.0)})], period_ms=200.0, window_cycles=50)
    assert prices_of(problem)["LOC"].l95_ms > 100.0
    assert only(problem, present(threads={"R": fewer})).l95_ms == l95_ms


def test_more_threads_are_beside_those_of_bursts() -> None:
    node = replace(R, bursts=Bursts(Constant(1000.0), Constant(1000.0), threads=1))
    problem = make_problem([node], [Task("A", {"R": on(10.0)})], period_ms=200.0, window_cycles=50)
    assert only(problem, present(threads={"R": 1.0})).l95_ms == 30.0


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("extra_ms", [0.0, 7.0])
def test_flows_on_a_link_wait_for_its_rate(width: int, extra_ms: float) -> None:
    problem = across(Link("R", "E", Constant(2.0), rate_mbps=20.0), width)
    delay = [2.0 + extra_ms]
    found = only(problem, present({TO_B: delay, TO_C: delay}))
    # 100 kB at 20 Mbit/s take 40 ms each.
    assert found.l95_ms == 1 + 80 + 2 + extra_ms + 1


def test_measured_delays_have_those_of_bursts_in_them() -> None:
    bursts = Bursts(Constant(500.0), Constant(500.0), add_delay_ms=Constant(30.0))
    problem = across(Link("R", "E", Constant(2.0), bursts=bursts))
    assert prices_of(problem)["LOC"].l95_ms == 34.0
    assert only(problem, present({TO_B: [3.0], TO_C: [3.0]})).l95_ms == 5.0


def test_a_link_that_loses_a_share() -> None:
    # A tenth of the one and three of the other: a link loses of all alike.
    few, many = ([2.0] * (10 - lost) + [math.inf] * lost for lost in (1, 3))
    problem = across(Link("R", "E", Constant(2.0)))
    found = only(problem, present({TO_B: few, TO_C: many}))
    assert found.violation_rate == pytest.approx(1 - 0.8**2, abs=4 * errors_of(found)[1])
    assert found.l95_ms == pytest.approx(problem.censor_ms, rel=0.02)
    # What was lost where it is declared to be, and is not any more, is not played.
    declared = across(Link("R", "E", Constant(2.0), loss=0.5))
    found = only(declared, present({TO_B: [2.0], TO_C: [2.0]}))
    assert (found.violation_rate, found.l95_ms) == (0.0, 4.0)


def test_a_link_that_loses_a_share_and_sends_again() -> None:
    # Lost attempts are in the delays.
    problem = across(Link("R", "E", Constant(2.0), loss=0.5, retransmit_ms=20.0))
    found = only(problem, present({TO_B: [2.0, 22.0], TO_C: [2.0, 22.0]}))
    assert (found.l95_ms, found.violation_rate) == (24.0, 0.0)


def test_messages_wait_once_for_one_that_is_repeated() -> None:
    # The first of every ten is repeated; the next one waits for it, and misses its deadline.
    link = Link("R", "E", Constant(2.0), retransmit_ms=250.0, in_order=True)
    values = [252.0, *[2.0] * 9]
    found = only(across(link), present({TO_B: values, TO_C: values}))
    assert found.violation_rate == pytest.approx(0.2)


@pytest.mark.parametrize("retransmit_ms", [None, 20.0])
@pytest.mark.parametrize("width", WIDTHS)
def test_a_link_that_loses_everything(width: int, retransmit_ms: float | None) -> None:
    problem = across(Link("R", "E", Constant(2.0), retransmit_ms=retransmit_ms), width)
    found = only(problem, present({TO_B: [math.inf] * 5}))
    assert (found.violation_rate, found.l95_ms) == (1.0, problem.censor_ms)
    assert found.utilisation == {"R": pytest.approx(0.01), "E": 0.0}
    if retransmit_ms is None:
        assert found.uncut_l95_ms == math.inf


@pytest.mark.parametrize("width", WIDTHS)
def test_a_node_that_is_down(width: int) -> None:
    problem = branches(width)
    found = played(problem, present(down=["E"]))
    assert (found["LOC"].l95_ms, found["LOC"].violation_rate) == (61.0, 1.0)
    off = found["OFF"]
    assert (off.l95_ms, off.uncut_l95_ms) == (problem.censor_ms, math.inf)
    assert (off.violation_rate, off.utilisation["E"]) == (1.0, 0.0)


def test_jobs_with_more_threads_than_cores_take_what_they_take_alone() -> None:
    wide = Execution(Constant(10.0), threads=8)
    problem = make_problem([E], [Task("A", {"E": wide})], window_cycles=20)
    assert prices_of(problem)["LOC"].l95_ms == 20.0
    found = only(problem, present({Site("A", "E"): [26.0]}))
    assert found.l95_ms == 26.0
    assert found.utilisation["E"] == pytest.approx(0.26)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_join_of_unequal_branches_takes_the_longer_one(width: int) -> None:
    tasks = [Task(name, {"E": on(ms)}) for name, ms in (("A", 3.0), ("B", 20.0), ("C", 1.0))]
    flows = [Flow("A", "C"), Flow("B", "C")]
    problem = make_problem([E], tasks, flows, window_cycles=width)
    for ms, l95_ms in ((15.0, 21.0), (25.0, 26.0)):
        assert only(problem, present({Site("A", "E"): [ms]})).l95_ms == l95_ms


@pytest.mark.parametrize("width", WIDTHS)
def test_cycles_overlap_where_the_pipeline_is_longer_than_the_period(width: int) -> None:
    tasks = [Task(name, {"E": on(15.0)}) for name in "ABC"]
    flows = [Flow("A", "B"), Flow("B", "C")]
    problem = make_problem([E], tasks, flows, period_ms=20.0, window_cycles=width)
    found = only(problem, present({Site("B", "E"): [18.0]}))
    assert found.uncut_l95_ms == 48.0
    assert found.utilisation["E"] == pytest.approx(48 / (20 * 4), rel=0.02)


def test_values_are_met_in_their_order() -> None:
    # Of 20 cycles each second one takes 40 ms, or the last ten do: the mean is the same.
    problem = make_problem([R], [Task("A", {"R": on(10.0)})], deadline_ms=30.0, window_cycles=20)
    mixed, apart = [10.0, 40.0] * 20, [10.0] * 20 + [40.0] * 20
    found = [only(problem, present({Site("A", "R"): values})) for values in (mixed, apart)]
    assert [one.violation_rate for one in found] == [0.5, pytest.approx(0.5, abs=0.05)]
    assert [one.l95_ms for one in found] == [40.0, pytest.approx(25.0, abs=1.5)]


# ------------------------------------------------------------------------------------ going on


def noisy(window_cycles: int = 20) -> Problem:
    both = {"R": Execution(LogNormal(8.0, 0.5)), "E": Execution(LogNormal(6.0, 0.5))}
    return replace(
        branches(window_cycles),
        pipeline=replace(
            branches().pipeline,
            tasks=FrozenDict(
                {
                    "left": Task("left", both),
                    "right": Task("right", both),
                    "join": Task("join", {"R": on(1.0)}),
                }
            ),
        ),
    )


SLOW = present({Site("left", "R"): [20.0, 25.0, 30.0], Site("right", "E"): [9.0, 12.0]})


@pytest.mark.parametrize("width", WIDTHS)
def test_another_present_forgets_the_one_before(width: int) -> None:
    problem = noisy(width)
    playing = StepwisePlayer(problem)
    first = Present(SLOW.demands, FrozenDict({"R": 1.0}), frozenset({"E"}))
    for what in (first, SLOW):
        playing.begin(what)
        playing.go_on(what, ["LOC", "OFF"], 7)
    assert {name: playing.played(name) for name in ("LOC", "OFF")} == played(problem, SLOW, 7)


@pytest.mark.parametrize("width", WIDTHS)
def test_a_price_is_a_fixed_number_in_whatever_order_candidates_are_asked_for(width: int) -> None:
    problem = noisy(width)
    one, other, alone = (
        StepwisePlayer(problem),
        copy.deepcopy(StepwisePlayer(problem)),
        StepwisePlayer(problem),
    )
    for playing in (one, other, alone):
        playing.begin(SLOW)
    for _ in range(20):
        one.go_on(SLOW, ["LOC", "OFF"], 2)
        other.go_on(SLOW, ["OFF", "LOC"], 2)
        alone.go_on(SLOW, ["OFF"], 2)
        assert one.played("OFF") == other.played("OFF") == alone.played("OFF")
        assert one.played("LOC") == other.played("LOC")
    assert one.cycles == 2 * alone.cycles


def test_a_candidate_that_is_played_less_often_goes_on_from_where_it_was() -> None:
    problem = noisy()
    playing, whole = StepwisePlayer(problem), StepwisePlayer(problem)
    for one in (playing, whole):
        one.begin(SLOW)
    playing.go_on(SLOW, ["LOC"], 5)
    playing.go_on(SLOW, ["OFF"], 3)
    playing.go_on(SLOW, ["LOC", "OFF"], 2)
    whole.go_on(SLOW, ["LOC", "OFF"], 5)
    assert playing.played("OFF") == whole.played("OFF")
    whole.go_on(SLOW, ["LOC"], 2)
    assert playing.played("LOC") == whole.played("LOC")


def test_a_copy_begins_anew() -> None:
    playing = StepwisePlayer(noisy())
    playing.begin(SLOW)
    playing.go_on(SLOW, ["LOC"], 3)
    for made in (copy.copy(playing), copy.deepcopy(playing)):
        assert made.cycles == 0
        made.begin(SLOW)
        made.go_on(SLOW, ["LOC"], 3)
        assert made.played("LOC") == playing.played("LOC")


def test_more_steps_are_surer_until_there_are_enough() -> None:
    playing = StepwisePlayer(noisy())
    playing.begin(SLOW)
    errors: list[float] = []
    for _ in range(KEPT):
        assert not (errors and playing.is_full("LOC"))
        playing.go_on(SLOW, ["LOC"])
        errors.append(errors_of(playing.played("LOC"))[0])
    assert errors[-1] < errors[4] / 1.5
    assert playing.is_full("LOC")


def test_newer_values_are_met_and_older_steps_forgotten() -> None:
    problem = branches()
    playing = StepwisePlayer(problem)
    what = present({Site("left", "R"): [30.0]})
    playing.begin(what)
    playing.go_on(what, ["OFF"], 12)
    assert playing.played("OFF").l95_ms == 36.0
    what = present({Site("left", "R"): [40.0]})
    for _ in range(RECENT + 1):
        playing.go_on(what, ["OFF"], has_grown=True)
    assert (playing.played("OFF").l95_ms, errors_of(playing.played("OFF"))[0]) == (41.0, 0.0)


@pytest.mark.parametrize("width", WIDTHS)
def test_newer_losses_are_met(width: int) -> None:
    problem = across(Link("R", "E", Constant(2.0)), width)
    playing = StepwisePlayer(problem)
    few, many = (present({TO_B: [2.0] * (10 - lost) + [math.inf] * lost}) for lost in (1, 4))
    playing.begin(few)
    playing.go_on(few, ["LOC"], 2)
    for _ in range(RECENT + 2):
        playing.go_on(many, ["LOC"], has_grown=True)
    found = playing.played("LOC")
    # The other flow has losses of the same link.
    assert found.violation_rate == pytest.approx(1 - 0.6**2, abs=4 * errors_of(found)[1])


# ---------------------------------------------------------- against runs of the same scenario


def is_as(one: QoS, price: Price) -> None:
    """Whether they are the same within four standard errors."""
    known = errors_of(one)
    l95_error_ms = math.hypot(known[0], price.l95_error_ms)
    assert abs(one.l95_ms - price.l95_ms) <= 4 * l95_error_ms + 1e-6
    error = math.hypot(known[1], price.violation_error)
    # Cycles that are seldom missed are missed several in a row.
    assert abs(one.violation_rate - price.violation_rate) <= 4 * error + RATE


def lossy(values: Floats, share: float) -> Floats:
    lost = np.diff(np.floor(np.arange(len(values) + 1) * share)) > 0
    return np.where(lost, math.inf, values)


def some_scenario(problem: Problem, kind: str, rng: Random) -> tuple[Disturbance, Present]:
    """Something that is there all the time, and the present that windows would show."""
    if kind in ("threads", "down"):
        node = rng.choice(list(problem.fabric.nodes))
        if kind == "down":
            return NodeDisturbance(node, down=True), present(down=[node])
        threads = rng.randint(1, 3)
        return NodeDisturbance(node, stress_threads=threads), present(threads={node: threads})
    link = rng.choice(list(problem.fabric.links.values()))
    extra_ms, share = round(rng.uniform(1.0, 10.0), 3), rng.choice([0.02, 0.1, 0.3])
    demands: dict[Part, Floats] = {
        part: one.values + extra_ms if kind == "delay" else lossy(one.values, share)
        for part, one in declared_of(problem).references.items()
        if isinstance(part, Message) and part.link == link.name
    }
    disturbance = LinkDisturbance(link.source, link.target)
    if kind == "delay":
        disturbance = replace(disturbance, add_delay_ms=Constant(extra_ms))
    else:
        disturbance = replace(disturbance, loss=share)
    return disturbance, Present(FrozenDict(demands))


def both(problem: Problem, kind: str, seed: int, steps: int) -> Iterator[tuple[QoS, Price]]:
    """Every candidate as it is played, and as it is in a long run."""
    disturbance, what = some_scenario(problem, kind, Random(seed))
    disturbed = replace(problem, scenarios={"disturbed": (disturbance,)})
    realisation = draw(disturbed, scenario="disturbed", seed=7_000 + seed, windows=500)
    for name, one in played(problem, what, steps).items():
        yield one, price_of(CandidatePlayer([(disturbed, realisation)]), name)


@pytest.mark.parametrize("kind", ["threads", "down", "delay", "loss"])
@pytest.mark.parametrize("seed", range(8))
def test_random_dags_come_to_what_runs_do(seed: int, kind: str) -> None:
    for one, price in both(random_dag(seed), kind, seed, KEPT):
        is_as(one, price)


@pytest.mark.parametrize("kind", ["threads", "down"])
@pytest.mark.parametrize("seed", range(12))
def test_random_cells_come_to_what_runs_do(seed: int, kind: str) -> None:
    problem = replace(random_problem(Random(seed)), window_cycles=20, scenarios={})
    for one, price in both(problem, kind, seed, KEPT):
        is_as(one, price)


@pytest.mark.parametrize("kind", ["threads", "delay"])
def test_errors_cover_what_they_say(kind: str) -> None:
    within = []
    for seed in range(12):
        for one, price in both(random_dag(seed), kind, seed, 10):
            known = price.l95_error_ms, price.violation_error
            off = abs(one.l95_ms - price.l95_ms), abs(one.violation_rate - price.violation_rate)
            for far, errors in zip(off, zip(errors_of(one), known, strict=True), strict=True):
                within.append(far <= 2 * math.hypot(*errors) + 1e-6)
    assert np.mean(within) >= 0.9
