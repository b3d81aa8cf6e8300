"""Cold migrations by hand, in milliseconds: when an order takes effect, and what it costs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl
import pytest

import dwell
from dwell.kernels.realisation import LinkSegment, NodeChange
from dwell.model import Constant, ControllerSettings, Execution, Flow, Link, Node, Problem, Task
from tests.cells.generated import MS, make_problem, make_realisation
from tests.reference.simulator import attempt_uniform, control
from tests.reference.test_against import (
    Case,
    Played,
    Replay,
    differences,
    make_case,
    reference,
)
from tests.reference.test_against import play as play_case

CANONICAL = Path(__file__).parents[2] / "examples" / "canonical.yaml"
MOVES = {"LOC": {"B": "R"}, "OFF": {"B": "E"}}
STATE = ("B", "B", "R->E")


def task(name: str, *nodes: str, **more: Any) -> Task:
    return Task(name, {node: Execution(Constant(1.0)) for node in nodes or ("R",)}, **more)


def cell(
    *,
    state_bytes: int = 10_000,
    start_ms: float = 3.0,
    message_bytes: int = 1000,
    others: Sequence[Task] = (),
    moves: Mapping[str, Mapping[str, str]] = MOVES,
    link: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Problem:
    """Return a problem with windows of two cycles of 10 ms, in which B may move from R to E.

    An order takes 2 ms, and 1000 bytes 1 ms. D is on E: S sends it a message every cycle.
    """
    more = {"rate_mbps": 8.0, **(link or {})}
    return make_problem(
        [Node("R", "robot", 8), Node("E", "edge", 8)],
        [
            task("S"),
            task("B", "R", "E", state_bytes=state_bytes, start_ms=start_ms),
            task("D", "E"),
            task("K"),
            *others,
        ],
        [Flow("S", "D", message_bytes), Flow("S", "B"), Flow("B", "K")],
        links=[Link("R", "E", Constant(1.0), **more), Link("E", "R", Constant(1.0), **more)],
        candidates=moves,
        period_ms=10.0,
        window_cycles=2,
        controller=ControllerSettings(
            on="R", migration="cold", **{"order_delay_ms": 2.0, **settings}
        ),
    )


def play(
    problem: Problem,
    script: Sequence[str] = ("OFF",),
    *,
    windows: int = 10,
    changes: Sequence[NodeChange] = (),
    segments: Sequence[LinkSegment] = (),
    delay_ms: Mapping[tuple[str, str, str], Sequence[float]] | None = None,
) -> Played:
    """Play orders, the last of them at every close that follows, as the reference does."""
    names = [*script, *[script[-1]] * windows][:windows]
    real = make_realisation(
        problem, windows=windows, node_changes=changes, segments=segments, delay_ms=delay_ms
    )
    case = Case(problem, real, (problem.initial, *names[:-1]))
    run = dwell.simulate_realisation(problem, real, policy=Replay(names), jobs=True)
    assert run.jobs is not None
    found = Played(run.cycles, run.jobs, run.windows)
    assert list(differences(case, found, control(problem, real, names), 0)) == []
    return found


def moved_at(found: Played) -> int | None:
    """First cycle that runs under OFF."""
    names = found.cycles["placement"].to_list()
    return names.index("OFF") if "OFF" in names else None


def windows_of(found: Played) -> list[tuple[int, str]]:
    return found.windows.select("first_cycle", pl.col("placement").cast(str)).rows()


def ready(found: Played, task: str, cycle: int) -> float:
    """When a task of a cycle had its inputs, milliseconds."""
    mine = found.jobs.filter((pl.col("task") == task) & (pl.col("cycle") == cycle))
    return float(mine["ready_ns"][0] / MS)


# ------------------------------------------------------------------------- when it takes effect


@pytest.mark.parametrize(
    ("problem", "cycle"),
    [
        # The window closes at 20. Order 22, worker 25, state on the link to 35 and there at 36.
        (cell(), 4),
        # Exactly at the release of cycle 4, and a nanosecond later.
        (cell(start_ms=7.0), 4),
        (cell(start_ms=7.000001), 5),
        (cell(start_ms=8.0, order_delay_ms=1.0), 4),
        # A worker without state is ready at 25, or with the order itself.
        (cell(state_bytes=0), 3),
        (cell(state_bytes=0, start_ms=0.0), 3),
        (cell(state_bytes=0, start_ms=0.0, order_delay_ms=0.0), 2),
        # The lead counts from the end of the window.
        (cell(order_lead_cycles=2), 4),
        (cell(order_lead_cycles=5), 7),
        # The window closes 4 ms later, and so does all that follows.
        (cell(close_grace_ms=4.0), 4),
        (cell(close_grace_ms=5.0), 5),
    ],
)
def test_the_first_cycle_that_a_cold_migration_stamps(problem: Problem, cycle: int) -> None:
    found = play(problem)
    assert moved_at(found) == cycle
    # No window closes meanwhile; the next one begins with the first cycle under OFF.
    assert windows_of(found)[:3] == [(0, "LOC"), (cycle, "OFF"), (cycle + 2, "OFF")]
    assert not found.windows["mixed"].any()


def test_the_last_task_that_is_ready_decides() -> None:
    # From E to R, on the other link: at 22 + 30 on it, at 72 off it, there at 73.
    other = task("A", "E", "R", state_bytes=20_000, start_ms=30.0)
    moves = {"LOC": {"B": "R", "A": "E"}, "OFF": {"B": "E", "A": "R"}}
    problem = cell(others=[other], moves=moves)
    assert moved_at(play(problem, windows=12)) == 8


def test_two_tasks_on_one_link_move_one_after_another() -> None:
    other = task("A", "R", "E", state_bytes=10_000, start_ms=3.0)
    moves = {"LOC": {"B": "R", "A": "R"}, "OFF": {"B": "E", "A": "E"}}
    problem = cell(others=[other], moves=moves)
    # 25 to 45, there at 46; alone it would have been 36. A message waits from 31 to 45.
    found = play(problem)
    assert moved_at(found) == 5
    assert ready(found, "D", 3) == 47


def test_where_nothing_moves_the_order_itself_is_all_that_takes_time() -> None:
    found = play(cell(moves={"LOC": {"B": "R"}, "OFF": {"B": "R"}}))
    assert moved_at(found) == 3


def test_orders_one_after_another() -> None:
    found = play(cell(), ["OFF", "OFF", "LOC"], windows=12)
    # OFF from cycle 4 on; its second window closes at 80 and the state is back at 96.
    assert windows_of(found)[:5] == [(0, "LOC"), (4, "OFF"), (6, "OFF"), (10, "LOC"), (12, "LOC")]


# --------------------------------------------------------------------------- what it costs a link


def test_state_delays_the_messages_behind_it() -> None:
    found = play(cell())
    # S sends at 21, 31 and 41: only the second finds the link taken, up to 35.
    assert [ready(found, "D", k) for k in (2, 3, 4)] == [23, 37, 43]


def test_state_waits_for_the_messages_before_it() -> None:
    # The message that S sends at 21 is on the link until 29: the state is there at 40.
    found = play(cell(message_bytes=8000))
    assert moved_at(found) == 4
    assert ready(found, "D", 3) == 48
    assert moved_at(play(cell(message_bytes=8000, state_bytes=10_001))) == 5


def test_state_overtakes_a_message_unless_the_link_is_in_order() -> None:
    # The message of cycle 2, sent at 21, propagates for 30 ms.
    delay_ms = {("S", "D", "R->E"): [30.0 if k == 2 else 1.0 for k in range(20)]}
    assert moved_at(play(cell(), delay_ms=delay_ms)) == 4
    found = play(cell(link={"in_order": True}), delay_ms=delay_ms)
    # It arrives with that message, at 52, and so does the next message.
    assert moved_at(found) == 6
    assert ready(found, "D", 3) == 52


def test_state_has_delays_of_its_own() -> None:
    delay_ms = {STATE: [7.0] * 20}
    assert moved_at(play(cell(), delay_ms=delay_ms)) == 5


def first_order(problem: Problem, lost: Sequence[bool], loss: float) -> int:
    """Windows before the first close whose state loses the attempts that it should."""
    real = make_realisation(problem, windows=100)
    key = int(real.loss_keys[real.hops.index(STATE)])
    for before in itertools.count():
        drawn = [attempt_uniform(key, 2 * before + 2, a) < loss for a in range(len(lost))]
        if drawn == list(lost):
            return before
    raise AssertionError


@pytest.mark.parametrize(
    ("retransmit_ms", "lost", "after"),
    [
        (5.0, [False], 2),
        # Lost at 35 after the close of the window before; sent again from 40 to 50, there at 51.
        (5.0, [True, False], 4),
        (5.0, [True, True, False], 5),
        # Sent again after 200 ms where the link itself would not.
        (None, [True, False], 23),
    ],
)
def test_state_that_is_lost_is_sent_again(
    retransmit_ms: float | None, lost: Sequence[bool], after: int
) -> None:
    problem = cell(link={"loss": 0.5, "retransmit_ms": retransmit_ms}, message_bytes=0)
    before = first_order(problem, lost, 0.5)
    found = play(problem, [*["LOC"] * before, "OFF"], windows=before + 30)
    assert moved_at(found) == 2 * before + 2 + after


def lossy(begin_ms: float, end_ms: float) -> list[LinkSegment]:
    """Let all attempts be lost that begin within a stretch of time."""
    times = [(0.0, 0.0), (begin_ms, 1.0), (end_ms, 0.0)]
    return [LinkSegment(round(at * MS), "R->E", False, loss, 8.0, ()) for at, loss in times]


@pytest.mark.parametrize(("retransmit_ms", "there"), [(50.0, 96.0), (None, 246.0)])
def test_messages_wait_for_state_that_is_sent_again_where_order_is_kept(
    retransmit_ms: float | None, there: float
) -> None:
    # Sent from 25 to 35 and lost; messages of cycles 3 and later get through.
    for in_order in (False, True):
        link = {"in_order": in_order, "retransmit_ms": retransmit_ms}
        found = play(cell(link=link), segments=lossy(24.5, 30), windows=20)
        assert moved_at(found) == math.ceil(there / 10)
        assert [ready(found, "D", k) for k in (2, 3, 4)] == (
            [23, there, there] if in_order else [23, 37, 43]
        )


def test_state_waits_for_a_message_that_is_sent_again_where_order_is_kept() -> None:
    # The message of cycle 2, sent at 21, is lost; the state arrives with its repeat, at 74.
    link = {"in_order": True, "retransmit_ms": 50.0}
    found = play(cell(link=link), segments=lossy(20, 24), windows=20)
    assert [ready(found, "D", k) for k in (2, 3)] == [74, 74]
    assert moved_at(found) == 8


def test_messages_wait_for_state_of_a_void_order_until_it_would_be_sent_again() -> None:
    moves = {**MOVES, "ALT": {"B": "R"}}
    problem = cell(link={"in_order": True}, moves=moves, fallbacks=("ALT",), guard_cycles=3)
    real = make_realisation(problem, windows=20, segments=lossy(24.5, 30))
    case = Case(problem, real, ("LOC", *["OFF"] * 19), guarded=True)
    found = play_case(case)
    assert list(differences(case, found, reference(case), 0)) == []
    # Lost at 35. The guard moves at 60; else it would be sent again at 235.
    assert found.cycles["placement"].to_list()[5:7] == ["LOC", "ALT"]
    assert [ready(found, "D", k) for k in (2, 3, 20)] == [23, 235, 235]


def outage(begin_ms: float, end_ms: float, loss: float = 0.0) -> list[LinkSegment]:
    times = [(0.0, False), (begin_ms, True), (end_ms, False)]
    return [
        LinkSegment(round(at * MS), "R->E", down, loss, 8.0, ())
        for at, down in times
        if at < math.inf
    ]


@pytest.mark.parametrize("retransmit_ms", [5.0, None])
def test_state_waits_for_the_end_of_an_outage(retransmit_ms: float | None) -> None:
    # From 44 to 54, there at 55. On a link that holds them back, messages wait with it: that of
    # cycle 2 ahead of it, that of cycle 3 behind.
    found = play(cell(link={"retransmit_ms": retransmit_ms}), segments=outage(20.5, 44))
    assert moved_at(found) == 6
    if retransmit_ms is not None:
        assert [ready(found, "D", k) for k in (2, 3)] == [46, 57]
    else:
        assert found.cycles["outcome"].to_list()[2:4] == ["dropped"] * 2


def test_waiting_for_the_end_of_an_outage_is_no_attempt() -> None:
    # The first attempt gets through; a second one would be lost.
    problem = cell(link={"loss": 0.5}, message_bytes=0)
    before = first_order(problem, [False, True], 0.5)
    begin = 20.0 * before + 20.5
    found = play(
        problem,
        [*["LOC"] * before, "OFF"],
        windows=before + 10,
        segments=outage(begin, begin + 23.5, loss=0.5),
    )
    assert moved_at(found) == 2 * before + 6


@pytest.mark.parametrize("retransmit_ms", [5.0, None])
def test_over_a_link_that_stays_down_a_cell_never_migrates(retransmit_ms: float | None) -> None:
    found = play(cell(link={"retransmit_ms": retransmit_ms}), segments=outage(20.5, math.inf))
    assert windows_of(found) == [(0, "LOC")]
    # All cycles are released while it migrates, and none of these is in a window.
    assert found.cycles["lead"].to_list() == [False] * 2 + [True] * 18


def test_a_run_that_ends_first_never_migrates() -> None:
    found = play(cell(state_bytes=1_000_000))
    assert windows_of(found) == [(0, "LOC")]
    # An order of the very last window.
    found = play(cell(), [*["LOC"] * 9, "OFF"])
    assert windows_of(found) == [(2 * k, "LOC") for k in range(10)]


# ------------------------------------------------------------------------------ what it does not


def test_a_target_that_is_down_loses_its_cycles_and_nothing_else() -> None:
    changes = [NodeChange(21 * MS, "E", 0, True), NodeChange(75 * MS, "E", 0, False)]
    found = play(cell(), changes=changes)
    assert moved_at(found) == 4
    outcomes = found.cycles["outcome"].to_list()
    assert outcomes == ["done"] * 2 + ["node_down"] * 6 + ["done"] * (len(outcomes) - 8)


@pytest.mark.parametrize("seed", range(8))
def test_without_start_and_state_a_cold_migration_is_a_warm_one(seed: int) -> None:
    case = make_case(seed, ("fair", "fifo", "priority"), orders=True)
    pipeline = case.problem.pipeline
    tasks = {
        name: replace(task, start_ms=0.0, state_bytes=0) for name, task in pipeline.tasks.items()
    }
    runs = []
    for migration in ("warm", "cold"):
        problem = replace(
            case.problem,
            pipeline=replace(pipeline, tasks=tasks),
            controller=replace(
                case.problem.controller,
                migration=migration,
                decide_cycles=case.problem.window_cycles,
            ),
        )
        windows = case.real.windows
        real = dwell.draw(problem, scenario="disturbed", seed=seed, windows=windows)
        policy = Replay([*case.names[1:], case.names[0]])
        runs.append(dwell.simulate_realisation(problem, real, policy=policy, jobs=True))
    for table in ("cycles", "windows", "decisions", "jobs"):
        assert getattr(runs[0], table).equals(getattr(runs[1], table)), table


# ----------------------------------------------------------------------------------- in the large


@pytest.fixture(scope="module")
def cold() -> Problem:
    """Return the canonical cell with state to carry and workers to start."""
    problem = dwell.load(CANONICAL)
    pipeline = problem.pipeline
    tasks = {
        name: replace(task, start_ms=400.0, state_bytes=20_000_000) if len(task.on) > 1 else task
        for name, task in pipeline.tasks.items()
    }
    return replace(
        problem,
        pipeline=replace(pipeline, tasks=tasks),
        controller=replace(problem.controller, migration="cold"),
    )


def test_windows_and_decisions_of_a_cell_that_migrates_cold(cold: Problem) -> None:
    run = dwell.simulate(cold, scenario="network-impairment-mild", policy="dtp", seed=1, windows=60)
    migrated = run.decisions.filter("migrated")["window"].to_list()
    assert len(migrated) >= 3
    # N_min windows lie between two migrations, however long each of them takes.
    assert all(b - a > cold.controller.min_dwell for a, b in itertools.pairwise(migrated))
    first = run.windows["first_cycle"].to_list()
    gaps = [b - a - cold.window_cycles for a, b in itertools.pairwise(first)]
    # 0.4 s until a worker has started, 0.17 s on the link: 17 cycles at least are in no window.
    assert {k: gap >= 17 for k, gap in enumerate(gaps) if gap} == {
        k: True for k in migrated if k < len(gaps)
    }
    placed = run.cycles["placement"].to_list()
    for k in migrated:
        if k < len(gaps):
            between = range(first[k], first[k + 1])
            assert {placed[cycle] for cycle in between} == {run.windows["placement"][k]}
            assert placed[first[k + 1]] == run.decisions["placement"][k]
    assert not run.windows["mixed"].any()


def test_a_seed_determines_a_run_that_migrates_cold(cold: Problem) -> None:
    one, again = (
        dwell.simulate(cold, scenario="network-impairment", policy="dtp", seed=3, windows=20)
        for _ in range(2)
    )
    for table in ("cycles", "windows", "decisions"):
        assert getattr(one, table).equals(getattr(again, table)), table


def test_state_shifts_no_other_draws(cold: Problem) -> None:
    plain = dwell.load(CANONICAL)
    one, other = (dwell.draw(problem, seed=1, windows=3) for problem in (plain, cold))
    assert (one.exec_ns == other.exec_ns).all()
    rows = [other.hops.index(hop) for hop in one.hops]
    assert (one.delay_ns == other.delay_ns[rows]).all()
    assert (one.loss_keys == other.loss_keys[rows]).all()
    state = set(other.hops) - set(one.hops)
    assert {(source, target) for source, target, _ in state} == {
        ("perception", "perception"),
        ("planning", "planning"),
    }
