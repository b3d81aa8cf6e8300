"""Foreign threads of a node: how many there are beyond those that the cell declares.

Where others leave something of a node, its load says how many there are. A full node hides it;
there the cell's own jobs tell, by how much longer they took than the core time that they received.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence, Instants
from dwell.estimators.measured import groups
from dwell.model.fabric import Node
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]

#: Foreign load is other than declared where it is so many deviations of a window off, and a share
#: of the cores beyond that.
DEVIATIONS, LEAST_SHARE = 4.0, 0.05
#: So many jobs tell how many threads they ran beside.
JOBS = 3
#: Windows over which a level is averaged.
WINDOWS = 6


class Level(NamedTuple):
    """Foreign threads beside which jobs ran, with the standard error."""

    threads: float
    error: float


class _Jobs(NamedTuple):
    start_ns: Floats
    end_ns: Floats
    alone_ns: Floats
    cores: Floats

    @property
    def taken_ns(self) -> Floats:
        return np.maximum(self.end_ns - self.start_ns, 1.0)


class ForeignThreads:
    """Foreign threads of one node beyond those that are declared.

    Parameters
    ----------
    usual_threads : float
        Those of its bursts, in the mean.

    Attributes
    ----------
    beyond : float
        How many more there are; negative where there are fewer.
    is_least : bool
        Whether there are at least so many, and maybe more.
    """

    def __init__(self, node: Node, usual_threads: float) -> None:
        self.node, self.usual_threads = node, usual_threads
        self.beyond, self.is_least = 0.0, False
        self._mean, self._windows = 0.0, 0
        #: Threads of the bursts for each share of the node that they take.
        self._threads_each = max(node.capacity, node.bursts.threads if node.bursts else 0.0)

    def __repr__(self) -> str:
        return f"<ForeignThreads of {self.node.name}: {self.beyond:+.2g} beyond the declared>"

    @property
    def threads(self) -> float:
        """All of them, in the mean."""
        return max(self.usual_threads + self.beyond, 0.0)

    def see_load(self, share: float, usual: float, deviation: float) -> bool:
        """Take in the foreign share of a node that is not full; returns whether that is a change.

        Parameters
        ----------
        usual, deviation : float
            Mean and standard deviation of a window's share as declared.
        """
        noise = DEVIATIONS * deviation + LEAST_SHARE
        off = share - usual
        beyond = 0.0 if abs(off) <= noise else off * self.node.capacity
        return self._see(beyond, noise * self.node.capacity)

    def see_full(self, share: float, deviation: float, level: Level | None) -> bool:
        """Take in that the node is full, and others have a part of it; as `see_load`.

        Parameters
        ----------
        level : Level, optional
            What the cell's jobs say.
        """
        if level is not None:
            error = math.hypot(level.error, deviation * self._threads_each)
            noise = DEVIATIONS * error + LEAST_SHARE * (self.node.capacity + level.threads)
            return self._see(level.threads - self.usual_threads, noise)
        least = share * self.node.capacity
        if self.threads + LEAST_SHARE * self.node.capacity >= least and self.beyond > 0.0:
            return False  # what was known before says more
        # A thread for each core is the fewest that fill it.
        changed = self._see(max(self.node.capacity - self.usual_threads, 0.0), least)
        self.is_least = True
        return changed

    def _see(self, seen: float, noise: float) -> bool:
        self.is_least = False
        is_jump = abs(seen - self._mean) > noise or (seen == 0.0) != (self._mean == 0.0)
        self._windows = 1 if is_jump else min(self._windows + 1, WINDOWS)
        self._mean += (seen - self._mean) / self._windows
        # What drifts is taken over in steps.
        step = LEAST_SHARE * (self.node.capacity + abs(self._mean))
        if not is_jump and abs(self._mean - self.beyond) <= step:
            return False
        self.beyond = self._mean
        return True


class Stretches:
    """Tells from a window's jobs beside how many foreign threads they ran."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._placements = tuple(problem.candidates.values())
        #: Tasks of a placement on the CPU of a node, with the cores that each may use.
        self._on: dict[tuple[int, str], tuple[list[int], Floats]] = {}

    def level(self, evidence: Evidence, name: str) -> Level | None:
        """What the jobs on a node say; None where they say nothing.

        Own jobs count if there are enough, else shadow jobs, where these share what own jobs leave
        with foreign threads as equals.
        """
        node = self._problem.fabric.nodes[name]
        own = self._jobs(evidence.cycles, evidence.placement, name)
        if own is not None and len(own.cores) >= JOBS:
            return _level(node, own, None)
        if evidence.shadows is None or not evidence.shadows_share:
            return None
        shadows = self._jobs(evidence.shadows, evidence.shadow_placement, name)
        if shadows is None or len(shadows.cores) < JOBS:
            return None
        return _level(node, shadows, own)

    def _jobs(
        self, instants: Instants, placement: NDArray[np.integer], name: str
    ) -> _Jobs | None:
        if instants.start_ns is None or instants.work_ns is None:
            return None
        found = []
        for code, rows in groups(placement):
            columns, cores = self._tasks_on(int(code), name)
            if code < 0 or not columns:
                continue
            of = instants.at(rows)
            assert of.start_ns is not None
            assert of.work_ns is not None
            pieces = [table[:, columns].astype(float) for table in (of.start_ns, of.end_ns)]
            alone_ns = of.work_ns[:, columns] / cores
            known = (pieces[0] >= 0) & (pieces[1] >= 0) & (alone_ns > 0)
            wide = np.broadcast_to(cores, known.shape)
            found.append([*(piece[known] for piece in pieces), alone_ns[known], wide[known]])
        if not found:
            return None
        return _Jobs(*map(np.concatenate, zip(*found, strict=True)))

    def _tasks_on(self, code: int, name: str) -> tuple[list[int], Floats]:
        if (code, name) not in self._on:
            columns, cores = [], []
            for column, task in enumerate(self._problem.pipeline.tasks.values()):
                execution = task.on.get(name)
                here = code >= 0 and self._placements[code][task.name] == name
                if here and execution is not None and execution.accelerator is None:
                    columns.append(column)
                    cores.append(min(execution.threads, self._problem.fabric.nodes[name].cores))
            self._on[code, name] = columns, np.array(cores, float)
        return self._on[code, name]


