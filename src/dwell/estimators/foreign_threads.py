"""Foreign threads of a node: how many there are beyond those that the cell declares.

Where others leave something of a node, its load says how many there are. A full node hides it;
there the cell's own jobs tell, by how much longer they took than the core time that they received.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence, Instants
from dwell.estimators.measured import cores_of, groups
from dwell.estimators.pool import newest
from dwell.estimators.waits import beside
from dwell.model.fabric import Node
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]

#: Foreign load is other than declared where it is so many deviations of a window off, and a share
#: of the cores beyond that.
DEVIATIONS, LEAST_SHARE = 4.0, 0.05
#: So many jobs tell how many threads they ran beside.
JOBS = 3
#: So much longer than alone jobs take that are slowed, and such a share of them are most.
SLOWED, MOST = 1.02, 0.9
#: Windows over which a level is averaged.
WINDOWS = 3


class Level(NamedTuple):
    """Foreign threads beside which jobs ran beyond those of bursts, with the standard error.

    Parameters
    ----------
    is_slowed : bool
        Whether they took something of what most jobs wanted; if not, there may be fewer.
    """

    threads: float
    error: float
    is_slowed: bool


class _Jobs(NamedTuple):
    start_ns: Floats
    end_ns: Floats
    alone_ns: Floats
    cores: Floats
    task: Floats

    @property
    def intervals(self) -> tuple[Floats, Floats, Floats]:
        """Start, end and cores."""
        return self.start_ns, self.end_ns, self.cores

    @property
    def taken_ns(self) -> Floats:
        return np.maximum(self.end_ns - self.start_ns, 1.0)


class ForeignThreads:
    """Foreign threads of one node beyond those that are declared.

    Parameters
    ----------
    node : Node
    decisions : float
        Decisions per window.

    Attributes
    ----------
    beyond : float
        How many more there are; negative where there are fewer.
    """

    def __init__(self, node: Node, decisions: float = 1.0) -> None:
        self.node, self._most = node, round(WINDOWS * decisions)
        self.beyond = 0.0
        self._mean, self._windows = 0.0, 0

    def __repr__(self) -> str:
        return f"<ForeignThreads of {self.node.name}: {self.beyond:+.2g} beyond the declared>"

    @property
    def threads(self) -> float:
        """All of them, in the mean."""
        return max(self.node.burst_threads + self.beyond, 0.0)

    def see(
        self,
        share: float,
        usual: float,
        deviation: float,
        level: Callable[[], Level | None],
        *,
        is_full: bool,
    ) -> bool:
        """Take in what a window showed; returns whether that is a change.

        Parameters
        ----------
        share : float
            Of the node, that others took.
        usual, deviation : float
            Mean and standard deviation of a window's share as declared.
        level : callable
            Says what the cell's jobs tell, if anything; asked where the share does not tell all.
        is_full : bool
            Whether nothing of the node was left, so that there may be more than the share says.
        """
        capacity = self.node.capacity
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
            return False  # what was known before says more
        # A thread for each core is the fewest that fill it.
        return self._see(max(capacity - self.node.burst_threads, 0.0), least)

    def _see(self, seen: float, noise: float) -> bool:
        is_jump = abs(seen - self._mean) > noise or (seen == 0.0) != (self._mean == 0.0)
        self._windows = 1 if is_jump else min(self._windows + 1, self._most)
        self._mean += (seen - self._mean) / self._windows
        # What drifts is taken over in steps.
        step = LEAST_SHARE / 2 * (self.node.capacity + abs(self._mean))
        if not is_jump and abs(self._mean - self.beyond) <= step:
            return False
        self.beyond = self._mean
        return True


class Stretches:
    """Tells from a window's jobs beside how many foreign threads they ran."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._placements = tuple(problem.candidates.values())
        #: Tasks of a placement on the CPU of a node, with how many cores each asks for.
        self._on: dict[tuple[int, str], tuple[list[int], Floats]] = {}

    def level(self, evidence: Evidence, name: str) -> Level | None:
        """What the jobs on a node say; None where they say nothing.

        Own jobs count if there are enough, else shadow jobs, where these share what own jobs leave
        with foreign threads as equals.
        """
        node = self._problem.fabric.nodes[name]
        bursts = 0.0 if node.bursts is None else node.bursts.share
        own = self._jobs(evidence.cycles, evidence.placement, name)
        if own is not None and len(own.cores) >= JOBS:
            return _level(node, bursts, own, None)
        if evidence.shadows is None or not evidence.shadows_share:
            return None
        shadows = self._jobs(evidence.shadows, evidence.shadow_placement, name)
        if shadows is None or len(shadows.cores) < JOBS:
            return None
        return _level(node, bursts, shadows, own)

    def _jobs(self, instants: Instants, placement: NDArray[np.integer], name: str) -> _Jobs | None:
        start_ns, end_ns, work_ns = instants.start_ns, instants.end_ns, instants.work_ns
        if start_ns is None or work_ns is None:
            return None
        found = []
        for code, rows in groups(placement):
            columns, cores = self._tasks_on(int(code), name)
            if not columns:
                continue
            begun, ended, work = (of[rows][:, columns] for of in (start_ns, end_ns, work_ns))
            known = (begun >= 0) & (ended >= 0) & (work > 0)
            wide = [np.broadcast_to(row, known.shape) for row in (cores, columns)]
            found.append([of[known].astype(float) for of in (begun, ended, work / cores, *wide)])
        return _Jobs(*map(np.concatenate, zip(*found, strict=True))) if found else None

    def _tasks_on(self, code: int, name: str) -> tuple[list[int], Floats]:
        if (code, name) not in self._on:
            columns, cores, node = [], [], self._problem.fabric.nodes[name]
            for column, task in enumerate(self._problem.pipeline.tasks.values()):
                execution = task.on.get(name)
                here = code >= 0 and self._placements[code][task.name] == name
                if here and execution is not None and execution.accelerator is None:
                    columns.append(column)
                    # Of a fair node all threads of a job take turns with others.
                    fair = node.scheduler == "fair"
                    cores.append(execution.threads if fair else cores_of(node, execution))
            self._on[code, name] = columns, np.array(cores, float)
        return self._on[code, name]


