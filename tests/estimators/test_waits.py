"""Waits: what jobs wait for is told from what others on their node took."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.estimators import Corrected, Evidence
from dwell.estimators.measured import Meter, Site
from dwell.estimators.waits import alone_with_waits, beside
from dwell.model import Node, Problem
from tests.cells.random_dags import random_dag

MS = 1e6
CORE = Node("R", "robot", cores=1)
Jobs = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def jobs(start_ms: list[float], taken_ms: list[float], alone_ms: list[float]) -> Jobs:
    start = np.array(start_ms) * MS
    return start, start + np.array(taken_ms) * MS, np.array(alone_ms) * MS, 1.0


def test_the_mean_of_what_others_used_while_a_job_ran() -> None:
    others = np.array([0.0, 5.0]), np.array([10.0, 15.0]), np.array([1.0, 2.0])
    found = beside(np.array([0.0, 5.0, 8.0]), np.array([10.0, 15.0, 20.0]), others)
    # 10 of one and 5 of two; 5 of one and 10 of two; 2 of one and 7 of two, of 12.
    np.testing.assert_allclose(found, [2.0, 2.5, 16 / 12])


def test_a_job_that_takes_longer_than_its_core_time_has_waited() -> None:
    waits = jobs([0.0, 100.0, 200.0], [30.0, 25.0, 1.0], [5.0, 5.0, 1.0])
    found = alone_with_waits(CORE, 0.0, {3: waits})
    np.testing.assert_allclose(found[3], [30.0 * MS, 25.0 * MS, 1.0 * MS])


def test_what_few_jobs_do_is_no_wait() -> None:
    once = jobs([0.0, 100.0, 200.0], [30.0, 5.0, 5.0], [5.0, 5.0, 5.0])
    assert alone_with_waits(CORE, 0.0, {0: once}) == {}


def test_jobs_that_share_a_core_have_not_waited() -> None:
    """Two of 30 ms from the same instant on take 60 ms each."""
    both = {task: jobs([0.0, 70.0], [60.0, 60.0], [30.0, 30.0]) for task in (0, 1)}
    assert alone_with_waits(CORE, 0.0, both) == {}


def test_jobs_beside_foreign_threads_have_not_waited() -> None:
    slowed = {0: jobs([0.0, 70.0, 140.0], [30.0, 30.0, 30.0], [10.0, 10.0, 10.0])}
    assert alone_with_waits(CORE, 2.0, slowed) == {}
    assert 0 in alone_with_waits(CORE, 1.0, slowed)


class Witness(Corrected):
    """`Corrected` that looks whether any job has waited; copies of it are itself."""

    def __deepcopy__(self, memo: object) -> Witness:
        return self

    def start(self, problem: Problem) -> None:
        """Begin again."""
        super().start(problem)
        self.meter, self.windows = Meter(problem), 0

    def _take_in(self, demands: object, evidence: Evidence) -> None:
        super()._take_in(demands, evidence)  # type: ignore[arg-type]
        cycles, foreign = evidence.cycles, self._threads
        work_ns = self.meter.work_ns(cycles, evidence.placement, foreign)
        told = self.meter._with_waits(cycles, evidence.placement, work_ns, foreign)
        assert told is work_ns
        self.windows += 1


@pytest.mark.parametrize("seed", range(12))
def test_nothing_waits_in_the_simulator(seed: int) -> None:
    problem = random_dag(seed)
    witness = Witness(problem)
    dwell.simulate(problem, policy="dtp", estimator=witness, seed=seed, windows=8)
    assert witness.windows > 0


@pytest.mark.parametrize("scenario", ["robot-cpu-stress", "edge-cpu-stress"])
def test_nothing_waits_beside_foreign_threads_in_the_simulator(scenario: str) -> None:
    problem = dwell.load("examples/canonical.yaml")
    for policy in ("LOC", "SO"):
        witness = Witness(problem)
        run = dwell.simulate(
            problem, scenario=scenario, policy=policy, estimator=witness, seed=1, windows=8
        )
        assert witness.windows == len(run.windows) > 0


def test_a_device_that_a_job_waits_for_is_part_of_its_demand() -> None:
    problem = dwell.load("examples/canonical.yaml")
    kept: list[Evidence] = []

    class Keeper(Witness):
        def learn(self, evidence: Evidence) -> None:
            kept.append(evidence)
            super().learn(evidence)

    dwell.simulate(problem, policy="LOC", estimator=Keeper(problem), seed=1, windows=2)
    cycles = kept[0].cycles
    assert cycles.work_ns is not None
    meter, column = Meter(problem), list(problem.pipeline.tasks).index("planning")
    half_ns = cycles.work_ns.copy()
    half_ns[:, column] //= 2
    halved = replace(kept[0], cycles=replace(cycles, work_ns=half_ns))
    site = Site("planning", "R2")
    whole = meter.demands(kept[0])[site].copy()
    np.testing.assert_allclose(meter.demands(halved)[site], whole, rtol=1e-6)


def test_where_there_are_no_others_they_used_nothing() -> None:
    nothing = np.empty(0), np.empty(0), np.empty(0)
    assert beside(np.array([0.0, 5.0]), np.array([10.0, 15.0]), nothing).tolist() == [0.0, 0.0]