def _level(node: Node, jobs: _Jobs, before: _Jobs | None) -> Level:
    """Foreign threads beside which jobs ran, those of others before them.

    Parameters
    ----------
    before : _Jobs, optional
        Own jobs, which have their cores first; of `jobs` where None.
    """
    slowed = jobs.taken_ns / jobs.alone_ns
    spare = node.spare if node.quota is None else node.capacity
    if node.scheduler != "fair":
        threads = slowed * spare - node.cores
        return Level(max(float(np.median(threads)), 0.0), _error(threads))
    beside = _beside(jobs, jobs)
    if before is None:
        threads = slowed * spare - beside
    else:
        own = _beside(jobs, before)
        left = np.maximum(spare - own, 0.0)
        for _ in range(3):
            threads = np.maximum(slowed * left - beside, 0.0)
            load = own + threads
            left = np.where(load <= spare, spare - own, spare * threads / np.maximum(load, 1e-9))
    # By time: a long job has met more of what comes and goes.
    mean = float((threads * jobs.taken_ns).sum() / jobs.taken_ns.sum())
    return Level(max(mean, 0.0), _error(threads))


def _error(threads: Floats) -> float:
    return float(threads.std(ddof=1)) / math.sqrt(len(threads))


def _beside(jobs: _Jobs, others: _Jobs) -> Floats:
    """Cores that others used in the mean while each of the jobs ran, its own if it is of them."""
    at_ns = np.concatenate((others.start_ns, others.end_ns))
    change = np.concatenate((others.cores, -others.cores))
    order = np.argsort(at_ns, kind="stable")
    at_ns, used = at_ns[order], np.cumsum(change[order])
    area = np.concatenate(([0.0], np.cumsum(used[:-1] * np.diff(at_ns))))
    between = np.interp(jobs.end_ns, at_ns, area) - np.interp(jobs.start_ns, at_ns, area)
    return between / jobs.taken_ns
