"""Sensitivity: the effect of the CPU's speed on a stage, relative to a probe's piece of work.

Other processes slow a CPU down when they use shared resources (the second thread of a core, caches,
memory). The factor differs for every piece of code: a sum may take twice as long, image processing
three times. The times of the probe and of a stage change together from minute to minute. The slope
of their logarithms is the percentage by which a stage takes longer when the piece of work takes one
percent longer.

A single window is too noisy: the error of a probe over 2 s exceeds the changes of the CPU's speed,
and noise in the probe biases the slope towards zero. A point therefore contains the medians of five
consecutive windows, and the slope is the median slope of all pairs of points of all runs (Theil and
Sen).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dwell.model.number_arrays import Floats
from dwell_lab.testbed.measured import Measured, SiteName, Visit
from dwell_lab.testbed.speeds import Usual, window_work_ms

#: Fewest jobs for a window's mean; consecutive windows per point; fewest points for a slope.
LEAST_JOBS, TOGETHER, LEAST_POINTS = 10, 5, 8
#: Largest width of a slope's 95 % interval; it is wider if the speed hardly changes.
WIDEST = 0.6
#: Bounds of an exponent: a negative slope is a measurement error.
LOWEST, HIGHEST = 0.0, 2.0


def usual_of(measured: Sequence[Measured]) -> Usual:
    """Return the mean CPU speeds of some runs, for the nodes that are measured in every run."""
    nodes = set.intersection(*(set(one.work_ms) for one in measured)) if measured else set()
    return Usual(
        {node: float(np.mean([one.work_ms[node] for one in measured])) for node in sorted(nodes)},
        sensitivities(measured),
    )


def sensitivities(measured: Sequence[Measured]) -> dict[SiteName, float]:
    """Return the exponents by task and node that undisturbed nodes show with enough precision."""
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
    """Return log times of the probe's work and of a stage; one median per `TOGETHER` windows."""
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