def _level(node: Node, bursts: float, jobs: _Jobs, before: _Jobs | None) -> Level:
    """Foreign threads beside which jobs ran since the last change, but those of bursts.

    Parameters
    ----------
    bursts : float
        Share of the time in which there are bursts.
    before : _Jobs, optional
        Own jobs, which have their cores first; of `jobs` where None.
    """
    taken_ns = jobs.taken_ns
    slowed = taken_ns / jobs.alone_ns
    spare = node.spare if node.quota is None else node.capacity
    if node.scheduler != "fair":
        threads = slowed * spare - node.cores
    else:
        mine = beside(jobs.start_ns, jobs.end_ns, jobs.intervals)
        threads = slowed * spare - mine
        if before is not None:
            own = beside(jobs.start_ns, jobs.end_ns, before.intervals)
            threads = _behind(slowed, spare, mine, own)
    # Some jobs leave others room, and take no longer for it: they say only how many there are at
    # most. Each task's jobs since its last change are looked at by themselves.
    since = [_since_change(jobs, threads, task) for task in sorted(set(jobs.task.tolist()))]
    told = [rows for rows in since if float((slowed[rows] > SLOWED).mean()) >= MOST]
    ordered = np.sort(threads[np.concatenate(told or since)])
    # The middle of what ran beside none of the bursts, which come for less of the time.
    place = (1.0 - bursts) / 2
    off = math.sqrt(place * (1.0 - place) / len(ordered))
    places = (max(place - off, 0.0), place, min(place + off, 1.0))
    low, beyond, high = (float(ordered[round(one * (len(ordered) - 1))]) for one in places)
    # Nanoseconds of an instant are none.
    return Level(max(round(beyond, 3), 0.0), (high - low) / 2, bool(told))


def _since_change(jobs: _Jobs, threads: Floats, task: float) -> Ints:
    """Rows of a task's jobs since the last change within the window."""
    mine = np.flatnonzero(jobs.task == task)
    mine = mine[np.argsort(jobs.end_ns[mine], kind="stable")]
    return mine[newest(threads[mine]) :]


def _behind(slowed: Floats, spare: float, mine: Floats, own: Floats) -> Floats:
    """Foreign threads that share with shadow jobs what own jobs leave."""
    left = np.maximum(spare - own, 0.0)
    threads = np.maximum(slowed * left - mine, 0.0)
    for _ in range(2):
        load = own + threads
        left = np.where(load <= spare, spare - own, spare * threads / np.maximum(load, 1e-9))
        threads = np.maximum(slowed * left - mine, 0.0)
    return threads
