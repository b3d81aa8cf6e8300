"""Sensitivity: how much longer a stage takes where a probe's piece of work does.

A CPU that is slower because somebody else uses what it shares with them (the other thread of its
core, caches, memory) is so in another measure for every piece of code: twice as slow for a sum may
be three times as slow for pictures. Both change from minute to minute, and together: the slope of
the logarithm of one on that of the other says by how many percent a stage takes longer where the
piece of work takes one percent longer.

A window alone is too noisy: what a probe finds in 2 s is off by more than CPUs change meanwhile, at
times by a multiple, and a slope on what is noisy comes out too flat. So a point is the medians of
five windows in a row, and the slope the median of those of all pairs, of all runs together (Theil
and Sen).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dwell.model.number_arrays import Floats
from dwell_lab.testbed.measured import Measured, SiteName, Visit
from dwell_lab.testbed.speeds import Usual, window_work_ms

#: Jobs that a window's mean needs; windows in a row that are one point; points that a slope needs.
LEAST_JOBS, TOGETHER, LEAST_POINTS = 10, 5, 8
#: How wide the 95 % interval of a slope may be: of nothing that changes, nothing follows.
WIDEST = 0.6
#: A stage that takes longer where a probe takes less has been measured badly.
LOWEST, HIGHEST = 0.0, 2.0


def usual_of(measured: Sequence[Measured]) -> Usual:
    """Return how fast the CPUs were in some runs, for the nodes of which every run knows it."""
    nodes = set.intersection(*(set(one.work_ms) for one in measured)) if measured else set()
    return Usual(
        {node: float(np.mean([one.work_ms[node] for one in measured])) for node in sorted(nodes)},
        sensitivities(measured),
    )


def sensitivities(measured: Sequence[Measured]) -> dict[SiteName, float]:
    """Return exponents by task and node, where nodes that nothing disturbs show them."""
    from scipy.stats import theilslopes

    points: dict[SiteName, list[tuple[Floats, Floats]]] = {}
    for one in measured:
        probed = window_work_ms(one.run)
        for site, visit in one.visits.items():
            node = site[1]
            if node in probed and node not in one.disturbed.nodes:
                points.setdefault(site, []).append(_points(visit, probed[node]))
    found = {}
    for site, of in sorted(points.items()):
        probe, stage = (np.concatenate(side) for side in zip(*of, strict=True))
        if len(probe) < LEAST_POINTS:
            continue
        slope, _, low, high = theilslopes(stage, probe)
        if high - low <= WIDEST:
            found[site] = min(max(float(slope), LOWEST), HIGHEST)
    return found


def _points(visit: Visit, probed: dict[int, float]) -> tuple[Floats, Floats]:
    """Logarithms of the times of a probe's work and of a stage: medians of a few windows each."""
    numbers, place, jobs = np.unique(visit.windows, return_inverse=True, return_counts=True)
    stage_ms = np.bincount(place, visit.stage_ms) / jobs
    kept = [
        i
        for i, number in enumerate(numbers.tolist())
        if jobs[i] >= LEAST_JOBS and number in probed and stage_ms[i] > 0
    ]
    kept = kept[: len(kept) - len(kept) % TOGETHER]
    probe = np.log([probed[int(numbers[i])] for i in kept])
    pair = (probe, np.log(stage_ms[kept]))
    points = [np.median(np.reshape(of, (-1, TOGETHER)), axis=1) for of in pair]
    return points[0], points[1]
