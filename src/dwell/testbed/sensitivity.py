"""Sensitivity: how much longer a stage takes where a probe's piece of work does.

A CPU that is slower because somebody else uses what it shares with them (the other thread of its
core, caches, memory) is so in another measure for every piece of code: twice as slow for a sum may
be three times as slow for pictures. Within a run both change from window to window, and together:
the slope of the logarithm of one on that of the other says by how many percent a stage takes longer
where the piece of work takes one percent longer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dwell.testbed.measured import Floats, Measured, SiteName, Visit
from dwell.testbed.speeds import Usual, window_work_ms

__all__ = ["sensitivities", "usual_of"]

#: Windows that a slope needs, of all runs together; and in how many jobs a window's mean.
LEAST_WINDOWS, LEAST_JOBS = 40, 10
#: What the logarithms of the probe's times have to spread by: of nothing that changes, nothing
#: follows.
LEAST_SPREAD = 0.02
#: A stage that takes longer where a probe takes less has been measured badly.
LOWEST, HIGHEST = 0.0, 2.0


def usual_of(measured: Sequence[Measured]) -> Usual:
    """How fast the CPUs were in some runs; of nodes of which every run knows it.

    Parameters
    ----------
    measured : sequence of Measured
    """
    nodes = set.intersection(*(set(one.work_ms) for one in measured)) if measured else set()
    return Usual(
        {node: float(np.mean([one.work_ms[node] for one in measured])) for node in sorted(nodes)},
        sensitivities(measured),
    )


def sensitivities(measured: Sequence[Measured]) -> dict[SiteName, float]:
    """Exponents by task and node, where the runs show them.

    Parameters
    ----------
    measured : sequence of Measured
        Of each only the nodes that nothing disturbs.
    """
    pairs: dict[SiteName, list[tuple[Floats, Floats]]] = {}
    for one in measured:
        probed = window_work_ms(one.run.meta)
        for site, visit in one.visits.items():
            node = site[1]
            if node in probed and node not in one.disturbed.nodes:
                pairs.setdefault(site, []).append(_deviations(visit, probed[node]))
    found = {}
    for site, of in sorted(pairs.items()):
        probe, stage = (np.concatenate(side) for side in zip(*of, strict=True))
        if len(probe) >= LEAST_WINDOWS and probe.std() >= LEAST_SPREAD:
            slope = float(probe @ stage / (probe @ probe))
            found[site] = min(max(slope, LOWEST), HIGHEST)
    return found


def _deviations(visit: Visit, probed: dict[int, float]) -> tuple[Floats, Floats]:
    """Logarithms of a run's windows, probe and stage, less their means."""
    numbers, place, jobs = np.unique(visit.windows, return_inverse=True, return_counts=True)
    stage_ms = np.bincount(place, visit.stage_ms) / jobs
    kept = [
        i
        for i, number in enumerate(numbers.tolist())
        if jobs[i] >= LEAST_JOBS and number in probed and stage_ms[i] > 0
    ]
    if not kept:
        return np.empty(0), np.empty(0)
    probe = np.log([probed[int(numbers[i])] for i in kept])
    stage = np.log(stage_ms[kept])
    return probe - probe.mean(), stage - stage.mean()
