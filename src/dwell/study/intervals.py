"""Intervals over seeds.

The unit is the seed: one run gives one number, runs of different seeds are independent, and the
windows and cycles inside a run are not. Three kinds of number need three kinds of interval:

* a mean: Student's t on n - 1 degrees of freedom;
* a mean of shares: the same, cut to [0, 1]. Where every run shows 0 (or every run 1) the sample
  has no spread to work with, and the interval is the exact one for that case (see
  `rule_of_three`);
* a median, where infinity can occur: order statistics, by the binomial distribution. It assumes
  nothing about the shape, and it never interpolates.

Student's t is approximate where the numbers of the runs are skewed and few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "CONFIDENCE",
    "Interval",
    "mean_interval",
    "median_interval",
    "rule_of_three",
    "share_interval",
    "share_limits",
]

Floats: TypeAlias = NDArray[np.float64]
Values: TypeAlias = Sequence[float] | Floats

CONFIDENCE = 0.95


class Interval(NamedTuple):
    """A number over seeds and the interval around it; NaN at the ends where there is none."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether there is an interval at all (one seed gives none)."""
        return not math.isnan(self.low)


def mean_interval(values: Values) -> Interval:
    """Mean with its two-sided interval by Student's t.

    Parameters
    ----------
    values : sequence of float
        One a seed, finite, at least one.

    Returns
    -------
    Interval
        NaN at the ends for a single value.
    """
    sample = np.asarray(values, np.float64)
    mean = float(sample.mean())
    half = _half_width(sample, 0.5 + CONFIDENCE / 2)
    return Interval(mean, mean - half, mean + half)


def share_interval(values: Values) -> Interval:
    """Mean of shares with its two-sided interval, inside [0, 1].

    Parameters
    ----------
    values : sequence of float
        One a seed, in [0, 1], at least one.

    Returns
    -------
    Interval
        By Student's t; by `rule_of_three` where all are 0, or all are 1.
    """
    sample = np.asarray(values, np.float64)
    if not sample.any():
        return Interval(0.0, 0.0, rule_of_three(len(sample)))
    if (sample == 1.0).all():
        return Interval(1.0, 1.0 - rule_of_three(len(sample)), 1.0)
    mean, low, high = mean_interval(sample)
    return Interval(mean, np.maximum(low, 0.0).item(), np.minimum(high, 1.0).item())


def share_limits(values: Values) -> tuple[float, float]:
    """One-sided limits of a mean of shares: it is above the first, it is below the second.

    Each is right with the confidence of `CONFIDENCE` on its own.

    Parameters
    ----------
    values : sequence of float
        One a seed, in [0, 1], at least one.

    Returns
    -------
    at_least, at_most : float
        0 and 1 for a single value, which limits nothing.
    """
    sample = np.asarray(values, np.float64)
    if not sample.any():
        return 0.0, rule_of_three(len(sample))
    if (sample == 1.0).all():
        return 1.0 - rule_of_three(len(sample)), 1.0
    if len(sample) == 1:
        return 0.0, 1.0
    mean, half = float(sample.mean()), _half_width(sample, CONFIDENCE)
    return max(mean - half, 0.0), min(mean + half, 1.0)


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
    return float(1.0 - (1.0 - CONFIDENCE) ** (1.0 / runs))


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
    from scipy.stats import binom

    sample = np.sort(np.asarray(values, np.float64))
    count = len(sample)
    median = float(sample[(count + 1) // 2 - 1])
    # The largest r such that fewer than r of n values fall below the median with a probability of
    # at most half of what is left over.
    rank = int(binom.ppf((1 - CONFIDENCE) / 2, count, 0.5))
    if rank < 1:
        return Interval(median, math.nan, math.nan)
    return Interval(median, float(sample[rank - 1]), float(sample[count - rank]))


def _half_width(sample: Floats, quantile: float) -> float:
    """Student's t quantile times the standard error of the mean."""
    from scipy.stats import t

    count = len(sample)
    if count < 2:
        return math.nan
    # Equal values have no spread, whatever the rounding of their mean says.
    if (sample == sample[0]).all():
        return 0.0
    return float(t.ppf(quantile, count - 1) * sample.std(ddof=1) / math.sqrt(count))
