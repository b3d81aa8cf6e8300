"""Intervals over seeds.

The unit is the seed: one run gives one number, and runs of different seeds are independent. Three
kinds of number need three kinds of interval:

* a mean: the studentised bootstrap (see `studentised_limits`);
* a mean of shares: what the runs showed, by the same, and what they did not show, by the number of
  their windows (see `share_interval`); without that number, by what every distribution on [0, 1]
  allows (see `rule_of_three`);
* a median, where infinity can occur: order statistics, by the binomial distribution. It assumes
  nothing about the shape, and it never interpolates.

Rates of misses are skewed and seeds are few: Student's t is then wrong on the side that matters,
its upper limits are too low (docs/decisions/0005-statistics.md has the numbers). It is left where
the bootstrap has nothing to say: below `FEWEST` values, and where almost all are the same.
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

#: Values below which there is no bootstrap: 3 have 27 resamples, and 1 in 9 is without spread.
FEWEST = 4
#: How many times as far from a mean as Student's t its limits lie at most. Few values of which most
#: nearly agree have resamples of hardly any spread, and limits a hundred times as far.
FARTHEST = 3.0
#: So many that the quantiles of 2.5 % and of 5 % are order statistics of the resamples.
RESAMPLES = 4999
#: Of every resampling, so that the same runs always have the same interval.
RESAMPLING_SEED = 1


class Interval(NamedTuple):
    """A number over seeds and the interval around it; NaN at the ends where there is none."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether there is an interval at all (one seed gives none)."""
        return not math.isnan(self.low)

    def columns(self, name: str) -> dict[str, float]:
        """Return it as columns of a table: ``name``, ``name_low`` and ``name_high``."""
        ends = (f"{name}{end}" for end in ENDS)
        return dict(zip(ends, (self.value, self.low, self.high), strict=True))


def mean_interval(values: Values, *, seed: int = RESAMPLING_SEED) -> Interval:
    """Mean with its two-sided interval by the studentised bootstrap.

    Parameters
    ----------
    values : sequence of float
        One a seed, finite, at least one.

    Returns
    -------
    Interval
        An end for which the bootstrap has no limit is that of Student's t (see
        `studentised_limits`), and none lies farther than `FARTHEST` times that. No width where all
        values are the same, NaN at the ends for a single one and where one is not finite.
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

    Runs spread, and that is in the studentised bootstrap. What no run showed is not, and is limited
    by the windows: a kind of window that comes with probability p is in none of N with (1 - p)^N,
    which is the tail at p = 1 - tail^(1/N), about 3/N; at worst all of its cycles miss. So the
    upper limit is no less than (1 - p) · mean + p, the lower one no more than (1 - p) · mean. The
    assumption is that a kind of window that may come at all comes in windows of any run
    independently; of a kind that fills one run in ten and no window of the others N says nothing.

    Parameters
    ----------
    values : sequence of float
        One a seed, in [0, 1], at least one.
    windows : int, optional
        N, windows behind the values, all runs together. Where None, the limits are those that every
        distribution on [0, 1] allows: with confidence 1 - tail a further run lies above the largest
        of n with a probability of at most p = 1 - tail^(1/n) (Wilks 1941, DOI
        10.1214/aoms/1177731788), and then it shows at most 1; below the smallest likewise.

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
    """Mean of the first shares less the second, over pairs, with its two-sided interval.

    It is inside [-1, 1], and no narrower than what its parts leave open. Where one of them showed
    the same in (nearly) all runs, the bootstrap has no limit for it on a side: what n runs did not
    show of it is not in the differences either, whatever the other part adds to their spread.

    Parameters
    ----------
    first, second : sequence of float
        One a seed, in the same order, in [0, 1], at least one.
    windows : int, optional
        Windows behind each of them (see `share_interval`).

    Returns
    -------
    Interval
        By the studentised bootstrap of the differences, each end farther away by what is open of
        the parts there (the distance from a part's mean to its limit of `share_interval`, on a side
        on which the bootstrap has none); or what every distribution on [-1, 1] allows, whichever is
        narrower. Where all differences are the same: they, and what no window showed. NaN at the
        ends for a single pair.
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
    """One-sided limits of a mean of shares: it is above the first, it is below the second.

    Each is right with the confidence of `CONFIDENCE` on its own. The lower one is that of
    `share_interval`, one-sided. The upper one never rises where a value falls, or where a run of 0
    is added, as a limit by the spread of the values does: it is that of `_limit_by_weights`, and no
    less than what no window showed (see `share_interval`).

    Parameters
    ----------
    values : sequence of float
        One a seed, in [0, 1], at least one.
    windows : int, optional
        Windows behind the values, all runs together. Where None, what every distribution on [0, 1]
        allows: nothing but the number of runs is known.

    Returns
    -------
    at_least, at_most : float
        0 and 1 for a single value, which limits nothing.
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
    """Whether a mean of shares is shown to be under a limit, by its one-sided limits.

    The unit is the seed, and within it the window, not the cycle. Misses come in bursts, from a
    disturbance or a bad hour of a trace: 10,000 cycles of one run may hold one independent event.
    Fewer misses in any run, or one more run without any, never take the word "under" away.

    Parameters
    ----------
    values : sequence of float
        One a seed (of a trace: one a run), in [0, 1], at least one.
    windows : int, optional
        Windows behind the values, all runs together. Without it 59 runs that all show 0 are the
        fewest that are "under" 5 %.

    Returns
    -------
    {"under", "over", "not shown"}
        Under: the upper limit of `share_limits` is below `limit`. Over: the lower one is above it.
    """
    at_least, at_most = share_limits(values, windows=windows)
    return "under" if at_most < limit else "over" if at_least > limit else "not shown"


def rule_of_three(runs: int) -> float:
    """Upper limit of a mean of shares that was 0 in every one of n independent runs.

    If a run shows anything at all with probability p, then n runs show nothing with probability
    (1 - p)^n; at p = 1 - 0.05^(1/n), about 3/n, that is 5 %. The share in a run is at most 1, so
    its mean is at most p. Without a further assumption no smaller limit is sound.

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
        One a seed, at least one, none NaN.

    Returns
    -------
    Interval
        The ceil(n/2)-th smallest; the ends are the r-th smallest and r-th largest for the largest
        r whose coverage reaches `CONFIDENCE`. NaN at the ends below 6 values, where none does.
    """
    sample = np.sort(np.asarray(values, np.float64))
    count = len(sample)
    median = float(sample[(count + 1) // 2 - 1])
    # The largest r such that fewer than r of n values fall below the median with a probability of
    # at most half of what is left over.
    rank = bisect_left(halves(count), (1 - CONFIDENCE) / 2)
    if rank < 1:
        return Interval(median, math.nan, math.nan)
    return Interval(median, float(sample[rank - 1]), float(sample[count - rank]))


def studentised_limits(
    values: Values, tail: float, *, seed: int = RESAMPLING_SEED
) -> tuple[float, float]:
    """Limits of a mean by the studentised bootstrap (bootstrap-t).

    The distribution of t = (mean - μ) / (s / √n) is taken from resamples, t* = (mean* - mean) /
    (s* / √n), in place of Student's. Its coverage is wrong by O(1/n) on either side, that of
    Student's t and of the percentile bootstrap by O(1/√n) where the values are skewed (Hall 1988,
    DOI 10.1214/aos/1176350933).

    A resample of one value only has no spread: its t* is infinite, unless that value is the mean.
    Where more of them than `tail` lie on one side there is no limit on the other: too few
    different values were seen to tell how far the rare ones go. (Leaving such resamples out would
    take exactly the uncertain ones for certain.)

    Parameters
    ----------
    values : sequence of float
        One a seed, finite, at least one.
    tail : float
        Probability with which each limit may be wrong: 0.025 or 0.05.

    Returns
    -------
    low, high : float
        Infinite where there is none, as below `FEWEST` values; both the mean where all values are
        the same.
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


