"""Intervals over seeds.

The unit is the seed: one run gives one number, and runs of different seeds are independent. Three
kinds of number need three kinds of interval:

* a mean: the studentised bootstrap (see `studentised_limits`);
* a mean of shares: the studentised bootstrap, widened for events that no run showed. The number of
  windows limits these events (see `share_interval`); if it is unknown, the interval is valid for
  every distribution on [0, 1];
* a median of values that may be infinite: order statistics, by the binomial distribution. The
  interval assumes nothing about the shape, and never interpolates.

Rates of misses are skewed and seeds are few. Student's t then gives upper limits that are too low
(docs/background/statistics.md has the rules). It replaces the bootstrap only when the
bootstrap gives no limit: below `FEWEST` values, or when almost all values are equal.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from dwell.model.number_arrays import Floats
from dwell.model.table_columns import ENDS

Values: TypeAlias = Sequence[float] | Floats
Verdict: TypeAlias = Literal["under", "over", "not shown"]

CONFIDENCE = 0.95

#: Fewest values for the bootstrap: 3 values have 27 resamples, of which 1 in 9 has no spread.
FEWEST = 4
#: Largest distance of a limit from the mean, in half-widths of Student's interval. Resamples of
#: few, nearly equal values have hardly any spread: their limits can be 100 half-widths away.
FARTHEST = 3.0
#: With 4,999 resamples the quantiles of 2.5 % and of 5 % are order statistics.
RESAMPLES = 4999
#: A fixed seed: the same runs always have the same interval.
RESAMPLING_SEED = 1


class Interval(NamedTuple):
    """A number over seeds and the ends of its interval, NaN if unknown."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether the ends are known (a single seed has no interval)."""
        return not math.isnan(self.low)

    def columns(self, name: str) -> dict[str, float]:
        """Return the interval as columns of a table: ``name``, ``name_low`` and ``name_high``."""
        ends = (f"{name}{end}" for end in ENDS)
        return dict(zip(ends, (self.value, self.low, self.high), strict=True))


def mean_interval(values: Values, *, seed: int = RESAMPLING_SEED) -> Interval:
    """Mean with its two-sided interval by the studentised bootstrap.

    Parameters
    ----------
    values : sequence of float
        One per seed, at least one.

    Returns
    -------
    Interval
        Student's t replaces an end for which the bootstrap has no limit (see `studentised_limits`).
        No end is farther from the mean than `FARTHEST` times Student's half-width. The width is 0
        if all values are equal. The ends are NaN for a single value, or if a value is not finite.
    """
    sample = np.asarray(values, np.float64)
    mean = float(sample.mean())
    if len(sample) < 2 or not np.isfinite(sample).all():
        return Interval(mean, math.nan, math.nan)
    tail = (1 - CONFIDENCE) / 2
    low, high = studentised_limits(sample, tail, seed=seed)
    half = _half_width(sample, tail)
    low = mean - half if math.isinf(low) else max(low, mean - FARTHEST * half)
    high = mean + half if math.isinf(high) else min(high, mean + FARTHEST * half)
    return Interval(mean, min(low, mean), max(high, mean))


def share_interval(values: Values, *, windows: int | None = None) -> Interval:
    """Mean of shares with its two-sided interval, inside [0, 1].

    The studentised bootstrap covers the spread between runs. It does not cover events that no run
    showed; the number of windows limits these. A kind of window with probability p is absent from
    N windows with probability (1 - p)^N, which equals the tail at p = 1 - tail^(1/N), about
    3.7/N. At worst all cycles of such a window miss. The upper limit is therefore at least
    (1 - p) · mean + p and the lower limit at most (1 - p) · mean. The argument assumes that
    every kind of window occurs in the windows of any run independently. It does not cover a kind of
    window that fills one run in ten and never occurs in the other runs.

    Parameters
    ----------
    values : sequence of float
        One per seed, in [0, 1], at least one.
    windows : int, optional
        N, windows behind the values, over all runs. If None, the limits are valid for every
        distribution on [0, 1]: with confidence 1 - tail, a further run exceeds the largest of n
        values with probability at most p = 1 - tail^(1/n) (Wilks 1941, DOI
        10.1214/aoms/1177731788), and its value is then at most 1; the lower limit is symmetric.

    Returns
    -------
    Interval
        NaN at the ends for a single value.
    """
    sample = np.asarray(values, np.float64)
    mean = float(sample.mean())
    if len(sample) == 1:
        return Interval(mean, math.nan, math.nan)
    return Interval(mean, *_share_limits(sample, (1 - CONFIDENCE) / 2, windows))


