"""Foreign threads: by what of a node is busy, and by how long jobs take that run beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pytest

import dwell
from dwell.control import Controller
from dwell.estimators import Corrected, Evidence
from dwell.estimators.foreign_threads import (
    WINDOWS,
    ForeignThreads,
    Level,
    Stretches,
)
from dwell.estimators.measured import Part, Site
from dwell.model import (
    Bursts,
    Constant,
    ControllerSettings,
    Execution,
    Exponential,
    Flow,
    Link,
    LogNormal,
    Node,
    NodeDisturbance,
    Problem,
    Task,
)
from dwell.model.fabric import Scheduler
from dwell.model.qos import QoS
from dwell.sim.engine import PlayedCell, play_cells
from tests.cells.generated import make_problem
from tests.estimators.windows import Row, window
from tests.reference.test_against import Probe
from tests.reference.window_jobs import JOBS

SCHEDULERS: tuple[Scheduler, ...] = ("fair", "fifo", "priority")
FOUR = Node("E", "edge", 4)
#: A quarter of the time two threads.
BURSTS = Bursts(Exponential(1500.0), Exponential(500.0), threads=2)


# ------------------------------------------------------------------------------- by what is busy


def see(
    foreign: ForeignThreads,
    share: float,
    level: Level | None = None,
    *,
    usual: float = 0.0,
    is_full: bool = False,
) -> bool:
    return foreign.see(share, usual, 0.01, lambda: level, is_full=is_full)


def test_the_load_says_how_many_there_are_where_something_is_left() -> None:
    foreign = ForeignThreads(FOUR)
    assert repr(foreign) == "<ForeignThreads of E: +0 beyond the declared>"
    assert not see(foreign, 0.02)
    assert (foreign.beyond, foreign.threads) == (0.0, 0.0)
    assert see(foreign, 0.5)
    assert (foreign.beyond, foreign.threads) == (2.0, 2.0)
    assert not see(foreign, 0.5)
    assert see(foreign, 0.25)
    assert foreign.beyond == 1.0
    assert see(foreign, 0.02)
    assert (foreign.beyond, foreign.threads) == (0.0, 0.0)
    assert not see(foreign, 0.0)


def test_the_load_beside_what_is_declared() -> None:
    foreign = ForeignThreads(replace(FOUR, background=1.0))
    assert not see(foreign, 0.25, usual=0.25)
    assert see(foreign, 0.75, usual=0.25)
    assert foreign.beyond == 2.0


def test_jobs_say_more_than_the_load_where_they_are_slowed() -> None:
    foreign = ForeignThreads(FOUR)
    assert see(foreign, 0.5, Level(6.0, 0.1, is_slowed=False))
    assert foreign.beyond == 2.0
    assert see(foreign, 0.5, Level(6.0, 0.1, is_slowed=True))
    assert foreign.beyond == 6.0


def test_of_a_full_node_jobs_say_how_many_there_are() -> None:
    foreign = ForeignThreads(FOUR)
    assert see(foreign, 0.9, Level(9.0, 0.1, is_slowed=True), is_full=True)
    assert foreign.beyond == 9.0
    assert see(foreign, 0.9, Level(0.0, 0.1, is_slowed=False), is_full=True)
    assert foreign.beyond == 0.0


def test_of_a_full_node_without_jobs_a_thread_for_each_core_is_the_least() -> None:
    foreign = ForeignThreads(FOUR)
    assert see(foreign, 1.0, is_full=True)
    assert foreign.beyond == 4.0
    assert not see(foreign, 1.0, is_full=True)
    # What was known before may be more.
    assert see(foreign, 0.9, Level(9.0, 0.1, is_slowed=True), is_full=True)
    assert not see(foreign, 1.0, is_full=True)
    assert foreign.beyond == 9.0


def test_bursts_are_declared() -> None:
    foreign = ForeignThreads(replace(FOUR, bursts=BURSTS))
    assert (foreign.beyond, foreign.threads) == (0.0, 0.5)
    assert not see(foreign, 0.125, usual=0.125)
    assert see(foreign, 0.625, usual=0.125)
    assert (foreign.beyond, foreign.threads) == (2.0, 2.5)
    # They have ceased.
    assert see(foreign, 0.0, usual=0.125)
    assert (foreign.beyond, foreign.threads) == (-0.5, 0.0)


def test_windows_that_differ_by_chance_are_averaged() -> None:
    foreign = ForeignThreads(FOUR)
    assert see(foreign, 0.50)
    assert not see(foreign, 0.51)
    assert not see(foreign, 0.49)
    assert foreign.beyond == 2.0


def test_what_drifts_is_followed_in_steps() -> None:
    foreign = ForeignThreads(FOUR)
    shares = [0.3 + 0.02 * window for window in range(21)]
    changes = [see(foreign, share) for share in shares]
    assert 4 <= changes.count(True) < 15
    for _ in range(WINDOWS + 1):
        see(foreign, shares[-1])
    assert foreign.beyond == pytest.approx(4 * shares[-1], abs=0.2)


# ------------------------------------------------------------------------------ by what jobs took


def chain(
    node: Node = FOUR, threads: int = 1, stress: int = 0, at_s: float = 0.0, mean_ms: float = 10.0
) -> Problem:
    """A, B and C: B on E under OFF, all else on R; windows of 100 periods of 100 ms."""
    job = Execution(LogNormal(mean_ms, 0.2), threads=threads)
    robot = Node("R", "robot", 2)
    return make_problem(
        [robot, node],
        [
            Task("A", {"R": job}),
            Task("B", {"R": job, "E": job}),
            Task("C", {"R": job, "E": job}),
            Task("D", {"R": job}),
        ],
        [Flow("A", "B"), Flow("B", "C"), Flow("C", "D")],
        links=[Link("R", "E", Constant(1.0)), Link("E", "R", Constant(1.0))],
        candidates={"LOC": {}, "OFF": {"B": "E"}, "FAR": {"B": "E", "C": "E"}},
        scenario=[NodeDisturbance("E", at_s, stress_threads=stress)] if stress else [],
        window_cycles=100,
    )


def windows(
    problem: Problem, policy: str = "FAR", count: int = 2, shadow_fraction: float = 0.0
) -> list[Evidence]:
    """What the windows of a run show."""
    probe = Probe(shadow_fraction)
    dwell.simulate(
        problem, scenario="disturbed", policy=policy, estimator=probe, seed=3, windows=count
    )
    assert len(probe.evidence) == count
    return probe.evidence


def level(problem: Problem, evidence: Evidence) -> Level:
    found = Stretches(problem).level(evidence, "E")
    assert found is not None
    return found


@pytest.mark.parametrize("threads", [1, 3, 6])
@pytest.mark.parametrize("stress", [0, 1, 2, 5, 9])
@pytest.mark.parametrize("scheduler", SCHEDULERS)
@pytest.mark.parametrize("cores", [1, 4])
def test_jobs_say_beside_how_many_threads_they_ran(
    cores: int, scheduler: Scheduler, stress: int, threads: int
) -> None:
    problem = chain(Node("E", "edge", cores, scheduler), threads, stress, mean_ms=2.0)
    for evidence in windows(problem):
        found = level(problem, evidence)
        if scheduler == "fair" and threads + stress <= cores:
            # They are in nobody's way: there are no more than what is left.
            assert (found.threads, found.is_slowed) == (cores - threads, False)
        else:
            assert found.threads == pytest.approx(stress, rel=0.02)
            assert found.is_slowed == (stress > 0 or (scheduler == "fair" and threads > cores))


@pytest.mark.parametrize("background", [0.25, 0.5])
@pytest.mark.parametrize("scheduler", SCHEDULERS)
def test_the_background_is_no_thread(scheduler: Scheduler, background: float) -> None:
    node = Node("E", "edge", 1, scheduler, background=background)
    for stress in (0, 3):
        problem = chain(node, stress=stress, mean_ms=5.0)
        assert level(problem, windows(problem)[0]).threads == pytest.approx(stress, abs=1e-6)


@pytest.mark.parametrize("stress", [0, 1, 4])
def test_bursts_are_not_counted(stress: int) -> None:
    problem = chain(Node("E", "edge", 1, bursts=BURSTS), stress=stress, mean_ms=5.0)
    for evidence in windows(problem, count=5):
        assert level(problem, evidence).threads == pytest.approx(stress)


@pytest.mark.parametrize("at_s", [2.5, 5.0, 7.5])
@pytest.mark.parametrize("scheduler", SCHEDULERS)
def test_since_a_change_within_the_window(scheduler: Scheduler, at_s: float) -> None:
    problem = chain(Node("E", "edge", 1, scheduler), stress=3, at_s=at_s)
    assert level(problem, windows(problem)[0]).threads == pytest.approx(3.0)


@pytest.mark.parametrize("policy", ["LOC", "OFF"])
@pytest.mark.parametrize("stress", [0, 1, 4])
def test_shadow_jobs_say_it_where_no_own_job_does(policy: str, stress: int) -> None:
    node = Node("E", "edge", 1)
    problem = chain(node, stress=stress)
    evidence = windows(problem, "LOC", shadow_fraction=0.25)[1]
    assert level(problem, evidence).threads == pytest.approx(stress, rel=0.05)
    # Where they stand behind foreign threads they say nothing.
    behind = replace(evidence, shadows_share=False)
    assert Stretches(problem).level(behind, "E") is None
    alone = evidence.with_instants(evidence.cycles, None)
    assert Stretches(problem).level(alone, "E") is None


def row(start_ms: float, took_ms: float) -> Row:
    """A cycle under FAR whose jobs on E take so long, one after another."""
    ends = [start_ms, start_ms + took_ms, start_ms + 2 * took_ms, start_ms + 2 * took_ms]
    return [start_ms, *ends[:3]], ends, ends[:3]


def by_hand(took_ms: Sequence[float]) -> Evidence:
    """Cycles whose jobs on E had 10 ms of core time."""
    rows = [row(100.0 * i, ms) for i, ms in enumerate(took_ms)]
    evidence = window(rows, close_ms=10_000.0, placement=[2] * len(rows))
    cycles = evidence.cycles
    work_ns = cycles.end_ns * 0 + 10_000_000
    cycles = replace(cycles, start_ns=cycles.ready_ns, work_ns=work_ns)
    return evidence.with_instants(cycles, evidence.shadows)


def test_by_hand() -> None:
    problem = chain(Node("E", "edge", 1))
    assert level(problem, by_hand([10.0] * 9)) == Level(0.0, 0.0, is_slowed=False)
    assert level(problem, by_hand([40.0] * 9)) == Level(3.0, 0.0, is_slowed=True)
    # Few of them are not slowed: bursts, or what came and went.
    assert level(problem, by_hand([10.0] + [40.0] * 12)).threads == 3.0
    mixed = level(problem, by_hand([20.0, 30.0, 40.0, 50.0, 60.0]))
    assert (mixed.threads, mixed.is_slowed) == (3.0, True)
    assert mixed.error > 0.0


def test_few_jobs_say_nothing_nor_what_is_not_known_of_them() -> None:
    problem = chain(Node("E", "edge", 1))
    assert Stretches(problem).level(by_hand([10.0] * (JOBS // 2)), "E") is None
    known = by_hand([10.0] * 9)
    cycles = known.cycles
    for unknown in (replace(cycles, start_ns=None), replace(cycles, work_ns=None)):
        assert Stretches(problem).level(known.with_instants(unknown, None), "E") is None


class Remembering(Corrected):
    """`Corrected` that remembers the foreign threads of E at each decision."""

    def __deepcopy__(self, memo: object) -> Remembering:
        return self

    def start(self, problem: Problem) -> None:
        """Forget all of them."""
        super().start(problem)
        self.beyond: list[float] = []
        self.demands_ms: dict[Part, float] = {}

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate, and remember."""
        estimates = super().estimate(observed=observed, incumbent=incumbent, own=own)
        self.beyond.append(self.present.threads.get("E", 0.0))
        self.demands_ms = {part: float(ms.mean()) for part, ms in self.present.demands.items()}
        return estimates


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("stress", [0, 1, 4])
def test_a_backlog_of_earlier_cycles_is_no_foreign_thread(stress: int, every: int) -> None:
    """A task needs 110 of 100 ms on the core of E. Windows soon have none of its jobs."""
    slow = Task("B", {"E": Execution(Constant(110.0 * every))}, every=every)
    clock = Task("C", {"E": Execution(Constant(1.0))})
    problem = make_problem(
        [Node("E", "edge", 1)],
        [slow, clock],
        scenario=[NodeDisturbance("E", 0.0, stress_threads=stress)] if stress else [],
        window_cycles=20,
    )
    estimator = Remembering(problem)
    dwell.simulate(
        problem, scenario="disturbed", policy="LOC", estimator=estimator, seed=1, windows=30
    )
    assert estimator.beyond[-5:] == pytest.approx([stress] * 5, abs=0.1)
    waits_ms = estimator.demands_ms.get(Site("C", "E"), 1.0)
    assert waits_ms == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("stress", [6, 16])
