"""Differences between pairs: two policies, or two settings, on the same realisations.

Both numbers of a pair come from runs of the same seed, so that their difference is free of what
luck gave to both. The unit is the pair. Of every difference there are three things to say: how
large it is in its own unit, with an interval; how large it is beside what differs from seed to seed
(effect sizes); and whether luck alone could have made it (the p value of a sign-flip test).

`paired_difference` is about the mean. `paired_median` is for numbers that may be infinite, such as
a percentile of latencies where cycles are lost; which of the two is right depends on the metric,
never on the values that came out. Where both of every pair are the same run there is nothing to
compare: their difference is 0 by what was played, and not by luck (`SameRun`).
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

#: Differences below this part of the values are what rounding left of equal ones.
ROUNDING = 1e-12
#: Up to so many pairs all 2^n flips are counted; beyond, `FLIPS` of them are drawn.
EXACT_PAIRS = 30
FLIPS = 19_999


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """The mean of the first less the second, over pairs.

    Parameters
    ----------
    mean, low, high : float
        With the ends of its 95 % interval; NaN for a single pair.
    d_z : float
        Mean over standard deviation of the differences, with the correction of Hedges for few
        pairs. It grows with what the pairs have in common and is no measure of importance. Infinite
        where all differences are the same and not 0, NaN below three pairs.
    superiority : float
        Share of pairs in which the first is lower, ties counting half. For costs, lower is better.
    p : float
        Two-sided, of the sign-flip test; for this comparison alone (see `dwell.study.family`).
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
        """-1 where the first is lower, 1 where it is higher, 0 where they are equal."""
        return _sign(self.mean)


@dataclass(frozen=True, slots=True)
class PairedMedian:
    """The median of the first less the second, over pairs that may be infinite.

    Parameters
    ----------
    median, low, high : float
        With its 95 % interval between order statistics; NaN at the ends below six pairs.
    superiority : float
        Share of pairs in which the first is lower, ties counting half.
    p : float
        Two-sided, of the sign test.
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
        """-1 where the first is lower in most pairs, 1 where it is higher, 0 where in neither."""
        return _sign(0.5 - self.superiority)


@dataclass(frozen=True, slots=True)
class SameRun:
    """Two that played every cycle alike under every seed: one run, and no comparison.

    Parameters
    ----------
    n : int
        Number of pairs.
    word : str
        The verdict: whether only the latencies are equal, or the loads, too.
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
        One a seed, in the same order, finite.
    shares : bool
        Whether they are shares, in [0, 1].
    windows : int, optional
        Windows behind each of the samples, where they are shares (see `share_interval`).
    seed : int
        Seed of resamples and of drawn flips: the same samples always give the same numbers.

    Returns
    -------
    PairedDifference
        The interval is `mean_interval`'s, by the studentised bootstrap, of shares
        `share_difference_interval`'s.

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
        One a seed, in the same order; two infinities of a pair are a tie.

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
    """Smallest p value that so many pairs can have, by the sign-flip test and the sign test."""
    return min(1.0, 2.0 / 2.0**pairs)


def sign_flip_p(differences: Values, *, seed: int = RESAMPLING_SEED) -> float:
    """Two-sided p value of the sign-flip test of a mean of 0.

    If neither of a pair is better, each difference could as well have had the other sign: the p
    value is the share of all 2^n assignments of signs whose sum is at least as far from 0. Zeros
    change no sum. The least p value is 2 / 2^n: five pairs cannot show anything at 5 %.

    Parameters
    ----------
    differences : sequence of float
        One a pair, finite.
    seed : int
        Seed of the flips that are drawn above `EXACT_PAIRS` pairs. Then p is (hits + 1) /
        (`FLIPS` + 1), which is never too small (Phipson & Smyth 2010, DOI 10.2202/1544-6115.1585).
    """
    sample = np.asarray(differences, np.float64)
    sizes = np.abs(sample[sample != 0])
    # Sums that are equal on paper may differ by rounding.
    reach = abs(float(sample.sum())) - ROUNDING * float(sizes.sum())
    if reach <= 0:
        return 1.0
    if len(sizes) > EXACT_PAIRS:
        flips = np.random.default_rng(seed).integers(0, 2, size=(FLIPS, len(sizes)))
        sums = (2.0 * flips - 1.0) @ sizes
        return float(((np.abs(sums) >= reach).sum() + 1) / (FLIPS + 1))
    # Every sum is one of the first half's plus one of the second's: 2 · 2^(n/2) numbers, not 2^n.
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
    """Check what any comparison of pairs needs."""
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
    """First less second; exactly 0, and exactly the same, where they are so but for rounding."""
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
    """d_z, without its bias at n - 1 degrees of freedom.

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
