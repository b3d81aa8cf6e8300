"""Differences between pairs: two policies, or two settings, on the same realisations.

Both numbers of a pair come from runs of the same seed; their difference cancels the randomness that
the runs share. The unit is the pair. A comparison gives the difference in its own unit with an
interval, and the difference relative to the spread over seeds (effect sizes). The p value of a
sign-flip test is the probability of such a difference, or a larger one, by chance.

`paired_difference` compares means. `paired_median` is for numbers that may be infinite, such as a
percentile of latencies with lost cycles. The metric decides which of the two is right, never the
values. If the two runs of every pair are identical, the result is `SameRun`: the difference is 0 by
construction and needs no test.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from dwell.errors import SimulationError
from dwell.model.number_arrays import Floats
from dwell.study.intervals import (
    RESAMPLING_SEED,
    Values,
    halves,
    mean_interval,
    median_interval,
    share_difference_interval,
)

#: Relative differences up to this size are rounding errors and count as 0.
ROUNDING = 1e-12
#: Largest number of pairs for which all 2^n flips are counted; above it, `FLIPS` are sampled.
EXACT_PAIRS = 30
FLIPS = 19_999


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Mean difference over pairs, first minus second.

    Parameters
    ----------
    mean, low, high : float
        Mean and the ends of its 95 % interval; the ends are NaN for a single pair.
    d_z : float
        Mean divided by the standard deviation of the differences, with Hedges' correction for few
        pairs. It grows with the correlation within pairs and is no measure of importance. Infinite
        if all differences are equal and not 0; NaN below three pairs.
    superiority : float
        Share of pairs in which the first is lower; ties count half. For costs, lower is better.
    p : float
        Two-sided p value of the sign-flip test, not adjusted for other comparisons (see
        `dwell.study.family`).
    n : int
        Number of pairs.
    """

    mean: float
    low: float
    high: float
    d_z: float
    superiority: float
    p: float
    n: int

    @property
    def direction(self) -> int:
        """-1 if the first is lower on average, 1 if it is higher, 0 if they are equal."""
        return _sign(self.mean)


@dataclass(frozen=True, slots=True)
class PairedMedian:
    """Median difference over pairs, first minus second; values may be infinite.

    Parameters
    ----------
    median, low, high : float
        Median and its 95 % interval between order statistics; the ends are NaN below six pairs.
    superiority : float
        Share of pairs in which the first is lower; ties count half.
    p : float
        Two-sided p value of the sign test.
    n : int
        Number of pairs.
    """

    median: float
    low: float
    high: float
    superiority: float
    p: float
    n: int

    @property
    def direction(self) -> int:
        """-1 if the first is lower in more pairs, 1 if it is higher in more pairs, else 0."""
        return _sign(0.5 - self.superiority)


@dataclass(frozen=True, slots=True)
class SameRun:
    """Result for two groups whose runs are identical for every seed.

    Parameters
    ----------
    n : int
        Number of pairs.
    word : str
        The verdict: `dwell.study.SAME_RUN`, or `dwell.study.SAME_CYCLES` if only the latencies are
        equal.
    """

    n: int
    word: str = "same run"


def paired_difference(
    first: Values,
    second: Values,
    *,
    shares: bool = False,
    windows: int | None = None,
    seed: int = RESAMPLING_SEED,
) -> PairedDifference:
    """Compare the means of two samples that are paired by seed.

    Parameters
    ----------
    first, second : sequence of float
        One per seed, in the same order, finite.
    shares : bool
        Whether the values are shares, in [0, 1].
    windows : int, optional
        Windows behind each sample of shares (see `share_interval`).
    seed : int
        Seed of the resamples and of the sampled flips.

    Returns
    -------
    PairedDifference
        With the interval of `share_difference_interval` for shares, else of `mean_interval`.

    Raises
    ------
    SimulationError
        If the samples are empty, differ in length, or hold a value that is not finite.
    """
    one, other = _pairs(first, second)
    for name, sample in (("first", one), ("second", other)):
        if not np.isfinite(sample).all():
            where = int(np.flatnonzero(~np.isfinite(sample))[0])
            raise SimulationError(
                f"{name}[{where}] is {sample[where]}, which has no mean; "
                "take paired_median for numbers that may be infinite"
            )
    differences = _differences(one, other)
    mean, low, high = (
        share_difference_interval(one, other, windows=windows, seed=seed)
        if shares
        else mean_interval(differences, seed=seed)
    )
    return PairedDifference(
        mean=mean,
        low=low,
        high=high,
        d_z=_standardised(differences),
        superiority=_superiority(differences),
        p=sign_flip_p(differences, seed=seed),
        n=len(differences),
    )


