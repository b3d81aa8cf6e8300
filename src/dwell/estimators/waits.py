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

#: Share of their time alone by which most jobs of a task must have waited.
LEAST_WAIT = 0.05


def beside(start_ns: Floats, end_ns: Floats, others: tuple[Floats, Floats, Floats]) -> Floats:
    """Cores that others used in the mean while each job ran, its own if it is one of them.

    Parameters
    ----------
    start_ns, end_ns : float64 array, shape (n,)
    others : tuple of float64 array, shape (m,)
        Start, end and cores of jobs.
    """
    begins_ns, ends_ns, cores = others
    at_ns, change = np.concatenate((begins_ns, ends_ns)), np.concatenate((cores, -cores))
    order = np.argsort(at_ns, kind="stable")
    at_ns, used = at_ns[order], np.cumsum(change[order])
    area = np.concatenate(([0.0], np.cumsum(used[:-1] * np.diff(at_ns))))
    between = np.interp(end_ns, at_ns, area) - np.interp(start_ns, at_ns, area)
    mean: Floats = between / np.maximum(end_ns - start_ns, 1.0)
    return mean


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
        if _is_longer(end_ns - start_ns, alone_ns)
    ]
    if not longer:
        return {}
    others = [(start, end, np.full(len(start), cores)) for start, end, _, cores in jobs.values()]
    every = tuple(map(np.concatenate, zip(*others, strict=True)))
    for task in longer:
        start_ns, end_ns, alone_ns, _ = jobs[task]
        load = beside(start_ns, end_ns, (every[0], every[1], every[2])) + foreign
        # The mean load stretches no less than what each moment's did (Jensen), so that a job that
        # only shared its cores has not waited.
        taken_ns = (end_ns - start_ns) / np.maximum(load / node.spare, 1.0)
        if _is_longer(taken_ns, alone_ns):
            waiting[task] = np.maximum(taken_ns, alone_ns)
    return waiting


def _is_longer(taken_ns: Floats, alone_ns: Floats) -> bool:
    return bool(np.median(taken_ns - alone_ns) > LEAST_WAIT * np.median(alone_ns))
