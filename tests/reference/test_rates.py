"""Several rates in the reference simulator, on cases worked out by hand, in milliseconds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import pytest

from dwell.kernels.realisation import NodeChange, Realisation
from dwell.model import Constant, Execution, Flow, Link, Node, Problem, Task
from tests.cells.generated import MS, make_problem, make_realisation
from tests.reference.chains import actuations
from tests.reference.simulator import Result, simulate

R, E = Node("R", "robot", cores=8), Node("E", "edge", cores=8)
BOTH = (Link("R", "E", Constant(2)), Link("E", "R", Constant(3)))


def task(name: str, ms: float, *nodes: str, workers: int = 1, **more: object) -> Task:
    on = {node: Execution(Constant(ms), workers=workers) for node in nodes or ("R",)}
    return Task(name, on, **more)  # type: ignore[arg-type]


def sampled(source: str, target: str, payload_bytes: int = 0) -> Flow:
    return Flow(source, target, payload_bytes, sampled=True)


class Played:
    """A cell without jitter, played by the reference."""

    def __init__(
        self,
        tasks: Sequence[Task],
        flows: Sequence[Flow] = (),
        *,
        period_ms: float,
        cycles: int,
        candidates: Mapping[str, Mapping[str, str]] | None = None,
        stamps: Sequence[str] = (),
        changes: Sequence[NodeChange] = (),
        exec_ms: dict[tuple[str, str], Sequence[float]] | None = None,
        delay_ms: dict[tuple[str, str, str], Sequence[float]] | None = None,
    ) -> None:
        self.problem: Problem = make_problem(
            [R, E],
            tasks,
            flows,
            links=BOTH,
            period_ms=period_ms,
            window_cycles=cycles,
            candidates=candidates,
        )
        self.real: Realisation = make_realisation(
            self.problem, windows=1, exec_ms=exec_ms, delay_ms=delay_ms, node_changes=changes
        )
        named = stamps or [self.problem.initial] * cycles
        self.result: Result = simulate(self.problem, self.real, named)

    @property
    def outcomes(self) -> list[str]:
        return [cycle.outcome for cycle in self.result.cycles]

    @property
    def latencies(self) -> list[float | None]:
        return [
            None if cycle.latency_ns is None else cycle.latency_ns / MS
            for cycle in self.result.cycles
        ]

    def runs(self, name: str) -> list[int]:
        return sorted(cycle for cycle, task in self.result.jobs if task == name)

    def taken(self, target: str, source: str) -> dict[int, int]:
        """Return the cycle of the value that each job of a task got from a source."""
        return {
            cycle: job.taken[source]
            for (cycle, task), job in sorted(self.result.jobs.items())
            if task == target and source in job.taken
        }

    def ages(self, start: str, end: str) -> list[float]:
        found = actuations(self.problem, self.result, self.real.release_ns.tolist(), start, end)
        return [one.age_ns / MS for one in found]


def mean_age(latencies: Sequence[float | None], period_ms: float, first: int, count: int) -> float:
    """Mean over time of the age of the newest completed cycle, from one completion on."""
    ends = [(k * period_ms + ms, ms) for k, ms in enumerate(latencies) if ms is not None]
    ends = ends[first : first + count + 1]
    area = sum(
        (ms + (later - at) / 2) * (later - at) for (at, ms), (later, _) in itertools.pairwise(ends)
    )
    return area / (ends[-1][0] - ends[0][0])


# ------------------------------------------------------------------------- jobs beyond a period


@pytest.mark.parametrize(
    ("ms", "period_ms", "workers", "latencies", "share", "age"),
    [
        (86, 20, 5, [86], 1, 96),
        (86, 20, 1, range(88, 107, 2), 10 / 43, 140.0),
        (200, 40, 1, [240], 1 / 5, 340),
        (200, 40, 5, [200], 1, 220),
        (120, 100, 1, range(140, 221, 20), 5 / 6, 240),
    ],
)
def test_a_stage_of_several_periods(
    ms: float,
    period_ms: float,
    workers: int,
    latencies: Sequence[float],
    share: float,
    age: float,
) -> None:
    cell = Played([task("detect", ms, workers=workers, depth=1)], period_ms=period_ms, cycles=300)
    done = [one for one in cell.latencies if one is not None][1:]
    length = len(latencies)
    assert sorted(done[:length]) == list(latencies)
    assert len(done) / 300 == pytest.approx(share, abs=0.03)
    assert mean_age(cell.latencies, period_ms, 1, 3 * length) == pytest.approx(age)


# ---------------------------------------------------------------------------------------- rates


def test_a_task_runs_in_every_nth_cycle_and_the_rest_of_its_branch_too() -> None:
    tasks = [task("camera", 1, every=3), task("detect", 2), task("imu", 1), task("control", 1)]
    flows = [Flow("camera", "detect"), Flow("imu", "control"), sampled("detect", "control")]
    cell = Played(tasks, flows, period_ms=10, cycles=7)
    assert cell.runs("camera") == cell.runs("detect") == [0, 3, 6]
    assert cell.runs("control") == list(range(7))
    # No latency has detect, which control does not wait for.
    assert cell.latencies == [2] * 7


def test_cycles_without_a_sink_are_idle() -> None:
    tasks = [task("camera", 1), task("detect", 2, every=3), task("log", 1, every=2)]
    cell = Played(tasks, [sampled("camera", "detect")], period_ms=10, cycles=6)
    assert cell.outcomes == ["done", "idle", "done", "done", "done", "idle"]
    assert cell.latencies == [2, None, 1, 2, 1, None]


def test_a_slow_join_gets_no_messages_of_the_cycles_between() -> None:
    tasks = [task("imu", 1), task("gps", 5, every=2), task("fuse", 1, "E", every=2)]
    cell = Played(tasks, [Flow("imu", "fuse"), Flow("gps", "fuse")], period_ms=10, cycles=4)
    assert cell.runs("imu") == [0, 1, 2, 3]
    assert cell.runs("fuse") == [0, 2]
    assert {key[1:] for key in cell.result.arrived} == {
        (cycle, source, "fuse") for cycle in (0, 2) for source in ("imu", "gps")
    }
    assert cell.latencies == [8, None, 8, None]


# -------------------------------------------------------------------------------- sampled flows


def test_ages_of_a_fast_control_behind_a_slow_producer() -> None:
    tasks = [task("policy", 10, every=500), task("control", 0, every=1)]
    cell = Played(tasks, [sampled("policy", "control")], period_ms=1, cycles=2000)
    assert cell.latencies == [0] * 2000
    # The value that completes at 510 counts for the cycle of 510: completions precede releases.
    ages = cell.ages("policy", "control")[510:1510]
    assert (min(ages), max(ages)) == (10, 509)
    assert sum(ages) / len(ages) == 259.5


def test_a_value_that_arrives_with_a_release_counts() -> None:
    # camera's message leaves at 1 and is at E at 3, or at 10 with the release of cycle 1.
    tasks = [task("camera", 1), task("control", 1, "E", every=1)]
    cell = Played(
        tasks,
        [sampled("camera", "control")],
        period_ms=10,
        cycles=4,
        delay_ms={("camera", "control", "R->E"): [9, 2, 2, 2]},
    )
    assert cell.taken("control", "camera") == {1: 0, 2: 1, 3: 2}


def test_an_overtaken_message_is_dropped() -> None:
    tasks = [task("camera", 1), task("control", 1, "E", every=1)]
    cell = Played(
        tasks,
        [sampled("camera", "control")],
        period_ms=10,
        cycles=5,
        delay_ms={("camera", "control", "R->E"): [2, 22, 2, 2, 2]},
    )
    # Cycle 1's message is there at 33, after those of cycles 2 and 3... which it does not replace.
    assert cell.taken("control", "camera") == {1: 0, 2: 0, 3: 2, 4: 3}


def test_a_waiting_job_gets_the_value_of_the_instant_at_which_it_is_taken() -> None:
    tasks = [task("camera", 1), task("control", 15, every=1)]
    cell = Played(tasks, [sampled("camera", "control")], period_ms=10, cycles=5)
    # Jobs start at 0, 15, 30, 45, and cameras complete at 1, 11, 21, 31, 41.
    assert cell.taken("control", "camera") == {1: 1, 2: 2, 3: 4}


def test_the_loss_of_a_value_loses_no_cycle_and_a_node_that_goes_down_forgets_it() -> None:
    tasks = [task("camera", 1, every=3), task("imu", 1), task("control", 1, "E")]
    flows = [sampled("camera", "control"), Flow("imu", "control")]
    down = [NodeChange(12 * MS, "E", 0, True), NodeChange(18 * MS, "E", 0, False)]
    cell = Played(tasks, flows, period_ms=10, cycles=5, changes=down)
    # imu's message of cycle 1 meets E down at 13; the value of cycle 0 is gone in cycle 2.
    assert cell.outcomes == ["done", "node_down", "done", "done", "done"]
    assert cell.taken("control", "camera") == {0: 0, 3: 3, 4: 3}


def test_a_lost_camera_loses_no_cycle() -> None:
    tasks = [task("camera", 1, "E"), task("control", 1, every=1)]
    down = [NodeChange(5 * MS, "E", 0, True)]
    cell = Played(tasks, [sampled("camera", "control")], period_ms=10, cycles=3, changes=down)
    assert cell.outcomes == ["done"] * 3
    assert cell.result.jobs[1, "camera"].outcome == "node_down"