def paired_median(first: Values, second: Values) -> PairedMedian:
    """Compare two samples that are paired by seed and may be infinite.

    Parameters
    ----------
    first, second : sequence of float
        One per seed, in the same order; a pair of two infinities is a tie.

    Raises
    ------
    SimulationError
        If the samples are empty, differ in length, or hold a NaN.
    """
    differences = _differences(*_pairs(first, second))
    below, above = int((differences < 0).sum()), int((differences > 0).sum())
    median, low, high = median_interval(differences)
    return PairedMedian(
        median=median,
        low=low,
        high=high,
        superiority=_superiority(differences),
        p=min(2.0 * halves(below + above)[min(below, above)], 1.0),
        n=len(differences),
    )


def least_p(pairs: int) -> float:
    """Smallest p value of the sign-flip test and of the sign test with a number of pairs."""
    return min(1.0, 2.0 / 2.0**pairs)


def sign_flip_p(differences: Values, *, seed: int = RESAMPLING_SEED) -> float:
    """Two-sided p value of the sign-flip test of a mean of 0.

    If the two groups do not differ, both signs of a difference are equally likely. The p value is
    the share of all 2^n assignments of signs whose sum is at least as far from 0. Zeros do not
    change a sum. The smallest p value is 2 / 2^n: five pairs cannot show a difference at 5 %.

    Parameters
    ----------
    differences : sequence of float
        One per pair, finite.
    seed : int
        Seed of the flips that are sampled above `EXACT_PAIRS` pairs. Then p is (hits + 1) /
        (`FLIPS` + 1), which is never too small (Phipson & Smyth 2010, DOI 10.2202/1544-6115.1585).
    """
    sample = np.asarray(differences, np.float64)
    sizes = np.abs(sample[sample != 0])
    # Sums that are equal in exact arithmetic may differ by rounding.
    reach = abs(float(sample.sum())) - ROUNDING * float(sizes.sum())
    if reach <= 0:
        return 1.0
    if len(sizes) > EXACT_PAIRS:
        flips = np.random.default_rng(seed).integers(0, 2, size=(FLIPS, len(sizes)))
        sums = (2.0 * flips - 1.0) @ sizes
        return float(((np.abs(sums) >= reach).sum() + 1) / (FLIPS + 1))
    # Each sum adds a sum of the first half and a sum of the second: 2 · 2^(n/2) numbers, not 2^n.
    half = len(sizes) // 2
    left, right = _signed_sums(sizes[:half]), np.sort(_signed_sums(sizes[half:]))
    hits = len(left) * len(right) - int(np.searchsorted(right, reach - left).sum())
    return 2 * hits / 2.0 ** len(sizes)


def _signed_sums(sizes: Floats) -> Floats:
    """Return the sums of all 2^n assignments of signs."""
    sums = np.zeros(1)
    for size in sizes:
        sums = np.concatenate([sums - size, sums + size])
    return sums


def _pairs(first: Values, second: Values) -> tuple[Floats, Floats]:
    """Return both samples as arrays; refuse different lengths, empty samples and NaN."""
    one, other = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if one.shape != other.shape or one.ndim != 1 or not one.size:
        raise SimulationError(
            f"pairs need two rows of the same length, at least 1; first has shape {one.shape}, "
            f"second {other.shape}"
        )
    for name, sample in (("first", one), ("second", other)):
        if np.isnan(sample).any():
            where = int(np.flatnonzero(np.isnan(sample))[0])
            raise SimulationError(f"{name}[{where}] is NaN; leave the seed out of both")
    return one, other


def _differences(one: Floats, other: Floats) -> Floats:
    """Return first minus second; differences within rounding are exactly 0 or exactly equal."""
    differences = np.zeros(len(one))
    # Two infinities are equal, and their difference stays 0.
    np.subtract(one, other, out=differences, where=one != other)
    values = np.concatenate([one, other])
    finite = values[np.isfinite(values)]
    least = ROUNDING * float(np.abs(finite).max(initial=0.0))
    differences[np.abs(differences) <= least] = 0.0
    if np.isfinite(differences).all() and np.ptp(differences) <= least:
        differences[:] = differences[0]
    return differences


def _standardised(differences: Floats) -> float:
    """Return d_z, corrected for its bias at n - 1 degrees of freedom.

    Hedges 1981, DOI 10.3102/10769986006002107.
    """
    count, mean = len(differences), float(differences.mean())
    if count < 3:
        return math.nan
    if (differences == differences[0]).all():
        return math.copysign(math.inf, mean) if mean else 0.0
    free = count - 1
    ratio = math.exp(math.lgamma(free / 2) - math.lgamma((free - 1) / 2))
    return mean / float(differences.std(ddof=1)) * ratio * math.sqrt(2 / free)


def _superiority(differences: Floats) -> float:
    return float(((differences < 0) + 0.5 * (differences == 0)).mean())


def _sign(value: float) -> int:
    return (value > 0) - (value < 0)
