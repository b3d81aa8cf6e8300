"""Which candidates shadow jobs hinder, by hand, and what is played with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.estimators.candidate_player import CandidatePlayer
from dwell.estimators.declared_cell import declared_of
from dwell.estimators.measured import Site
from dwell.estimators.present import Present
from dwell.estimators.prices import prices_of
from dwell.estimators.sent_shadows import SentShadows, hindered
from dwell.estimators.stepwise_player import StepwisePlayer
from dwell.kernels.random_draws import draw
from dwell.model import (
    Constant,
    Execution,
    Flow,
    FrozenDict,
    Link,
    Node,
    Problem,
    Process,
    Quota,
    Task,
    Trace,
    TraceTable,
)
from dwell.model.shadow_plan import shadow_stamps
from tests.cells.examples import EXAMPLES
from tests.cells.generated import make_problem
from tests.cells.random_dags import random_dag

ONE = Constant(1.0)
R, E = Node("R", "robot", cores=4), Node("E", "edge", cores=4)
FRACTION = 0.05
#: All but OFF have B on R; OFF sends 1 kB from A to B over R->E, as all do from A to C.
MOVES = {"LOC": {"B": "R"}, "OFF": {"B": "E"}}


def fork(
    *, kilobytes: int = 1, edge: Node = E, gpu: str | None = None, rate_mbps: float = math.inf,
    in_order: bool = False, b_ms: Process = ONE,
) -> Problem:  # fmt: skip
    """Return a cell of A, which B and C follow: C is on E always, B under OFF."""

    tasks: Sequence[Task] = [
        Task("A", {"R": Execution(ONE)}),
        Task("B", {"R": Execution(ONE), "E": Execution(b_ms, accelerator=gpu)}),
        Task("C", {"E": Execution(ONE, accelerator=gpu)}),
        Task("D", {"R": Execution(ONE), "E": Execution(ONE)}),
    ]
    return make_problem(
        [R, edge],
        tasks,
        [Flow("A", "B", 1000 * kilobytes), Flow("A", "C", 1000), Flow("B", "D"), Flow("C", "D")],
        links=[
            Link("R", "E", Constant(1.0), rate_mbps=rate_mbps, in_order=in_order),
            Link("E", "R", Constant(1.0)),
        ],
        candidates=MOVES,
        period_ms=100.0,
        deadline_ms=50.0,
        window_cycles=50,
    )


# ------------------------------------------------------------------------------- who is hindered


def sampling(problem: Problem, source: str, target: str) -> Problem:
    """Return the cell with one of its flows sampled."""
    pipeline = problem.pipeline
    flows = tuple(
        replace(flow, sampled=True) if (flow.source, flow.target) == (source, target) else flow
        for flow in pipeline.flows
    )
    return replace(problem, pipeline=replace(pipeline, flows=flows))


def test_a_shadow_gets_no_sampled_message_of_a_shared_job() -> None:
    ordered = fork(in_order=True)
    assert hindered(ordered) == {"LOC"}
    assert hindered(sampling(ordered, "A", "B")) == set()


def test_a_shadow_job_sends_its_sampled_outputs() -> None:
    """Under OFF the shadow of B sends to D, which is not apart, over a link of own messages."""
    problem = fork()
    back = replace(problem.fabric.links["E->R"], in_order=True)
    fabric = replace(problem.fabric, links={**problem.fabric.links, "E->R": back})
    ordered = sampling(replace(problem, fabric=fabric), "B", "D")
    assert hindered(ordered) == {"LOC"}


def test_nobody_is_hindered_by_what_own_jobs_leave_of_cores_and_links_without_a_rate() -> None:
    assert hindered(fork(kilobytes=1000)) == set()


def test_messages_on_a_link_with_a_rate_hinder_the_others_that_are_sent_there() -> None:
    # 100 kB take 8 ms of 100 Mbit/s; OFF sends its shadows nothing that way.
    assert hindered(fork(kilobytes=100, rate_mbps=100.0)) == {"LOC"}


@pytest.mark.parametrize(("kilobytes", "found"), [(1, set()), (2, {"LOC"})])
def test_what_a_link_has_sent_at_once_hinders_nobody(kilobytes: int, found: set[str]) -> None:
    # 1 kB takes 0.08 ms, less than 0.2 % of D.
    assert hindered(fork(kilobytes=kilobytes, rate_mbps=100.0)) == found


def test_a_link_that_keeps_messages_in_order_hinders() -> None:
    assert hindered(fork(in_order=True)) == {"LOC"}


def test_accelerators_of_both_hinder() -> None:
    edge = Node("E", "edge", 4, accelerators={"gpu": 1})
    assert hindered(fork(edge=edge, gpu="gpu")) == {"LOC"}


def test_a_quota_of_both_hinders() -> None:
    edge = Node("E", "edge", 4, quota=Quota(2.0, 100.0))
    assert hindered(fork(edge=edge)) == {"LOC"}


def test_the_canonical_cell_is_priced_without_shadows() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    assert hindered(problem) == set()
    plain, own = StepwisePlayer(problem), StepwisePlayer(problem, shadow_fraction=FRACTION)
    assert own.prices is plain.prices
    assert own.declared is plain.declared
    assert own.declared.shadows is None


# ------------------------------------------------------------------------------------ what is sent


def test_cycles_of_hindered_candidates_alone_are_sent_through_others() -> None:
    problem = fork(kilobytes=100, rate_mbps=100.0)
    real = draw(problem, scenario="baseline", seed=1, windows=4)
    shadows = SentShadows(problem, real, FRACTION)
    player = CandidatePlayer([(problem, real)], shadows=shadows)
    for index, sent in enumerate([shadow_stamps(0, 200, [1], FRACTION), np.full(200, -1)]):
        stamps = player.tables({0: list(problem.candidates)[index]}).tables.stamps
        np.testing.assert_array_equal(stamps, [np.full(200, index), sent])


# ----------------------------------------------------------------------------------- what is played


@pytest.fixture(scope="module")
def playing() -> StepwisePlayer:
    return StepwisePlayer(random_dag(40), shadow_fraction=FRACTION)


def test_what_is_as_declared_is_played_as_declared(playing: StepwisePlayer) -> None:
    names = tuple(playing.problem.candidates)
    site = next(Site(*site) for site in playing.declared.realisation.sites)
    playing.begin(Present(FrozenDict({site: np.array([100.0])})))
    playing.go_on(playing.present, names, 3)
    assert any(playing.played(name).l95_ms > playing.prices[name].l95_ms for name in names)
    # Where the windows are the declared ones, so is the price.
    playing.begin(Present())
    playing.go_on(playing.present, names, 1)
    for name in names:
        played, price = playing.played(name), playing.prices[name]
        assert played.l95_ms == price.l95_ms
        assert played.violation_rate == price.violation_rate


def test_only_what_hindered_candidates_show_as_declared_is_different(
    playing: StepwisePlayer,
) -> None:
    problem, declared = playing.problem, playing.declared
    plain = declared_of(problem)
    assert declared.references is plain.references
    for name in problem.candidates:
        slower = declared.windows[name].l95_ms.mean() > plain.windows[name].l95_ms.mean()
        assert slower == (name in hindered(problem))


def test_traces_of_shadow_jobs_begin_anew_where_they_end() -> None:
    edge = Node("E", "edge", 4, accelerators={"gpu": 1})
    table = TraceTable("rows.csv", {"a": np.array([0.1, 120.0])})
    problem = fork(edge=edge, gpu="gpu", b_ms=Trace(table, "a"))
    price = prices_of(problem, shadow_fraction=0.5)["LOC"]
    assert price.l95_ms > prices_of(problem)["LOC"].l95_ms


def test_shadow_jobs_meet_the_present_too() -> None:
    edge = Node("E", "edge", 4, accelerators={"gpu": 1})
    # Declared, B is done before C is due.
    problem = fork(edge=edge, gpu="gpu", b_ms=Constant(0.01))
    playing = StepwisePlayer(problem, shadow_fraction=0.5)
    alone_ms = playing.prices["LOC"].l95_ms
    playing.begin(Present(FrozenDict({Site("B", "E"): np.array([120.0])})))
    playing.go_on(playing.present, ["LOC"], 3)
    assert playing.played("LOC").l95_ms > alone_ms + 10.0
    playing.begin(Present())
    playing.go_on(playing.present, ["LOC"], 1)
    assert playing.played("LOC").l95_ms == alone_ms


def test_dtp_settles_on_the_candidate_that_is_best_with_shadows() -> None:
    problem = random_dag(40)
    settings: dict[str, Any] = {"decide_cycles": problem.window_cycles, "min_dwell": 3}
    settings["shadow_fraction"] = 0.05
    problem = replace(problem, controller=replace(problem.controller, **settings))
    run = dwell.simulate(problem, policy="dtp", estimator="corrected", seed=1, windows=60).windows
    assert set(run["placement"][10:]) == {"C1"}
