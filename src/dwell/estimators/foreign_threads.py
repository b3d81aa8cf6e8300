"""Number of foreign threads of a node in addition to the declared threads.

The load of a node shows their number unless the node is full. On a full node the cell's own jobs
show it: they take longer than the core time that they receive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

import numpy as np

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import (
    NOT_FULL,
    UsedCores,
    cores_of,
    cores_on,
    message_columns,
)
from dwell.kernels.jobs import NodeJobs, SlowedJobs
from dwell.kernels.meter import WindowRows
from dwell.model.fabric import Node
from dwell.model.number_arrays import Ints
from dwell.model.pipeline import Execution
from dwell.model.problem import Problem

#: Foreign load has changed if it differs from the declared load by more than this many standard
#: deviations of a window plus this share of the cores.
DEVIATIONS, LEAST_SHARE = 4.0, 0.05
#: Windows over which a level is averaged.
WINDOWS = 3


class Level(NamedTuple):
    """Estimate of a node's foreign threads from its jobs."""

    #: Number in addition to bursts.
    threads: float
    #: Standard error of `threads`.
    error: float
    #: Whether they slowed most jobs down; if not, there may be fewer threads.
    is_slowed: bool


class ForeignThreads:
    """Foreign threads of one node; `decisions` is the number of decisions per window.

    `beyond` is the number in addition to the declared threads, negative for fewer.
    """

    def __init__(self, node: Node, decisions: float = 1.0) -> None:
        self.node, self._most = node, round(WINDOWS * decisions)
        self._capacity, self._burst_threads = node.capacity, node.burst_threads
        self.beyond = 0.0
        self._mean, self._windows = 0.0, 0

    def __repr__(self) -> str:
        return f"<ForeignThreads of {self.node.name}: {self.beyond:+.2g} beyond the declared>"

    @property
    def threads(self) -> float:
        """Mean number, including declared threads."""
        return max(self._burst_threads + self.beyond, 0.0)

    def see(
        self,
        share: float,
        usual: float,
        deviation: float,
        level: Callable[[], Level | None],
        *,
        is_full: bool,
    ) -> bool:
        """Add the measurement of a window; return whether `beyond` has changed.

        `share` is the share of the node that others used; `usual` and `deviation` are its mean and
        standard deviation as declared. If `is_full`, there may be more threads than `share` shows.
        `level` estimates the threads from the cell's jobs; it is called only if `share` has changed
        or the node is full.
        """
        capacity = self._capacity
        noise = DEVIATIONS * deviation + LEAST_SHARE
        beyond = (share - usual) * capacity
        if abs(beyond) <= noise * capacity and not is_full:
            return self._see(0.0, noise * capacity)
        told = level()
        if told is not None and (is_full or told.is_slowed):
            noise = DEVIATIONS * told.error + LEAST_SHARE * (capacity + told.threads)
            return self._see(told.threads, noise)
        if not is_full:
            return self._see(beyond, noise * capacity)
        least = share * capacity
        if self.threads + LEAST_SHARE * capacity >= least and self.beyond > 0.0:
            return False  # the earlier number is at least as large
        # At least one thread per core fills the node.
        return self._see(max(capacity - self._burst_threads, 0.0), least)

    def _see(self, seen: float, noise: float) -> bool:
        is_jump = abs(seen - self._mean) > noise or (seen == 0.0) != (self._mean == 0.0)
        self._windows = 1 if is_jump else min(self._windows + 1, self._most)
        self._mean += (seen - self._mean) / self._windows
        # A drift changes `beyond` in steps.
        step = LEAST_SHARE / 2 * (self._capacity + abs(self._mean))
        if not is_jump and abs(self._mean - self.beyond) <= step:
            return False
        self.beyond = self._mean
        return True


class Stretches:
    """Estimates of foreign threads from the jobs of a window.

    The jobs of each task since its last change are compared with their times alone on the node. If
    most jobs of some tasks are slowed, only these tasks count; jobs that are not slowed show only
    an upper bound. Jobs of other cells run on the nodes in `shared`. There, jobs count only if all
    share the cores evenly and the evidence has the number of threads that ran with each job.
    """

    def __init__(self, problem: Problem, shared: Collection[str] = ()) -> None:
        self._problem, self._shared = problem, shared
        self._on: dict[str, SlowedJobs] = {}
        self._most = round(WINDOWS * problem.decisions_per_window)
        #: The newest windows since a node is full.
        self._full: dict[str, deque[Evidence]] = {}

    def level(self, evidence: Evidence, name: str, used: UsedCores = NOT_FULL) -> Level | None:
        """Return the estimate from the jobs on a node; None if they allow no estimate.

        Own jobs count if there are enough; if not, shadow jobs do, provided that they share the
        remaining cores evenly with foreign threads. `used` has the used cores of a full node:
        they show jobs of earlier cycles, which the evidence lacks, if a task has a backlog. If a
        window has too few jobs, those of the windows before count, too, as long as the node was
        full.
        """
        rows, is_shared = evidence.rows, name in self._shared
        node = self._problem.fabric.nodes[name]
        if is_shared and (
            rows.beside is None or node.scheduler != "fair" or node.quota is not None
        ):
            return None
        shadows = evidence.shadows_share
        jobs, windows = self._jobs_on(name), self._since_full(evidence, name, used)
        told = jobs.level(rows, used, shadows=shadows, is_shared=is_shared)
        while told is None and windows and not is_shared:
            rows = WindowRows(np.concatenate([windows.pop(), rows.table]), rows.tasks, rows.flows)
            told = jobs.level(rows, used, shadows=shadows)
        if told is None:
            return None
        threads, error, is_slowed = told
        # Instants are rounded to nanoseconds: a tiny number is 0.
        return Level(max(round(threads, 3), 0.0), error, is_slowed)

    def _since_full(self, evidence: Evidence, name: str, used: UsedCores) -> list[Ints]:
        """Return the tables of the windows before, oldest first, if a node was full since then."""
        kept = self._full.setdefault(name, deque(maxlen=self._most))
        table, open_ns = evidence.rows.table, int(evidence.release_ns[0])
        if kept and (
            used == NOT_FULL
            or open_ns > kept[-1].close_ns + self._problem.pipeline.period_ns
            or kept[-1].rows.table.shape[1] != table.shape[1]
        ):
            kept.clear()
        before = [window.rows.table for window in kept]
        if used != NOT_FULL:
            kept.append(evidence)
        return before

    def _jobs_on(self, name: str) -> SlowedJobs:
        if name not in self._on:
            node = self._problem.fabric.nodes[name]
            spare = node.spare if node.quota is None else node.capacity
            bursts = 0.0 if node.bursts is None else node.bursts.share
            cores = cores_on(self._problem, node, partial(_turns, node))
            is_fair = node.scheduler == "fair"
            period_ns = self._problem.pipeline.period_ns
            jobs = NodeJobs(cores, is_fair, node.cores, spare, period_ns, bursts)
            flows = message_columns(self._problem, next(iter(self._problem.candidates.values())))
            self._on[name] = SlowedJobs(jobs, len(flows))
        return self._on[name]


def _turns(node: Node, execution: Execution) -> float:
    """Return the cores of a job; on a fair node, the number of its threads."""
    return execution.threads if node.scheduler == "fair" else cores_of(node, execution)
