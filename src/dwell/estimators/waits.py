"""Waits: time of jobs that neither their core time nor others on their node account for.

A job of a real system may wait for what no cell declares: a device, the network, a lock. That is a
part of its demand, wherever it runs. It shows where jobs took longer than their core time would
have, stretched by what the cell's own jobs and foreign threads took meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model.fabric import Node

Floats: TypeAlias = NDArray[np.float64]

#: Share of their time alone by which most jobs of a task must have waited, and fewest jobs.
LEAST_WAIT, JOBS = 0.05, 3


def beside(start_ns: Floats, end_ns: Floats, others: tuple[Floats, Floats, Floats]) -> Floats:
    """Cores that others used in the mean while each job ran, its own if it is one of them.

    Parameters
    ----------
    start_ns, end_ns : float64 array, shape (n,)
    others : tuple of float64 array, shape (m,)
        Start, end and cores of jobs.
    """
    if not len(others[0]):
        return np.zeros(len(start_ns))
    at_ns, used = _used(others)
    mean: Floats = _during(start_ns, end_ns, at_ns, used) / np.maximum(end_ns - start_ns, 1.0)
    return mean


def _used(others: tuple[Floats, Floats, Floats]) -> tuple[Floats, Floats]:
    """Instants at which jobs come and go, and the cores that they use from each of them on."""
    begins_ns, ends_ns, cores = others
    at_ns, change = np.concatenate((begins_ns, ends_ns)), np.concatenate((cores, -cores))
    order = np.argsort(at_ns, kind="stable")
    return at_ns[order], np.cumsum(change[order])


def _during(start_ns: Floats, end_ns: Floats, at_ns: Floats, rate: Floats) -> Floats:
    """Integral from start to end of what has a rate from each instant on until the next."""
    area = np.concatenate(([0.0], np.cumsum(rate[:-1] * np.diff(at_ns))))
    integral: Floats = np.interp(end_ns, at_ns, area) - np.interp(start_ns, at_ns, area)
    return integral


def alone_with_waits(
    node: Node, foreign: float, jobs: Mapping[int, tuple[Floats, Floats, Floats, float]]
) -> dict[int, Floats]:
    """Times alone of the jobs of tasks that wait, on a node whose jobs share its cores evenly.

    Parameters
    ----------
    foreign : float
        Foreign threads beside them.
    jobs : mapping of int to (start_ns, end_ns, alone_ns, cores)
        Jobs of each task, with how long they would have taken by their core time.

    Returns
    -------
    dict of int to float64 array
        Of those tasks alone whose jobs have waited.
    """
    waiting = {}
    # Most tasks took no longer than their core time says, and need not be looked at again.
    longer = [
        task
        for task, (start_ns, end_ns, alone_ns, _) in jobs.items()
        if len(alone_ns) >= JOBS and _is_longer(end_ns - start_ns, alone_ns)
    ]
    if not longer:
        return {}
    others = [(start, end, np.full(len(start), cores)) for start, end, _, cores in jobs.values()]
    every = tuple(map(np.concatenate, zip(*others, strict=True)))
    at_ns, used = _used((every[0], every[1], every[2]))
    # Cores for each that a job wants: what it would have had, had it waited for nothing.
    share = np.minimum(node.spare / np.maximum(used + foreign, 1e-9), 1.0)
    for task in longer:
        start_ns, end_ns, alone_ns, _ = jobs[task]
        had_ns = _during(start_ns, end_ns, at_ns, share)
        if _is_longer(had_ns, alone_ns):
            waiting[task] = np.maximum(had_ns, alone_ns)
    return waiting


def _is_longer(taken_ns: Floats, alone_ns: Floats) -> bool:
    longer_ns = taken_ns - alone_ns
    # Where most are longer, all together are; to add up takes less than to look for the middle.
    if longer_ns.sum() <= LEAST_WAIT / 4 * alone_ns.sum():
        return False
    return bool(np.median(longer_ns) > LEAST_WAIT * np.median(alone_ns))
