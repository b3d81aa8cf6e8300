"""Resampling of runs and blocks of windows, for intervals of measured figures.

Consecutive windows are not independent, nor are the windows of one run: the state of the machine
lasts longer. A resample draws runs with replacement, and within each run blocks of consecutive
windows (the moving block bootstrap [1], circular, which makes all windows equally likely [2]). With
few runs the first step alone would underestimate the differences between runs; the second adds the
variation within them. With one run only the second step remains.

1. H. R. Künsch, The jackknife and the bootstrap for general stationary observations, *Annals of
   Statistics* 17(3), 1989. DOI 10.1214/aos/1176347265.
2. D. N. Politis, J. P. Romano, A circular block-resampling procedure for stationary data, in
   *Exploring the Limits of Bootstrap*, Wiley, 1992.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dwell.model.number_arrays import Floats
from dwell.study.intervals import CONFIDENCE, RESAMPLING_SEED

#: With 999 resamples the quantiles of 2.5 % are order statistics.
DRAWS = 999


def block_windows(windows: int) -> int:
    """Return the windows of a block: the cube root of a run's windows, rounded up."""
    return max(1, math.ceil(math.cbrt(windows) - 1e-9))


def resample_windows(lengths: Sequence[int], *, seed: int = RESAMPLING_SEED) -> Floats:
    """How often each window is in each resample.

    Parameters
    ----------
    lengths : sequence of int
        Windows of every run, each at least 1.

    Returns
    -------
    float64 array, shape (DRAWS, windows of all runs)
        Whole numbers.
    """
    rng = np.random.default_rng(seed)
    begin = np.concatenate(([0], np.cumsum(lengths)))
    weights = np.zeros((DRAWS, int(begin[-1])))
    for draw in weights:
        for run in rng.integers(len(lengths), size=len(lengths)):
            count = lengths[run]
            size = block_windows(count)
            starts = rng.integers(count, size=-(-count // size))
            taken = (starts[:, None] + np.arange(size)).ravel()[:count] % count
            draw[begin[run] : begin[run + 1]] += np.bincount(taken, minlength=count)
    return weights


def resample_units(count: int, *, seed: int = RESAMPLING_SEED) -> Floats:
    """How often each of `count` independent units is in each resample, shape (DRAWS, count)."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(count, np.full(count, 1 / count), size=DRAWS).astype(np.float64)


def ends(resampled: Floats) -> tuple[float, float]:
    """Return the ends of the interval: order statistics, since values may be infinite.

    Parameters
    ----------
    resampled : float64 array, shape (DRAWS,)
        The figure in every resample; NaN at both ends if any is.
    """
    if np.isnan(resampled).any():
        return math.nan, math.nan
    rank = round((len(resampled) + 1) * (1 - CONFIDENCE) / 2)
    ordered = np.sort(resampled)
    return float(ordered[rank - 1]), float(ordered[-rank])
