"""What the jobs of a window say of waits and of foreign threads, written to be read.

The kernel (``jobs.cpp``) computes the same numbers, to the bit.

A job of a real system may wait for something that no cell declares: a device, the network, a lock.
That wait is a part of its demand, wherever it runs. It shows if jobs took longer than their core
time would have, stretched by what the cell's own jobs and foreign threads took meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.estimators import Evidence
from dwell.estimators.evidence import NOT_DUE, Instants
from dwell.estimators.foreign_threads import Level
from dwell.estimators.measured import NOT_FULL, UsedCores, cores_of
from dwell.estimators.pool import newest
from dwell.model import Node, Problem

Floats = NDArray[np.float64]
Ints = NDArray[np.integer]

#: Share of their time alone by which most jobs of a task must have waited, and fewest jobs.
LEAST_WAIT, JOBS = 0.05, 3
#: So much longer than alone jobs take that are slowed, and such a share of them are most.
SLOWED, MOST = 1.02, 0.9


class Jobs(NamedTuple):
    """Jobs that have completed."""

    start_ns: Floats
    end_ns: Floats
    alone_ns: Floats
    cores: Floats
    task: Floats
    row: Floats

    @property
    def taken_ns(self) -> Floats:
        return np.maximum(self.end_ns - self.start_ns, 1.0)


def known_jobs(
    problem: Problem, instants: Instants, placement: Ints, node: Node, *, asks: bool
) -> Jobs | None:
    """Jobs on the CPU of a node, candidate after candidate; None where no task runs there.

    Parameters
    ----------
    asks : bool
        Whether all threads of a job on a fair node count, or the cores that they can have.
    """
    if instants.start_ns is None or instants.work_ns is None:
        return None
    candidates = list(problem.candidates.values())
    rows, is_used = [], False
    for code in sorted({one for one in placement.tolist() if one >= 0}):
        for row in np.flatnonzero(placement == code):
            for column, (name, task) in enumerate(problem.pipeline.tasks.items()):
                execution = task.on[candidates[code][name]]
                if candidates[code][name] != node.name or execution.accelerator is not None:
                    continue
                is_used = True
                begun, ended, work = (
                    of[row, column] for of in (instants.start_ns, instants.end_ns, instants.work_ns)
                )
                all_threads = asks and node.scheduler == "fair"
                cores = execution.threads if all_threads else cores_of(node, execution)
                if begun >= 0 and ended >= 0 and work > 0:
                    rows.append((begun, ended, work / cores, cores, column, row))
    columns = np.array(rows, float).reshape(-1, 6).T
    return Jobs(*columns) if is_used else None


def used_before(problem: Problem, evidence: Evidence, node: Node, own: float) -> float:
    """Mean cores of a full node that jobs of earlier cycles used, where a task has a backlog.

    Parameters
    ----------
    own : float
        Mean cores that all jobs of the cell used on the node in the window; 0 if it is not full.
    """
    candidates, known_ns, has_backlog = list(problem.candidates.values()), 0, False
    for instants, placement in (
        (evidence.cycles, evidence.placement),
        (evidence.shadows, evidence.shadow_placement),
    ):
        if instants is None:
            continue
        assert instants.work_ns is not None
        for column, (name, task) in enumerate(problem.pipeline.tasks.items()):
            mine = [
                row
                for row, code in enumerate(placement.tolist())
                if code >= 0
                and candidates[code][name] == node.name
                and task.on[node.name].accelerator is None
            ]
            end_ns, work_ns = instants.end_ns[mine, column], instants.work_ns[mine, column]
            known_ns += int(np.maximum(work_ns[end_ns >= 0], 0).sum())
            is_due = bool((end_ns != NOT_DUE).any())
            has_backlog |= instants is evidence.cycles and is_due and not (end_ns >= 0).any()
    if own == 0.0 or not has_backlog:
        return 0.0
    return max(own - known_ns / (len(evidence.placement) * problem.pipeline.period_ns), 0.0)


def used_by(jobs: Jobs) -> tuple[Floats, Floats]:
    """Instants at which jobs begin and end, and the cores that they use from each of them on."""
    at_ns = np.concatenate((jobs.start_ns, jobs.end_ns))
    order = np.argsort(at_ns, kind="stable")
    return at_ns[order], np.cumsum(np.concatenate((jobs.cores, -jobs.cores))[order])


def during(jobs: Jobs, at_ns: Floats, rate: Floats) -> Floats:
    """Integral, over each job, of what has a rate from each instant on until the next."""
    area = np.concatenate(([0.0], np.cumsum(rate[:-1] * np.diff(at_ns))))
    return np.interp(jobs.end_ns, at_ns, area) - np.interp(jobs.start_ns, at_ns, area)


def used_beside(jobs: Jobs, others: Jobs) -> Floats:
    """Cores that others used in the mean while each job ran, its own if it is one of them."""
    if not len(others.cores):
        return np.zeros(len(jobs.cores))
    return during(jobs, *used_by(others)) / jobs.taken_ns


def work_with_waits(
    problem: Problem,
    evidence: Evidence,
    shared: tuple[str, ...],
    foreign: Mapping[str, float],
    full: Mapping[str, UsedCores],
) -> Ints:
    """Core time of own jobs, with what most jobs of their task waited for.

    Parameters
    ----------
    full : mapping of str to tuple of (own, others)
        Used cores of each full node.
    """
    cycles = evidence.cycles
    assert cycles.work_ns is not None
    work_ns = cycles.work_ns.copy()
    if cycles.start_ns is None:
        return work_ns
    known = (work_ns > 0) & (cycles.start_ns >= 0) & (cycles.end_ns >= 0)
    for code in sorted(set(evidence.placement.tolist())):
        mine = evidence.placement == code
        placed = list(problem.candidates.values())[code]
        one = evidence.cycles.at(mine)
        for node in problem.fabric.nodes.values():
            if node.scheduler != "fair" or node.quota is not None or node.name in shared:
                continue
            jobs = known_jobs(problem, one, evidence.placement[mine], node, asks=False)
            if jobs is None:
                continue
            threads = foreign.get(node.name, 0.0) + (node.bursts.threads if node.bursts else 0.0)
            earlier = used_before(problem, evidence, node, full.get(node.name, NOT_FULL)[0])
            alone_ns = alone_with_waits(node, threads, jobs, earlier)
            for column, name in enumerate(problem.pipeline.tasks):
                of_task = jobs.task == column
                if placed[name] == node.name and of_task.any():
                    rows = np.flatnonzero(mine & known[:, column])
                    before = jobs.alone_ns[of_task]
                    if (alone_ns[of_task] != before).any():
                        waited = np.rint(alone_ns[of_task] * jobs.cores[of_task])
                        work_ns[rows, column] = waited
    return work_ns


def alone_with_waits(node: Node, foreign: float, jobs: Jobs, earlier: float = 0.0) -> Floats:
    """Times alone of jobs on a node whose jobs share its cores evenly; with waits, if most wait.

    `earlier` is the mean number of cores that jobs of earlier cycles used.
    """
    alone_ns = jobs.alone_ns.copy()
    tasks = [jobs.task == one for one in sorted(set(jobs.task.tolist()))]
    taken_ns = jobs.end_ns - jobs.start_ns
    longer = [of for of in tasks if of.sum() >= JOBS and is_longer(taken_ns[of], alone_ns[of])]
    if not longer:
        return alone_ns
    by_task = np.argsort(jobs.task, kind="stable")
    at_ns, used = used_by(Jobs(*(column[by_task] for column in jobs)))
    # Cores for each that a job wants: what it would have had, had it waited for nothing.
    share = np.minimum(max(node.spare - earlier, 0.0) / np.maximum(used + foreign, 1e-9), 1.0)
    had_ns = during(jobs, at_ns, share)
    for of in longer:
        if is_longer(had_ns[of], jobs.alone_ns[of]):
            alone_ns[of] = np.maximum(had_ns[of], jobs.alone_ns[of])
    return alone_ns


def is_longer(taken_ns: Floats, alone_ns: Floats) -> bool:
    """Whether most of them took longer than alone."""
    longer_ns = taken_ns - alone_ns
    if sum(longer_ns.tolist()) <= LEAST_WAIT / 4 * sum(alone_ns.tolist()):
        return False
    return bool(np.median(longer_ns) > LEAST_WAIT * np.median(alone_ns))


def level(
    problem: Problem,
    evidence: Evidence,
    name: str,
    beside: Ints | None = None,
    used: UsedCores = NOT_FULL,
) -> Level | None:
    """Foreign threads beside which jobs ran since the last change, but those of bursts.

    Parameters
    ----------
    used : tuple of (own, others)
        Used cores of a full node.
    beside : int64 array, shape (n, parts, tasks, 2), optional
        Of a node that cells share, `WindowRows.beside`.
    """
    node = problem.fabric.nodes[name]
    if beside is not None and (node.scheduler != "fair" or node.quota is not None):
        return None
    jobs = known_jobs(problem, evidence.cycles, evidence.placement, node, asks=True)
    before, is_behind = None, jobs is None or len(jobs.cores) < JOBS
    if jobs is None or len(jobs.cores) < JOBS:
        if evidence.shadows is None or not evidence.shadows_share:
            return None
        sent = evidence.shadows, evidence.shadow_placement
        before, jobs = jobs, known_jobs(problem, *sent, node, asks=True)
        if jobs is None or len(jobs.cores) < JOBS:
            return None
    slowed = jobs.taken_ns / jobs.alone_ns
    spare = node.spare if node.quota is None else node.capacity
    earlier = 0.0
    if node.scheduler != "fair":
        threads = slowed * spare - node.cores
    else:
        if beside is None:
            earlier = used_before(problem, evidence, node, used[0])
            mine = used_beside(jobs, jobs)
            own = None if before is None else used_beside(jobs, before)
        else:
            part = int(is_behind)
            of = beside[jobs.row.astype(int), part, jobs.task.astype(int)] / jobs.taken_ns[:, None]
            mine, own = of[:, 0], of[:, 1] if is_behind else None
        threads = slowed * spare - mine
        if own is not None:
            found = behind if beside is None else behind_all
            threads = found(slowed, max(spare - earlier, 0.0), mine, own)
    # Some jobs leave others room, and take no longer for it: they say only how many there are at
    # most. Each task's jobs since its last change are looked at by themselves.
    since = [since_change(jobs, threads, task) for task in sorted(set(jobs.task.tolist()))]
    told = [rows for rows in since if float((slowed[rows] > SLOWED).mean()) >= MOST]
    ordered = np.sort(threads[np.concatenate(told or since)])
    # The middle of what ran beside none of the bursts, which come for less of the time.
    place = (1.0 - (0.0 if node.bursts is None else node.bursts.share)) / 2
    off = math.sqrt(place * (1.0 - place) / len(ordered))
    places = (max(place - off, 0.0), place, min(place + off, 1.0))
    low, beyond, high = (float(ordered[round(one * (len(ordered) - 1))]) for one in places)
    error = (high - low) / 2
    if earlier > 0.0 and not is_behind:
        # Jobs of earlier cycles and foreign threads get the same cores for each thread.
        share = used[1] / (used[1] + earlier)
        beyond, error = beyond * share, error * share
    return Level(max(round(beyond, 3), 0.0), error, bool(told))


def since_change(jobs: Jobs, threads: Floats, task: float) -> Ints:
    """Rows of a task's jobs since the last change within the window."""
    mine = np.flatnonzero(jobs.task == task)
    mine = mine[np.argsort(jobs.end_ns[mine], kind="stable")]
    return mine[newest(threads[mine]) :]


def behind(slowed: Floats, spare: float, mine: Floats, own: Floats) -> Floats:
    """Foreign threads that share with shadow jobs what own jobs leave."""
    left = np.maximum(spare - own, 0.0)
    threads = np.maximum(slowed * left - mine, 0.0)
    for _ in range(2):
        load = own + threads
        left = np.where(load <= spare, spare - own, spare * threads / np.maximum(load, 1e-9))
        threads = np.maximum(slowed * left - mine, 0.0)
    return threads


def behind_all(slowed: Floats, spare: float, mine: Floats, own: Floats) -> Floats:
    """The same next to the jobs of all cells, which may fill the node."""
    free = slowed * (spare - own) - mine
    half = (slowed * spare - own - mine) / 2
    full = np.maximum(half + np.sqrt(np.maximum(half * half - own * mine, 0.0)), 0.0)
    return np.where((free > 0) & (own + free <= spare), free, full)
