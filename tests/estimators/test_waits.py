"""Waits: what jobs wait for is told from what others on their node took."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import dwell
from dwell.estimators import Corrected, Evidence
from dwell.estimators.measured import Meter, Site
from dwell.model import Node, Problem
from tests.cells.random_dags import random_dag
from tests.reference.window_jobs import Jobs, alone_with_waits, used_beside

MS = 1e6
CORE = Node("R", "robot", cores=1)


def jobs(task: int, start_ms: list[float], taken_ms: list[float], alone_ms: list[float]) -> Jobs:
    start, one = np.array(start_ms) * MS, np.ones(len(start_ms))
    end, alone = start + np.array(taken_ms) * MS, np.array(alone_ms) * MS
    return Jobs(start, end, alone, one, task * one, np.arange(len(start_ms), dtype=float))


def test_the_mean_of_what_others_used_while_a_job_ran() -> None:
    mine = jobs(0, [0.0, 5.0, 8.0], [10.0, 10.0, 12.0], [1.0, 1.0, 1.0])
    others = jobs(0, [0.0, 5.0], [10.0, 10.0], [1.0, 1.0])._replace(cores=np.array([1.0, 2.0]))
    # 10 of one and 5 of two; 5 of one and 10 of two; 2 of one and 7 of two, of 12.
    np.testing.assert_allclose(used_beside(mine, others), [2.0, 2.5, 16 / 12])


def test_a_job_that_takes_longer_than_its_core_time_has_waited() -> None:
    waits = jobs(3, [0.0, 100.0, 200.0], [30.0, 25.0, 1.0], [5.0, 5.0, 1.0])
    np.testing.assert_allclose(alone_with_waits(CORE, 0.0, waits), [30.0 * MS, 25.0 * MS, 1.0 * MS])


def test_what_few_jobs_do_is_no_wait() -> None:
    once = jobs(0, [0.0, 100.0, 200.0], [30.0, 5.0, 5.0], [5.0, 5.0, 5.0])
    assert alone_with_waits(CORE, 0.0, once).tolist() == once.alone_ns.tolist()


def test_jobs_that_share_a_core_have_not_waited() -> None:
    """Two of 30 ms from the same instant on take 60 ms each."""
    one, other = (jobs(task, [0.0, 70.0], [60.0, 60.0], [30.0, 30.0]) for task in (0, 1))
    both = Jobs(*map(np.concatenate, zip(one, other, strict=True)))
    assert alone_with_waits(CORE, 0.0, both).tolist() == both.alone_ns.tolist()


def test_jobs_beside_foreign_threads_have_not_waited() -> None:
    slowed = jobs(0, [0.0, 70.0, 140.0], [30.0, 30.0, 30.0], [10.0, 10.0, 10.0])
    assert alone_with_waits(CORE, 2.0, slowed).tolist() == slowed.alone_ns.tolist()
    assert alone_with_waits(CORE, 1.0, slowed).tolist() > slowed.alone_ns.tolist()


class Witness(Corrected):
    """`Corrected` that looks whether any job has waited; copies of it are itself."""

    def __deepcopy__(self, memo: object) -> Witness:
        return self

    def start(self, problem: Problem) -> None:
        """Begin again."""
        super().start(problem)
        self.meter, self.windows = Meter(problem), 0

    def _take_in(self, evidence: Evidence) -> None:
        super()._take_in(evidence)
        waited_ns = self.meter.waited_ns(evidence, self._threads)
        np.testing.assert_array_equal(waited_ns, evidence.cycles.work_ns)
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
    halved = kept[0].with_instants(replace(cycles, work_ns=half_ns), kept[0].shadows)
    site = Site("planning", "R2")
    whole = meter.demands(kept[0])[site].copy()
    np.testing.assert_allclose(meter.demands(halved)[site], whole, rtol=1e-6)


def test_where_there_are_no_others_they_used_nothing() -> None:
    mine = jobs(0, [0.0, 5.0], [10.0, 15.0], [1.0, 1.0])
    assert used_beside(mine, jobs(0, [], [], [])).tolist() == [0.0, 0.0]