def share_difference_interval(
    first: Values, second: Values, *, windows: int | None = None, seed: int = RESAMPLING_SEED
) -> Interval:
    """Mean difference of paired shares, first minus second, with its two-sided interval.

    The interval is inside [-1, 1] and includes the uncertainty of either sample. If a sample has
    the same value in (nearly) all runs, the bootstrap gives no limit for it on one side. Events
    that the n runs did not show are absent from the differences, too, however much the other sample
    adds to their spread.

    Parameters
    ----------
    first, second : sequence of float
        One per seed, in the same order, in [0, 1], at least one.
    windows : int, optional
        Windows behind each sample (see `share_interval`).

    Returns
    -------
    Interval
        Limits from the studentised bootstrap of the differences. If the bootstrap has no limit for
        a sample on a side, the distance from that sample's mean to its limit of `share_interval` is
        added. The limits valid for every distribution on [-1, 1] replace wider ones. If all
        differences are equal, the interval is their value, widened for events that no window
        showed. The ends are NaN for a single pair.
    """
    one, other = np.asarray(first, np.float64), np.asarray(second, np.float64)
    differences = one - other
    count, mean = len(differences), float(differences.mean())
    if count < 2:
        return Interval(mean, math.nan, math.nan)
    tail = (1 - CONFIDENCE) / 2
    if _same(differences):
        p = _unseen(count if windows is None else windows, tail)
        low, high = least, most = mean * (1 - p) - p, mean * (1 - p) + p
    else:
        p = _unseen(count, tail)
        low, high = studentised_limits(differences, tail, seed=seed)
        if windows is not None:
            low, high = _by_student(differences, tail, low, high)
        least = float(differences.min()) * (1 - p) - p
        most = float(differences.max()) * (1 - p) + p
    below, above = _open_sides(one, windows)
    other_below, other_above = _open_sides(other, windows)
    low = max(low - below - other_above, least, -1.0)
    high = min(high + above + other_below, most, 1.0)
    return Interval(mean, min(low, mean), max(high, mean))


def share_limits(values: Values, *, windows: int | None = None) -> tuple[float, float]:
    """One-sided limits of a mean of shares, lower and upper.

    Each limit has the confidence `CONFIDENCE` on its own. The lower limit is the one-sided version
    of `share_interval`'s. The upper limit is from `_limit_by_weights`, raised for events that no
    window showed (see `share_interval`). It never rises when a value falls or a run of 0 is added;
    a limit computed from the spread of the values can.

    Parameters
    ----------
    values : sequence of float
        One per seed, in [0, 1], at least one.
    windows : int, optional
        Windows behind the values, over all runs. If None, the limits are valid for every
        distribution on [0, 1].

    Returns
    -------
    at_least, at_most : float
        0 and 1 for a single value.
    """
    sample, tail = np.asarray(values, np.float64), 1 - CONFIDENCE
    if len(sample) == 1:
        return 0.0, 1.0
    at_least, at_most = _share_limits(sample, tail, windows)
    if windows is None:
        return at_least, at_most
    unseen = _unseen(windows, tail)
    shown = _limit_by_weights(tuple(sample.tolist()), tail)
    return at_least, max(shown, float(sample.mean()) * (1 - unseen) + unseen)


def under(values: Values, limit: float = 0.05, *, windows: int | None = None) -> Verdict:
    """Verdict on a mean of shares and a limit, by the one-sided limits of the mean.

    The unit is the seed, and within a seed the window, because misses occur in bursts: a
    disturbance or a bad hour of a trace may be the only independent event in 10,000 cycles. Fewer
    misses in a run, or one more run without misses, never revoke the verdict "under".

    Parameters
    ----------
    values : sequence of float
        One per seed (for a trace, one per run), in [0, 1], at least one.
    windows : int, optional
        Windows behind the values, over all runs. Without this number, the verdict "under" 5 % needs
        at least 59 runs, all with the value 0.

    Returns
    -------
    {"under", "over", "not shown"}
        Under: the upper limit of `share_limits` is below `limit`. Over: the lower limit exceeds it.
    """
    at_least, at_most = share_limits(values, windows=windows)
    return "under" if at_most < limit else "over" if at_least > limit else "not shown"