def test_a_full_node_with_few_jobs_in_each_decision(stress: int) -> None:
    """A tenth of the cycles has a shadow through OFF: a job in ten, and five in a decision."""
    problem = chain(stress=stress)
    settings = ControllerSettings(decide_cycles=5)
    problem = replace(problem, controller=settings)
    estimator = Remembering(problem, shadow_fraction=0.1)
    dwell.simulate(
        problem, scenario="disturbed", policy="LOC", estimator=estimator, seed=1, windows=5
    )
    assert estimator.beyond[-5:] == pytest.approx([stress] * 5, rel=0.05)


# ------------------------------------------------------------------- next to jobs of other cells


def of_a_fleet(problem: Problem, policies: Sequence[str], shadow_fraction: float) -> list[Evidence]:
    """What a window of the first of several equal cells shows that are released together."""
    real = dwell.draw(problem, scenario="disturbed", seed=3, windows=2)
    probes = [Probe(shadow_fraction) for _ in policies]
    cells = [
        PlayedCell(problem, real, Controller(problem, policy, probe), guarded=False)
        for policy, probe in zip(policies, probes, strict=True)
    ]
    assert play_cells(lambda: cells, shared=("E",), by_window=True)
    return probes[0].evidence


@pytest.mark.parametrize("stress", [1, 4, 16])
@pytest.mark.parametrize("others", [1, 3])
def test_jobs_of_other_cells_are_no_foreign_threads(others: int, stress: int) -> None:
    problem = chain(Node("E", "edge", 1), stress=stress, mean_ms=3.0)
    evidence = of_a_fleet(problem, ["OFF"] * (1 + others), 0.0)[1]
    found = Stretches(problem, {"E"}).level(evidence, "E")
    assert found is not None
    assert found.threads == pytest.approx(stress, rel=0.06)
    # An estimator that does not know of the others takes their threads for foreign.
    assert level(problem, evidence).threads > stress + others / 2


@pytest.mark.parametrize("stress", [4, 16])
@pytest.mark.parametrize("others", [1, 3])
def test_shadow_jobs_next_to_those_of_other_cells(others: int, stress: int) -> None:
    problem = chain(Node("E", "edge", 1), stress=stress, mean_ms=3.0)
    evidence = of_a_fleet(problem, ["LOC"] + ["OFF"] * others, 0.25)[1]
    found = Stretches(problem, {"E"}).level(evidence, "E")
    assert found is not None
    assert found.threads == pytest.approx(stress, rel=0.1)


@pytest.mark.parametrize("scheduler", ["fifo", "priority"])
def test_jobs_on_a_shared_node_that_is_not_fair_say_nothing(scheduler: Scheduler) -> None:
    problem = chain(Node("E", "edge", 1, scheduler), stress=3, mean_ms=3.0)
    evidence = of_a_fleet(problem, ["OFF", "OFF"], 0.0)[1]
    assert Stretches(problem, {"E"}).level(evidence, "E") is None


def test_jobs_on_a_shared_node_say_nothing_where_the_others_are_not_known() -> None:
    problem = chain(Node("E", "edge", 1), stress=3)
    assert Stretches(problem, {"E"}).level(by_hand([40.0] * 9), "E") is None
