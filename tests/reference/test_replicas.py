"""Replicas on cases worked out by hand, in milliseconds, in the reference and in the kernel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import pytest

import dwell
from dwell.kernels.realisation import NodeChange
from dwell.model import Constant, Execution, Flow, Link, Node, Problem, Replicas, Task
from tests.cells.generated import MS, make_problem, make_realisation
from tests.reference.replicas import second
from tests.reference.simulator import simulate

NODES = [Node(name, "edge", cores=8) for name in "REF"]
WAYS = ("R", "E", 2), ("E", "R", 2), ("R", "F", 3), ("F", "R", 3)
LINKS = [Link(a, b, Constant(ms)) for a, b, ms in WAYS]


def cell(work_ms: Mapping[str, float], after_ms: float) -> Problem:
    """Make a camera and an actuator on R, and between them work on E and on F."""
    tasks = [
        Task("camera", {"R": Execution(Constant(1))}),
        Task("work", {node: Execution(Constant(ms)) for node, ms in work_ms.items()}),
        Task("act", {"R": Execution(Constant(1))}),
    ]
    problem = make_problem(
        NODES,
        tasks,
        [Flow("camera", "work"), Flow("work", "act")],
        links=LINKS,
        candidates={"ONE": {"work": "E"}, "TWO": {"work": "F"}},
        period_ms=20,
        window_cycles=5,
    )
    members = {name: problem.candidates[name] for name in ("ONE", "TWO")}
    both = Replicas(members, after_ms)
    return replace(problem, candidates={**members, "BOTH": both})


@dataclass
class Seen:
    """Latencies, ms, outcomes and late messages of cycles; start and end of jobs of `work`, ms."""

    latency: list[float | None]
    outcomes: list[str]
    late: int
    work: dict[tuple[int, str], tuple[float | None, float | None]]


def by_kernel(problem: Problem, changes: Sequence[NodeChange]) -> Seen:
    real = make_realisation(problem, windows=1, node_changes=changes)
    run = dwell.simulate_realisation(problem, real, policy="BOTH", estimator="profile", jobs=True)
    assert run.jobs is not None
    jobs = run.jobs.filter(run.jobs["task"] == "work").iter_rows(named=True)
    return Seen(
        [_ms(ns) for ns in run.cycles["latency_ns"]],
        run.cycles["outcome"].to_list(),
        int(run.windows["late_copies"].sum()),
        {(job["cycle"], job["node"]): (_ms(job["start_ns"]), _ms(job["end_ns"])) for job in jobs},
    )


def by_reference(problem: Problem, changes: Sequence[NodeChange]) -> Seen:
    real = make_realisation(problem, windows=1, node_changes=changes)
    result = simulate(problem, real, ["BOTH"] * real.cycles)
    jobs = [(*key, job) for key, job in result.jobs.items() if key[1] in ("work", second("work"))]
    return Seen(
        [_ms(cycle.latency_ns) for cycle in result.cycles],
        [cycle.outcome for cycle in result.cycles],
        sum(result.late.values()),
        {(cycle, job.node): (_ms(job.start_ns), _ms(job.end_ns)) for cycle, _, job in jobs},
    )


def _ms(ns: int | None) -> float | None:
    return None if ns is None else ns / MS


@pytest.fixture(params=[by_kernel, by_reference], ids=["kernel", "reference"])
def seen(request: pytest.FixtureRequest) -> Callable[..., Seen]:
    """Play cycles under BOTH."""

    def play(work_ms: Mapping[str, float], after_ms: float = 0.0, *changes: NodeChange) -> Seen:
        found: Seen = request.param(cell(work_ms, after_ms), changes)
        return found

    return play


def test_the_first_message_counts_and_the_other_is_late(seen: Callable[..., Seen]) -> None:
    one = seen({"E": 5, "F": 5})
    # Over E: 1 + 2 + 5 + 2 + 1. The message over F arrives at 12.
    assert one.latency == [11.0] * 5
    assert one.late == 5
    assert one.work[0, "E"] == (3.0, 8.0)
    assert one.work[0, "F"] == (4.0, 9.0)


def test_a_job_that_runs_when_its_node_hears_sends_nothing(seen: Callable[..., Seen]) -> None:
    one = seen({"E": 14, "F": 5})
    assert one.latency == [13.0] * 5  # over F
    assert one.work[0, "E"] == (3.0, 17.0)  # E hears at 15
    assert one.late == 0


def test_a_message_is_held_and_sent_unless_the_cycle_is_done(seen: Callable[..., Seen]) -> None:
    assert seen({"E": 5, "F": 5}, 10).work[0, "F"] == (13.0, 18.0)
    # R hears at 11, before the hold ends.
    assert (0, "F") not in seen({"E": 5, "F": 5}, 11.5).work
    assert (0, "F") not in seen({"E": 5, "F": 5}, 11).work
    assert seen({"E": 30, "F": 5}, 10).latency[0] == 22.0  # 10 + 3 + 5 + 3 + 1


def test_a_job_that_waits_is_cancelled(seen: Callable[..., Seen]) -> None:
    one = seen({"E": 5, "F": 40})
    assert one.latency == [11.0] * 5
    assert one.work[0, "F"] == (4.0, 44.0)
    # Cycle 1 waits from 24 on; F hears at 34. Cycle 2 arrives as the worker is free.
    assert one.work[1, "F"] == (None, None)
    assert one.work[2, "F"] == (44.0, 84.0)


def test_one_copy_is_enough(seen: Callable[..., Seen]) -> None:
    down = NodeChange(5 * MS, "E", 0, True)
    one = seen({"E": 5, "F": 5}, 0, down)
    assert one.outcomes == ["done"] * 5
    assert one.latency == [13.0] * 5
    both = seen({"E": 5, "F": 5}, 0, down, NodeChange(6 * MS, "F", 0, True))
    assert both.outcomes == ["node_down"] * 5


def test_a_node_loses_what_it_holds(seen: Callable[..., Seen]) -> None:
    down, up = NodeChange(5 * MS, "R", 0, True), NodeChange(6 * MS, "R", 0, False)
    one = seen({"E": 15, "F": 1}, 10, down, up)
    assert (0, "F") not in one.work
    assert one.latency[0] == 21.0  # over E
    assert one.latency[1] == 18.0  # held until 10: 10 + 3 + 1 + 3 + 1
