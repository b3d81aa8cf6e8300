"""The simulator against the second, slow one, over problems made at random.

The environment variable DWELL_EXAMPLES sets how many problems of each kind are tried.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from random import Random
from typing import cast

import numba
import numpy as np
import pytest

import dwell
from dwell.kernels import streams
from dwell.model import (
    Constant,
    ControllerSettings,
    Execution,
    Flow,
    Link,
    Node,
    Problem,
    QoS,
    Task,
)
from dwell.sim.realisation import LinkSegment, NodeChange, Realisation
from tests.generate import (
    MS,
    Scheduler,
    make_problem,
    make_realisation,
    random_problem,
    random_stamps,
)
from tests.reference_simulator import NEAR_NS, CycleResult, Result, attempt_uniform, simulate

EXAMPLES = int(os.environ.get("DWELL_EXAMPLES", "80"))
FAIR_TOLERANCE_NS = NEAR_NS
MOST_EXCLUDED = 0.1


class Replay:
    """A policy that says its names one after another, whatever it sees."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self.next = iter(self.names)

    def start(self, problem: Problem) -> None:
        """Begin again."""
        self.next = iter(self.names)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        """Say the next name."""
        return next(self.next)


@dataclass(frozen=True)
class Case:
    """A problem, a realisation of it, and a candidate for every window."""

    problem: Problem
    real: Realisation
    names: tuple[str, ...]


def make_case(seed: int, schedulers: Sequence[Scheduler], *, whole_ms: bool = False) -> Case:
    rng = Random(seed)
    problem = random_problem(rng, schedulers=schedulers, whole_ms=whole_ms)
    windows = rng.randint(2, 8)
    names = tuple(random_stamps(rng, problem, windows))
    real = dwell.draw(problem, scenario="disturbed", seed=seed, windows=windows)
    return Case(problem, real, names)


def play(case: Case) -> dwell.Run:
    # One name more: the last window closes with a decision too.
    policy = Replay([*case.names[1:], case.names[0]])
    return dwell.simulate_realisation(case.problem, case.real, policy=policy, jobs=True)


def stamps(run: dwell.Run) -> list[str]:
    return [str(name) for name in run.cycles.sort("cycle")["placement"]]


# ------------------------------------------------------------------------------- differences


def differences(case: Case, run: dwell.Run, result: Result, tolerance_ns: int) -> Iterator[str]:
    """Say in what a run differs from the reference."""
    yield from cycle_differences(run, result, tolerance_ns)
    yield from job_differences(run, result, tolerance_ns)
    yield from utilisation_differences(case, run, result)


def differs(found: int | None, expected: int | None, tolerance_ns: int) -> bool:
    if found is None or expected is None:
        return found is not expected
    return abs(found - expected) > tolerance_ns


def cycle_differences(run: dwell.Run, result: Result, tolerance_ns: int) -> Iterator[str]:
    rows = list(run.cycles.sort("cycle").iter_rows(named=True))
    assert [row["cycle"] for row in rows] == list(range(len(result.cycles)))
    for row, expected in zip(rows, result.cycles, strict=True):
        where = f"cycle {row['cycle']}"
        if row["outcome"] != expected.outcome:
            yield f"{where}: outcome {row['outcome']}, expected {expected.outcome}"
        if differs(row["latency_ns"], expected.latency_ns, tolerance_ns):
            yield f"{where}: latency_ns {row['latency_ns']}, expected {expected.latency_ns}"
        parts = [row[column] for column in ("compute_ns", "queue_ns", "network_ns")]
        if not is_split(parts, expected, tolerance_ns):
            yield f"{where}: split into {parts}, expected {set(expected.splits)}"


def is_split(parts: Sequence[int | None], expected: CycleResult, tolerance_ns: int) -> bool:
    if not expected.splits:
        return all(part is None for part in parts)
    # Each part is a sum of differences along a path.
    return any(
        not any(
            differs(*pair, 4 * tolerance_ns) for pair in zip(parts, astuple(split), strict=True)
        )
        for split in expected.splits
    )


def job_differences(run: dwell.Run, result: Result, tolerance_ns: int) -> Iterator[str]:
    assert run.jobs is not None
    rows = {(row["cycle"], row["task"]): row for row in run.jobs.iter_rows(named=True)}
    for key in sorted(rows.keys() ^ result.jobs.keys()):
        yield f"job {key}: {'unexpected' if key in rows else 'missing'}"
    for key in sorted(rows.keys() & result.jobs.keys()):
        row, expected = rows[key], result.jobs[key]
        for column in ("node", "outcome"):
            if row[column] != getattr(expected, column):
                yield f"job {key}: {column} {row[column]}, expected {getattr(expected, column)}"
        for column in ("ready_ns", "start_ns", "end_ns"):
            value = getattr(expected, column)
            if differs(row[column], value, tolerance_ns):
                yield f"job {key}: {column} {row[column]}, expected {value}"


