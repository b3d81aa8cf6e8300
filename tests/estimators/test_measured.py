"""A window taken apart: own cycles, shadows, what they share, and what was lost on the way."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from dwell.estimators import Evidence
from dwell.estimators.measured import Message, Meter, Part, Site, groups, parts_of, sending_ns
from dwell.model import Bursts, Constant, Execution, Flow, Link, Node, Problem, Task
from tests.cells.generated import make_problem
from tests.cells.once import with_windows
from tests.estimators.windows import MS, Row, window

ONE = Execution(Constant(1.0))
CHAIN = ("A", "B", "C", "D")
CLOSE_MS = 1000.0

# Under LOC everything runs on R, under OFF B on E, under FAR B and C.
MOVES: dict[str, dict[str, str]] = {"LOC": {}, "OFF": {"B": "E"}, "FAR": {"B": "E", "C": "E"}}
UP, DOWN, ON = Message("A", "B", "R->E"), Message("B", "C", "E->R"), Message("C", "D", "E->R")


def chain() -> Problem:
    """A, B, C, D on R; B and C can run on E."""
    both = {"R": ONE, "E": ONE}
    return make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task(name, both if name in "BC" else {"R": ONE}) for name in CHAIN],
        [Flow(a, b) for a, b in itertools.pairwise(CHAIN)],
        links=[Link("R", "E", Constant(1.0)), Link("E", "R", Constant(1.0))],
        candidates=MOVES,
        period_ms=100.0,
        window_cycles=10,
    )


def times(evidence: Evidence) -> dict[Part, list[float]]:
    found = Meter(chain()).times(evidence)
    return {part: values.tolist() for part, values in found.items()}


def local(begin_ms: float) -> Row:
    """A cycle under LOC whose jobs take 1, 2, 3 and 4 ms."""
    ends = np.array([1.0, 3.0, 6.0, 10.0]) + begin_ms
    return [begin_ms, *ends[:3]], [*ends], [*ends[:3]]


def through_off(begin_ms: float) -> Row:
    """Its shadow through OFF: 5 ms up, 7 ms on E, 6 ms down, 8 ms of C, discarded before D."""
    sent = begin_ms + 1.0
    ready, end = [None, sent + 5, sent + 18, None], [None, sent + 12, sent + 26, None]
    return ready, end, [sent + 5, sent + 18, sent + 26]


# ------------------------------------------------------------------------------------ the parts


def test_the_parts_of_a_placement() -> None:
    problem = chain()
    assert list(parts_of(problem.pipeline, problem.candidates["OFF"])) == [
        *(Site(name, "E" if name == "B" else "R") for name in CHAIN),
        UP,
        DOWN,
    ]


def test_every_part_of_a_cycle() -> None:
    assert times(window([local(0.0), local(100.0)], close_ms=CLOSE_MS)) == {
        Site("A", "R"): [1.0, 1.0],
        Site("B", "R"): [2.0, 2.0],
        Site("C", "R"): [3.0, 3.0],
        Site("D", "R"): [4.0, 4.0],
    }


def test_a_shadow_adds_what_it_does_not_share() -> None:
    found = times(
        window([local(0.0), local(100.0)], close_ms=CLOSE_MS, shadows=[None, through_off(100.0)])
    )
    assert found == {
        Site("A", "R"): [1.0, 1.0],
        Site("B", "R"): [2.0, 2.0],
        # C runs on R either way, but behind B: the shadow has a job of its own there.
        Site("C", "R"): [3.0, 3.0, 8.0],
        Site("D", "R"): [4.0, 4.0],
        Site("B", "E"): [7.0],
        # Sent when the cycle's own A ended.
        UP: [5.0],
        DOWN: [6.0],
    }


def test_shadows_through_several_candidates() -> None:
    sent = 1.0
    far: Row = (
        [None, sent + 5, sent + 12, None],
        [None, sent + 12, sent + 21, None],
        [sent + 5, sent + 12, sent + 30],
    )
    found = times(
        window(
            [local(0.0), local(100.0), local(200.0)],
            close_ms=CLOSE_MS,
            shadows=[far, through_off(100.0), None],
            through=[2, 1, 0],
        )
    )
    assert found[Site("C", "E")] == [9.0]
    assert found[Site("B", "E")] == [7.0, 7.0]
    assert found[UP] == [5.0, 5.0]
    assert (found[DOWN], found[ON]) == ([6.0], [9.0])


def test_a_message_between_tasks_that_both_share_is_the_cycles_own() -> None:
    # Under OFF and under FAR, B runs on E: the way up is shared.
    off: Row = ([0.0, 6.0, 15.0, 18.0], [1.0, 10.0, 18.0, 22.0], [6.0, 15.0, 18.0])
    far: Row = ([None, None, 10.0, None], [None, None, 19.0, None], [None, 10.0, 28.0])
    found = times(window([off], close_ms=CLOSE_MS, placement=[1], shadows=[far], through=[2]))
    assert found[UP] == [5.0]
    assert (found[Site("C", "R")], found[Site("C", "E")]) == ([3.0], [9.0])
    assert (found[DOWN], found[ON]) == ([5.0], [9.0])


def test_a_window_of_two_placements() -> None:
    off: Row = ([0.0, 6.0, 15.0, 18.0], [1.0, 10.0, 18.0, 22.0], [6.0, 15.0, 18.0])
    found = times(window([local(0.0), off], close_ms=CLOSE_MS, placement=[0, 1]))
    assert found[Site("A", "R")] == [1.0, 1.0]
    assert (found[Site("B", "R")], found[Site("B", "E")]) == ([2.0], [4.0])
    assert (found[UP], found[DOWN]) == ([5.0], [5.0])


# -------------------------------------------------------------------------- lost and in flight


def test_what_is_unknown_is_left_out_and_what_is_lost_is_infinite() -> None:
    lost: Row = ([0.0, 1.0, None, None], [1.0, None, None, None], [1.0, None, None])
    young: Row = ([900.0, 901.0, None, None], [901.0, None, None, None], [901.0, None, None])
    found = times(window([lost, young], close_ms=CLOSE_MS))
    assert found == {Site("A", "R"): [1.0, 1.0], Site("B", "R"): [math.inf]}


def test_nothing_is_known_of_a_window_that_has_just_begun() -> None:
    nothing: Row = ([None] * 4, [None] * 4, [None] * 3)
    assert times(window([nothing], close_ms=CLOSE_MS)) == {}


def test_what_a_lost_shadow_never_came_to_was_not_lost_there() -> None:
    # Lost on the way up: B and C of the shadow never were, nor did they send anything.
    gone: Row = ([None] * 4, [None] * 4, [None] * 3)
    found = times(window([local(0.0)], close_ms=CLOSE_MS, shadows=[gone]))
    assert found[UP] == [math.inf]
    assert DOWN not in found
    assert Site("B", "E") not in found
    assert found[Site("C", "R")] == [3.0]


def test_a_shadow_of_a_cycle_that_was_lost_before_it_says_nothing() -> None:
    lost: Row = ([0.0, None, None, None], [None] * 4, [None] * 3)
    gone: Row = ([None] * 4, [None] * 4, [None] * 3)
    assert times(window([lost], close_ms=CLOSE_MS, shadows=[gone])) == {Site("A", "R"): [math.inf]}


def test_a_shadow_in_flight_adds_what_it_has_done() -> None:
    sent = 900.0 + 1.0
    half: Row = (
        [None, sent + 5, None, None],
        [None, sent + 12, None, None],
        [sent + 5, None, None],
    )
    found = times(window([local(900.0)], close_ms=CLOSE_MS, shadows=[half]))
    assert (found[UP], found[Site("B", "E")]) == ([5.0], [7.0])
    assert DOWN not in found


# ------------------------------------------------------------------------------------- demands


def wide(node: Node, threads: int = 1, accelerator: str | None = None) -> Problem:
    """A on R sends 100 kB each to B and C on a node, at 20 Mbit/s."""
    job = Execution(Constant(1.0), threads=threads, accelerator=accelerator)
    return make_problem(
        [Node("R", "robot"), node],
        [Task("A", {"R": ONE}), Task("B", {"E": job}), Task("C", {"E": job})],
        [Flow("A", "B", 100_000), Flow("A", "C", 100_000)],
        links=[Link("R", "E", Constant(1.0), rate_mbps=20.0), Link("E", "R", Constant(1.0))],
        window_cycles=10,
    )


def shown(work_ms: Sequence[float | None], *, start_ms: bool = True, work: bool = True) -> Evidence:
    """A cycle whose jobs took 10, 12 and 16 ms, with so much core time, None for unknown.

    A's messages arrive 45 and 86 ms after it has ended; jobs start 2 ms after they are ready.
    """
    arrived = [55.0, 96.0]
    ready, end = [0.0, *arrived], [12.0 - 2.0, 55.0 + 14.0, 96.0 + 18.0]
    evidence = window([(ready, end, arrived)], close_ms=CLOSE_MS)
    cycles = evidence.cycles
    start_ns = np.where(cycles.ready_ns > 0, cycles.ready_ns + 2 * MS, cycles.ready_ns)
    known = [-1 if ms is None else round(ms * MS) for ms in work_ms]
    cycles = replace(
        cycles,
        start_ns=start_ns if start_ms else None,
        work_ns=np.array([known]) if work else None,
    )
    return evidence.with_instants(cycles, evidence.shadows)


E4 = Node("E", "edge", 4)
A, B, C = Site("A", "R"), Site("B", "E"), Site("C", "E")
TO_B, TO_C = Message("A", "B", "R->E"), Message("A", "C", "R->E")


def demands(
    problem: Problem, evidence: Evidence, foreign: Mapping[str, float] | None = None
) -> dict[Part, list[float]]:
    found = copy.deepcopy(Meter(problem)).demands(evidence, foreign)
    return {part: values.tolist() for part, values in found.items()}


@pytest.mark.parametrize(
    ("threads", "accelerator", "alone_ms"),
    [(1, None, 12.0), (2, None, 6.0), (4, None, 3.0), (8, None, 3.0), (8, "gpu", 12.0)],
)
def test_the_demand_of_a_job_is_its_time_alone(
    threads: int, accelerator: str | None, alone_ms: float
) -> None:
    problem = wide(Node("E", "edge", 4, accelerators={"gpu": 1}), threads, accelerator)
    found = demands(problem, shown([7.0, 12.0, None]))
    assert (found[A], found[B]) == ([7.0], [alone_ms])


def test_the_demand_of_a_message_is_its_delay() -> None:
    found = demands(wide(E4), shown([7.0, 12.0, 16.0]))
    # Each takes 40 ms on the link, and the second waits for the first.
    assert (found[TO_B], found[TO_C]) == ([5.0], [6.0])
    assert sending_ns(wide(E4), TO_B) == 40e6
    assert sending_ns(chain(), UP) == 0.0


def test_jobs_beside_foreign_threads_need_more_core_time() -> None:
    problem = wide(replace(E4, interference=2.0))
    for threads, of_it in ((0.0, 1.0), (0.4, 1.0), (0.6, 0.5), (9.0, 0.5)):
        found = demands(problem, shown([7.0, 12.0, 16.0]), {"E": threads})
        assert (found[A], found[B], found[C]) == ([7.0], [12.0 * of_it], [16.0 * of_it])


def test_what_jobs_need_beside_bursts_is_declared() -> None:
    bursts = Bursts(Constant(300.0), Constant(100.0), threads=4)
    problem = wide(replace(E4, interference=2.0, bursts=bursts))
    for threads, of_it in ((1.0, 1.0), (1.4, 1.0), (1.6, 0.5)):
        assert demands(problem, shown([7.0, 12.0, 16.0]), {"E": threads})[B] == [12.0 * of_it]


@pytest.mark.parametrize(
    ("node", "threads", "foreign", "cores"),
    [
        (E4, 1, 0.0, 1.0),
        (E4, 2, 0.0, 2.0),
        (E4, 8, 0.0, 4.0),
        # Three threads leave one core, five take turns on four with the job's own.
        (E4, 1, 3.0, 1.0),
        (E4, 1, 7.0, 0.5),
        (E4, 4, 4.0, 2.0),
        (replace(E4, scheduler="fifo"), 1, 4.0, 0.5),
        (replace(E4, scheduler="priority"), 4, 4.0, 2.0),
    ],
)
@pytest.mark.parametrize("start_ms", [True, False])
def test_work_that_is_not_known_is_told_by_how_long_a_job_took(
    node: Node, threads: int, foreign: float, cores: float, start_ms: bool
) -> None:
    problem = wide(node, threads)
    # From its start, or from when it was ready where that is not known.
    taken_ms = [10.0, *((12.0, 16.0) if start_ms else (14.0, 18.0))]
    for evidence in (
        shown([None] * 3, start_ms=start_ms),
        shown([None] * 3, start_ms=start_ms, work=False),
    ):
        work_ns = Meter(problem).work_ns(evidence.cycles, evidence.placement, {"E": foreign})
        assert work_ns.tolist() == [[10 * MS, *(round(ms * cores * MS) for ms in taken_ms[1:])]]


def test_work_that_is_known_is_left_as_it_is() -> None:
    evidence = shown([7.0, None, 3.0])
    work_ns = Meter(wide(E4)).work_ns(evidence.cycles, evidence.placement, {"E": 12.0})
    assert work_ns[0, 0] == 7 * MS
    assert work_ns[0, 2] == 3 * MS
    assert work_ns[0, 1] == pytest.approx(12 * MS * 4 / 13, abs=1)


def test_of_what_has_not_ended_no_work_is_told() -> None:
    evidence = window([([0.0, 55.0, None], [10.0, None, None], [55.0, None])], close_ms=CLOSE_MS)
    work_ns = Meter(wide(E4)).work_ns(evidence.cycles, evidence.placement, {})
    assert work_ns.tolist() == [[10 * MS, -1, -1]]
    found = demands(wide(E4), evidence)
    assert found == {A: [10.0], TO_B: [5.0], TO_C: [math.inf]}


def test_shadows_add_their_demands() -> None:
    evidence = window(
        [local(0.0), local(100.0)], close_ms=CLOSE_MS, shadows=[None, through_off(100.0)]
    )
    assert demands(chain(), evidence) == times(evidence)


# ----------------------------------------------------------------------------------- any window


@pytest.mark.parametrize("codes", [[3], [3, 3, 3], [1, 0, 1], [-1, 2, -1, 0], [0, 1, 2]])
def test_groups_are_every_code_with_its_rows(codes: Sequence[int]) -> None:
    numbers = np.arange(len(codes))
    found: Mapping[int, list[int]] = {
        code: numbers[rows].tolist() for code, rows in groups(np.array(codes, np.int16))
    }
    assert found == {
        code: [i for i, other in enumerate(codes) if other == code] for code in sorted(set(codes))
    }


# -------------------------------------------------------------------------------- several rates


@pytest.mark.parametrize(("age_ms", "is_lost"), [(250.0, False), (1999.0, False), (2001.0, True)])
def test_a_message_of_a_slow_task_is_lost_after_two_of_its_intervals(
    age_ms: float, is_lost: bool
) -> None:
    problem = chain()
    tasks = {name: replace(task, every=None) for name, task in problem.pipeline.tasks.items()}
    tasks["A"] = replace(tasks["A"], every=10)
    pipeline = replace(problem.pipeline, tasks=tasks)
    slow = replace(with_windows(problem, 100), pipeline=pipeline)
    begin_ms = CLOSE_MS * 10 - age_ms - 1.0
    row: Row = [begin_ms, None, None, None], [begin_ms + 1.0, None, None, None], [None] * 3
    evidence = window([row], placement=[1], close_ms=CLOSE_MS * 10)
    for measure in (Meter(slow).times, Meter(slow).demands):
        found = measure(evidence)
        assert found[Site("A", "R")].tolist()[:1] in ([1.0], [])
        assert [*found.get(UP, [])] == ([math.inf] if is_lost else [])