# A report asks for the same interval in a table, a figure and a sentence.
@lru_cache(maxsize=4096)
def _studentised(values: tuple[float, ...], tail: float, seed: int) -> tuple[float, float]:
    """Quantiles `tail` and 1 - `tail` of t*, over resamples of the values."""
    sample = np.array(values)
    centred = sample - sample.mean()
    # What rounding leaves: of a value that is the mean, and of the spread of equal values.
    least = 1e-9 * centred.std()
    centred[np.abs(centred) < least] = 0.0
    root = math.sqrt(len(values))

    rng = np.random.default_rng(seed)
    resamples = centred[rng.integers(len(values), size=(RESAMPLES, len(values)))]
    error = resamples.std(axis=1, ddof=1) / root
    # Arctangents of t*: in the same order, and finite where t* is not.
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
    """Upper limit of a mean of shares that does not rise where one of them falls.

    Means over the values and one more, each with random weights (of a flat Dirichlet distribution:
    the Bayesian bootstrap, Rubin 1981, DOI 10.1214/aos/1176345338): the limit is what 1 - `tail` of
    them do not exceed. The one more is the end of the range that n values show, (1 + 1/n) times the
    largest. Were it the end of all that may come, this would be Gaffke's limit, which no
    distribution is known to break. Any draw gives the k-th largest value the same weight before it
    is divided by their sum, so that no draw rises where a value falls, or where a 0 is added.
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
    """Limits of a mean with Student's in place of those that the bootstrap has not."""
    if not (math.isinf(low) or math.isinf(high)):
        return low, high
    mean, half = float(sample.mean()), _half_width(sample, tail)
    return mean - half if math.isinf(low) else low, mean + half if math.isinf(high) else high


def _open_sides(sample: Floats, windows: int | None) -> tuple[float, float]:
    """How far below and above its mean shares may lie where the bootstrap has no limit; else 0."""
    mean, low, high = share_interval(sample, windows=windows)
    if _same(sample):
        return mean - low, high - mean
    least, most = studentised_limits(sample, (1 - CONFIDENCE) / 2)
    return (
        mean - low if math.isinf(least) else 0.0,
        high - mean if math.isinf(most) else 0.0,
    )


def _unseen(runs: int, tail: float) -> float:
    """Largest probability of what n runs did not show, with confidence 1 - `tail`."""
    return float(1.0 - tail ** (1.0 / runs))


def _half_width(sample: Floats, tail: float) -> float:
    """Student's t quantile times the standard error of the mean; for at least two values."""
    count = len(sample)
    return student_quantile(count - 1, tail) * float(sample.std(ddof=1)) / math.sqrt(count)


@lru_cache(maxsize=4096)
def student_quantile(free: int, tail: float) -> float:
    """Student's t that is exceeded with probability `tail`, by whole degrees of freedom.

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
    """Probabilities that at most 0, 1, 2, ... of so many tosses of a coin are heads."""
    ways = accumulate(range(count), lambda of, k: of * (count - k) // (k + 1), initial=1)
    return tuple(below / 2**count for below in accumulate(ways))


def _same(sample: Floats) -> bool:
    """Whether all values are the same: no spread, whatever the rounding of their mean says."""
    return bool((sample == sample[0]).all())