def utilisation_differences(case: Case, run: dwell.Run, result: Result) -> Iterator[str]:
    window = case.problem.window_cycles
    closes = [int(ns) for ns in case.real.release_ns[::window]]
    windows = run.windows.sort("window")
    assert len(windows) == case.real.windows
    for name, node in case.problem.fabric.nodes.items():
        for k, found in enumerate(windows[f"u_{name}"]):
            busy = result.busy[name][k + 1] - result.busy[name][k]
            expected = min(1.0, float(busy) / (node.capacity * (closes[k + 1] - closes[k])))
            if found is None or abs(found - expected) > 1e-6:
                yield f"window {k}: u_{name} {found}, expected {expected}"


def examine(case: Case, tolerance_ns: int) -> list[str] | None:
    """Return how the two differ; None where the case is excluded."""
    run = play(case)
    result = simulate(case.problem, case.real, stamps(run))
    if tolerance_ns and result.closest_ns is not None:
        return None
    return list(differences(case, run, result, tolerance_ns))


# -------------------------------------------------------------------------------------- tests


def compare(
    schedulers: Sequence[Scheduler], tolerance_ns: int = 0, *, whole_ms: bool = False
) -> None:
    excluded = 0
    failures: list[str] = []
    for seed in range(EXAMPLES):
        found = examine(make_case(seed, schedulers, whole_ms=whole_ms), tolerance_ns)
        if found is None:
            excluded += 1
        elif found:
            failures.append(f"make_case({seed}, {schedulers}, whole_ms={whole_ms}): {found[:3]}")
    assert not failures, f"{len(failures)} of {EXAMPLES} differ:\n" + "\n".join(failures[:10])
    assert excluded <= MOST_EXCLUDED * EXAMPLES


@pytest.mark.parametrize(
    "schedulers",
    [("fifo",), ("priority",), ("fifo", "priority")],
    ids="-".join,
)
def test_equal_to_the_nanosecond_without_processor_sharing(
    schedulers: Sequence[Scheduler],
) -> None:
    compare(schedulers)


@pytest.mark.parametrize("schedulers", [("fifo",), ("priority",)], ids=lambda names: names[0])
def test_equal_where_many_events_fall_on_the_same_instant(schedulers: Sequence[Scheduler]) -> None:
    compare(schedulers, whole_ms=True)


@pytest.mark.parametrize("schedulers", [("fair",), ("fair", "fifo", "priority")], ids="-".join)
def test_equal_to_the_microsecond_with_processor_sharing(schedulers: Sequence[Scheduler]) -> None:
    compare(schedulers, FAIR_TOLERANCE_NS)


def test_cycles_are_stamped_as_decided() -> None:
    for seed in range(min(EXAMPLES, 100)):
        case = make_case(seed, ("fair", "fifo", "priority"))
        controller = case.problem.controller_node
        if any(change.down and change.node == controller for change in case.real.node_changes):
            continue
        expected = [name for name in case.names for _ in range(case.problem.window_cycles)]
        assert stamps(play(case)) == expected


# ------------------------------------------------------------------- the page, word by word


def task(
    name: str,
    ms: float,
    node: str = "R",
    *,
    threads: int = 1,
    accelerator: str | None = None,
    priority: int = 0,
    offset_ms: float = 0.0,
    start_ms: float = 0.0,
) -> Task:
    on = {node: Execution(Constant(ms), threads=threads, accelerator=accelerator)}
    return Task(name, on, priority=priority, offset_ms=offset_ms, start_ms=start_ms)


def by_hand(
    nodes: Sequence[Node],
    tasks: Sequence[Task],
    flows: Sequence[Flow] = (),
    *,
    links: Sequence[Link] = (),
    changes: Sequence[NodeChange] = (),
    segments: Sequence[LinkSegment] = (),
    period_ms: float = 100,
    windows: int = 1,
) -> Case:
    controller = ControllerSettings(on=nodes[0].name)
    problem = make_problem(
        nodes, tasks, flows, links=links, period_ms=period_ms, controller=controller
    )
    real = make_realisation(problem, windows=windows, node_changes=changes, segments=segments)
    return Case(problem, real, ("LOC",) * windows)


FIFO = Node("R", "robot", scheduler="fifo")
PRIORITY = Node("R", "robot", scheduler="priority")
EDGE = Node("E", "edge")
UP = Link("R", "E", Constant(1))
DOWN = Link("E", "R", Constant(1))
RESTART = (NodeChange(0, "E", 0, True), NodeChange(2 * MS, "E", 0, False))
OUTAGE = (
    LinkSegment(0, "R->E", False, 0, 1000, ()),
    LinkSegment(int(2.5 * MS), "R->E", True, 0, 1000, ()),
)

