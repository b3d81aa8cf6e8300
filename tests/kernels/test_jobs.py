"""Waits and foreign threads: the kernel finds what the plain functions find, to the bit."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest

import dwell
from dwell.estimators import Corrected, Evidence
from dwell.estimators.evidence import Instants
from dwell.estimators.foreign_threads import Level, Stretches
from dwell.estimators.measured import Meter, UsedCores
from dwell.model import Problem
from tests.cells.examples import EXAMPLES
from tests.cells.generated import Scheduler, random_problem
from tests.reference import window_jobs

EVERY: tuple[Scheduler, ...] = ("fair", "fifo", "priority", "turns")


def random_instants(
    rng: np.random.Generator, problem: Problem, count: int, busy: float
) -> Instants:
    """Jobs that begin at random, some at one instant, and take up to five times their work."""
    tasks, flows = len(problem.pipeline.tasks), len(problem.pipeline.flows)
    work = rng.integers(0, 30, (count, tasks)) * 1_000_003
    start = (np.arange(count)[:, None] * rng.integers(1, 30, (1, tasks)) * busy * 1e6).astype(int)
    start += rng.integers(0, 5, start.shape) * 1_000_000
    end = start + (work * rng.choice([1.0, 1.0, rng.uniform(1, 5)], work.shape)).astype(int)

    def known(values: np.ndarray) -> np.ndarray:
        return np.where(rng.random(values.shape) < 0.95, values, -1)

    arrived = np.full((count, flows), -1)
    return Instants(known(start), known(end), arrived, known(start), known(work))


def random_evidence(rng: np.random.Generator, problem: Problem) -> Evidence:
    count, names = int(rng.integers(1, 120)), len(problem.candidates)
    active = rng.integers(0, names, 2)
    placement = np.where(np.arange(count) < rng.integers(0, 2 * count), active[0], active[1])
    through = rng.integers(-1, names, count)
    has_shadows = rng.random() < 0.7
    return Evidence.of(
        close_ns=10**12,
        release_ns=np.arange(count) * 1_000_000,
        placement=placement,
        cycles=random_instants(rng, problem, count, rng.choice([0.0, 0.1, 1.0])),
        shadow_placement=through if has_shadows else np.full(count, -1),
        shadows=random_instants(rng, problem, count, 1.0) if has_shadows else None,
        shadows_share=bool(rng.random() < 0.8),
    )


def random_beside(rng: np.random.Generator, problem: Problem, evidence: Evidence) -> np.ndarray:
    parts = 1 if evidence.shadows is None else 2
    shape = len(evidence.release_ns), parts, len(problem.pipeline.tasks), 2
    return rng.integers(0, 200_000_000, shape)


@pytest.mark.parametrize("seed", range(60))
def test_random_windows_say_the_same_in_both(seed: int) -> None:
    rng, cell = np.random.default_rng(seed), Random(seed)
    problem = random_problem(cell, schedulers=EVERY)
    meter = Meter(problem)
    for _ in range(4):
        evidence = random_evidence(rng, problem)
        foreign = {name: float(rng.integers(0, 5)) / 2 for name in problem.fabric.nodes}
        full: dict[str, UsedCores] = {}
        for name in problem.fabric.nodes:
            own, others = (rng.uniform(0.0, 2.0, 2) * rng.integers(0, 2)).tolist()
            used = full[name] = own, others
            found = Stretches(problem).level(evidence, name, used)
            assert found == window_jobs.level(problem, evidence, name, used=used)
            beside = random_beside(rng, problem, evidence)
            evidence.rows.beside = beside
            found = Stretches(problem, {name}).level(evidence, name, used)
            assert found == window_jobs.level(problem, evidence, name, beside)
        np.testing.assert_array_equal(
            meter.waited_ns(evidence, foreign, full),
            window_jobs.work_with_waits(problem, evidence, (), foreign, full),
        )


class Compared(Corrected):
    """`Corrected` that compares what each window says by both; copies of it are itself."""

    def __deepcopy__(self, memo: object) -> Compared:
        return self

    def start(self, problem: Problem) -> None:
        """Begin again."""
        super().start(problem)
        self.meter, self.stretches = Meter(problem), Stretches(problem)
        self.levels: list[Level] = []

    def learn(self, evidence: Evidence) -> None:
        """Compare, then learn."""
        threads = self._threads
        for name in self.problem.fabric.nodes:
            level = self.stretches.level(evidence, name)
            assert level == window_jobs.level(self.problem, evidence, name)
            if level is not None:
                self.levels.append(level)
        np.testing.assert_array_equal(
            self.meter.waited_ns(evidence, threads),
            window_jobs.work_with_waits(self.problem, evidence, (), threads, {}),
        )
        super().learn(evidence)


@pytest.mark.parametrize("scenario", ["baseline", "robot-cpu-stress", "edge-cpu-stress"])
def test_runs_say_the_same_in_both(scenario: str) -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    compared = Compared(problem)
    dwell.simulate(problem, scenario=scenario, policy="dtp", estimator=compared, seed=2, windows=10)
    assert compared.levels


@pytest.mark.parametrize("seed", range(20))
def test_what_is_not_known_of_a_window(seed: int) -> None:
    rng, cell = np.random.default_rng(seed), Random(seed)
    evidence = random_evidence(rng, random_problem(cell, schedulers=EVERY))
    cycles, shadows, limit_ns = evidence.cycles, evidence.shadows, int(rng.integers(1, 10**9))
    lost = (cycles.end_ns < 0) & (cycles.ready_ns >= 0) & (cycles.ready_ns < limit_ns)
    assert cycles.work_ns is not None
    unknown = (cycles.end_ns >= 0) & (cycles.work_ns < 0)
    behind = np.zeros(0, np.bool_)
    if shadows is not None and shadows.work_ns is not None:
        behind = (shadows.end_ns >= 0) & (shadows.work_ns < 0)
    found = evidence.rows.unknown(limit_ns)
    assert found == (bool(lost.any()), bool(unknown.any()), bool(behind.any()))
    assert evidence.rows.candidates(limit_ns) == sorted(set(evidence.placement.tolist()))