def rule_of_three(runs: int) -> float:
    """Upper limit of a mean of shares that was 0 in each of n independent runs.

    If a run has a positive share with probability p, n runs all have 0 with probability (1 - p)^n.
    This probability is 5 % at p = 1 - 0.05^(1/n), about 3/n. The share in a run is at most 1, so
    its mean is at most p. A smaller limit needs a further assumption.

    Parameters
    ----------
    runs : int
        n, at least 1.
    """
    return _unseen(runs, 1 - CONFIDENCE)


def median_interval(values: Values) -> Interval:
    """Median with an interval between order statistics; values may be infinite.

    Parameters
    ----------
    values : sequence of float
        One per seed, at least one, none NaN.

    Returns
    -------
    Interval
        The value is the ceil(n/2)-th smallest. The ends are the r-th smallest and r-th largest, for
        the largest r whose coverage reaches `CONFIDENCE`; NaN below 6 values.
    """
    sample = np.sort(np.asarray(values, np.float64))
    count = len(sample)
    median = float(sample[(count + 1) // 2 - 1])
    # The largest r such that fewer than r of n values are below the median with a probability of at
    # most (1 - CONFIDENCE) / 2.
    rank = bisect_left(halves(count), (1 - CONFIDENCE) / 2)
    if rank < 1:
        return Interval(median, math.nan, math.nan)
    return Interval(median, float(sample[rank - 1]), float(sample[count - rank]))


def studentised_limits(
    values: Values, tail: float, *, seed: int = RESAMPLING_SEED
) -> tuple[float, float]:
    """Limits of a mean by the studentised bootstrap (bootstrap-t).

    The distribution of t = (mean - μ) / (s / √n) is estimated from resamples, t* = (mean* - mean) /
    (s* / √n). The error of its one-sided coverage is O(1/n); for skewed values the error of
    Student's t and of the percentile bootstrap is O(1/√n) (Hall 1988, DOI
    10.1214/aos/1176350933).

    If all values of a resample are equal, its t* is infinite, unless they equal the mean. If more
    than the share `tail` of the resamples has an infinite t* on one side, the limit on the other
    side is infinite: too few different values were seen to limit the rare ones. (Omitting such
    resamples would omit exactly the uncertain cases.)

    Parameters
    ----------
    values : sequence of float
        One per seed, finite, at least one.
    tail : float
        Probability with which each limit may be wrong: 0.025 or 0.05.

    Returns
    -------
    low, high : float
        Infinite if unknown, for example below `FEWEST` values. Both equal the mean if all values
        are equal.
    """
    sample = np.asarray(values, np.float64)
    count, mean = len(sample), float(sample.mean())
    error = 0.0 if _same(sample) else float(sample.std(ddof=1)) / math.sqrt(count)
    if count > 1 and error == 0.0:
        return mean, mean
    if count < FEWEST:
        return -math.inf, math.inf
    below, above = _studentised(tuple(sample.tolist()), tail, seed)
    return mean - above * error, mean - below * error


# Cached: a report uses the same interval in a table, a figure and a sentence.
@lru_cache(maxsize=4096)
def _studentised(values: tuple[float, ...], tail: float, seed: int) -> tuple[float, float]:
    """Quantiles `tail` and 1 - `tail` of t*, over resamples of the values."""
    sample = np.array(values)
    centred = sample - sample.mean()
    # Rounding errors are below this: a value equal to the mean counts as 0, equal values as equal.
    least = 1e-9 * centred.std()
    centred[np.abs(centred) < least] = 0.0
    root = math.sqrt(len(values))

    rng = np.random.default_rng(seed)
    resamples = centred[rng.integers(len(values), size=(RESAMPLES, len(values)))]
    error = resamples.std(axis=1, ddof=1) / root
    # Arctangents of t*: they have the same order and are always finite.
    angles = np.sort(np.arctan2(resamples.mean(axis=1), np.where(error > least, error, 0.0)))
    rank = round((RESAMPLES + 1) * tail)
    return _tangent(float(angles[rank - 1])), _tangent(float(angles[-rank]))


def _tangent(angle: float) -> float:
    return math.copysign(math.inf, angle) if abs(angle) >= math.pi / 2 else math.tan(angle)


def _share_limits(sample: Floats, tail: float, windows: int | None) -> tuple[float, float]:
    """Limits of a mean of shares, each wrong with probability `tail` (see `share_interval`)."""
    if windows is None:
        p = _unseen(len(sample), tail)
        return float(sample.min()) * (1 - p), float(sample.max()) * (1 - p) + p
    p, mean = _unseen(windows, tail), float(sample.mean())
    low, high = studentised_limits(sample, tail)
    if math.isinf(low):
        low = 1.0 - _limit_by_weights(tuple((1.0 - sample).tolist()), tail)
    if math.isinf(high):
        high = _limit_by_weights(tuple(sample.tolist()), tail)
    return max(min(low, mean * (1 - p)), 0.0), min(max(high, mean * (1 - p) + p), 1.0)


@lru_cache(maxsize=4096)
def _limit_by_weights(values: tuple[float, ...], tail: float) -> float:
    """Upper limit of a mean of shares that never rises when a share falls.

    The limit is the quantile 1 - `tail` of weighted means of the values and an endpoint, with
    random weights from a flat Dirichlet distribution (the Bayesian bootstrap, Rubin 1981, DOI
    10.1214/aos/1176345338). The endpoint is (1 + 1/n) times the largest of the n values, at most 1.
    With 1 as the endpoint this would be Gaffke's limit; no distribution is known to violate it.
    Each sample of weights gives the k-th largest value the same weight before normalisation, so no
    mean rises when a value falls or a 0 is added.
    """
    count = len(values)
    descending = np.sort(np.array(values))[::-1]
    end = min((1 + 1 / count) * descending[0], 1.0)
    rng = np.random.default_rng(RESAMPLING_SEED)
    weights = rng.exponential(size=(count + 1, RESAMPLES))
    means = (np.append(end, descending) @ weights) / weights.sum(axis=0)
    rank = RESAMPLES - round((RESAMPLES + 1) * tail)
    return float(np.partition(means, rank)[rank])


def _by_student(sample: Floats, tail: float, low: float, high: float) -> tuple[float, float]:
    """Limits of a mean; Student's replace infinite limits."""
    if not (math.isinf(low) or math.isinf(high)):
        return low, high
    mean, half = float(sample.mean()), _half_width(sample, tail)
    return mean - half if math.isinf(low) else low, mean + half if math.isinf(high) else high


def _open_sides(sample: Floats, windows: int | None) -> tuple[float, float]:
    """Distances from a mean to its share limits, on sides without a bootstrap limit; else 0."""
    mean, low, high = share_interval(sample, windows=windows)
    if _same(sample):
        return mean - low, high - mean
    least, most = studentised_limits(sample, (1 - CONFIDENCE) / 2)
    return (
        mean - low if math.isinf(least) else 0.0,
        high - mean if math.isinf(most) else 0.0,
    )


def _unseen(runs: int, tail: float) -> float:
    """Largest probability of an event absent from n runs, with confidence 1 - `tail`."""
    return float(1.0 - tail ** (1.0 / runs))


def _half_width(sample: Floats, tail: float) -> float:
    """Student's t quantile times the standard error of the mean; for at least two values."""
    count = len(sample)
    return student_quantile(count - 1, tail) * float(sample.std(ddof=1)) / math.sqrt(count)


@lru_cache(maxsize=4096)
def student_quantile(free: int, tail: float) -> float:
    """Student's t that is exceeded with probability `tail`, for integer degrees of freedom.

    With t = √free tan θ, the probability of |T| < t is a finite sum in sin θ and cos θ (Abramowitz
    and Stegun, Handbook of Mathematical Functions, 26.7.3 and 26.7.4).
    """

    def within(angle: float) -> float:
        sine, cosine, total = math.sin(angle), math.cos(angle), float(free > 1)
        for k in range(free - 3, 0, -2):
            total = 1 + k / (k + 1) * cosine * cosine * total
        return 2 / math.pi * (angle + sine * cosine * total) if free % 2 else sine * total

    low, high = 0.0, math.pi / 2
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if within(middle) < 1 - 2 * tail else (low, middle)
    return math.sqrt(free) * math.tan(low)


@lru_cache(maxsize=4096)
def halves(count: int) -> tuple[float, ...]:
    """Probabilities that at most 0, 1, 2, ... of `count` coin tosses are heads."""
    ways = accumulate(range(count), lambda of, k: of * (count - k) // (k + 1), initial=1)
    return tuple(below / 2**count for below in accumulate(ways))


def _same(sample: Floats) -> bool:
    """Whether all values are equal; their computed spread may differ from 0 by rounding."""
    return bool((sample == sample[0]).all())