BY_HAND = {
    "no flows": by_hand([FIFO], [task("A", 1)]),
    "hand-overs to two tasks, declared against the order of the tasks": by_hand(
        [FIFO],
        [task("A", 1), task("B", 2), task("C", 4)],
        [Flow("A", "C"), Flow("A", "B")],
    ),
    "hand-overs to two tasks on an accelerator": by_hand(
        [Node("R", "robot", accelerators={"gpu": 1})],
        [task("A", 1), task("B", 2, accelerator="gpu"), task("C", 4, accelerator="gpu")],
        [Flow("A", "C"), Flow("A", "B")],
    ),
    "a waiting job of the same task is ready before a hand-over": by_hand(
        [FIFO],
        [task("A", 10), task("B", 1)],
        [Flow("A", "B")],
        period_ms=5,
        windows=8,
    ),
    "two sources released at once, the second of higher priority": by_hand(
        [PRIORITY], [task("A", 3), task("B", 2, priority=1)]
    ),
    "a hand-over of higher priority than the next job of the same task": by_hand(
        [PRIORITY],
        [task("A", 10), task("B", 3, priority=1)],
        [Flow("A", "B")],
        period_ms=5,
        windows=8,
    ),
    "preempted at the instant at which it has its execution time": by_hand(
        [Node("R", "robot", cores=2, scheduler="priority")],
        [task("A", 4, priority=1), task("B", 4), task("C", 5, threads=2, priority=2)],
        [Flow("A", "C")],
    ),
    "a delayed source and a message at once": by_hand(
        [FIFO, Node("E", "edge")],
        [task("A", 7, "E"), task("B", 3, offset_ms=8), task("C", 4)],
        [Flow("A", "C")],
        links=[DOWN],
    ),
    "a message and a delayed source at once": by_hand(
        [FIFO, Node("E", "edge")],
        [task("A", 7, "E"), task("B", 3), task("C", 4, offset_ms=8)],
        [Flow("A", "B")],
        links=[DOWN],
    ),
    "a source starts at the instant at which a restarted worker is ready": by_hand(
        [FIFO, EDGE],
        [task("A", 3, "E", offset_ms=3, start_ms=11)],
        period_ms=10,
        windows=4,
        changes=RESTART,
    ),
    "a message arrives at the instant at which a restarted worker is ready": by_hand(
        [FIFO, EDGE],
        [task("A", 2), task("B", 3, "E", start_ms=11)],
        [Flow("A", "B")],
        links=[UP],
        period_ms=10,
        windows=4,
        changes=RESTART,
    ),
    "a message waits for its transmission when the link goes down": by_hand(
        [Node("R", "robot", cores=2), EDGE],
        [task("A", 1), task("B", 1), task("C", 1, "E"), task("D", 1, "E")],
        [Flow("A", "C", 250_000), Flow("B", "D", 250_000)],
        links=[replace(UP, rate_mbps=1000)],
        segments=OUTAGE,
    ),
    "a message would begin its transmission after the run": by_hand(
        [FIFO, EDGE],
        [task("A", 1), task("B", 1, "E")],
        [Flow("A", "B", 250_000)],
        links=[replace(UP, rate_mbps=100)],
        segments=[
            LinkSegment(0, "R->E", False, 0, 100, ()),
            LinkSegment(15 * MS, "R->E", True, 0, 100, ()),
        ],
        period_ms=10,
        windows=2,
    ),
    "a loss on a link after another loss": by_hand(
        [FIFO, EDGE, Node("F", "cloud")],
        [task("A", 1), task("B", 1, "E"), task("C", 1, "F"), task("D", 1, "F")],
        [Flow("A", "C", 250_000), Flow("A", "D", 250_000), Flow("A", "B")],
        links=[replace(UP, target="F", rate_mbps=1000), UP],
        segments=[
            LinkSegment(0, "R->F", False, 0, 1000, ()),
            LinkSegment(int(2.5 * MS), "R->F", True, 0, 1000, ()),
        ],
        changes=[NodeChange(0, "E", 0, True)],
    ),
    "an offset of a whole number": by_hand(
        [FIFO, EDGE],
        [task("A", 2, offset_ms=3), task("B", 3, "E", offset_ms=0)],
        [Flow("A", "B")],
        links=[UP],
    ),
    "the controller's node is down": by_hand(
        [EDGE, FIFO],
        [task("A", 1, "R"), task("B", 2, "E")],
        period_ms=10,
        windows=4,
        changes=[NodeChange(15 * MS, "E", 0, True), NodeChange(25 * MS, "E", 0, False)],
    ),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_equal_on_cases_made_by_hand(name: str) -> None:
    assert examine(BY_HAND[name], 0) == []


def kernel_uniform(key: np.uint64, cycle: int, attempt: int) -> float:
    return streams.attempt_uniform(key, cycle, attempt)


def test_attempts_draw_the_same_numbers() -> None:
    # The kernels' function can be called from compiled code only.
    compiled = cast(Callable[[np.uint64, int, int], float], numba.njit(kernel_uniform))
    rng = Random(1)
    for _ in range(200):
        key, cycle, attempt = rng.getrandbits(64), rng.getrandbits(20), rng.getrandbits(6)
        with np.errstate(over="ignore"):
            found = compiled(np.uint64(key), cycle, attempt)
        assert found == attempt_uniform(key, cycle, attempt)
