"""Judged predictions: a predicted figure beside a measured one, and whether it was good enough.

A goal is `met` where the whole 95 % interval of the prediction's error lies within what is
allowed, `missed` where the whole of it lies beyond, and `open` elsewhere: more runs would tell.
The error's interval comes from resampling the measured and the simulated runs independently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.study.intervals import CONFIDENCE, Interval
from dwell.study.resampling import ends

__all__ = ["Judged", "Outcome", "chance", "judge", "relative", "within", "worst"]

Floats: TypeAlias = NDArray[np.float64]
Outcome: TypeAlias = Literal["met", "explained", "open", "missed", ""]

#: From what is fine to what is not.
ORDER: tuple[Outcome, ...] = ("", "met", "explained", "open", "missed")


@dataclass(frozen=True, slots=True)
class Judged:
    """One figure of one group.

    Parameters
    ----------
    metric : str
        Column's name: ``l95_ms``, ``violation_rate``, ``u_R1``.
    measured, predicted : Interval
        In the metric's unit.
    error : Interval
        Of the prediction: relative for ``l95_ms``, elsewhere the difference.
    allowed : float
        Largest error that is good enough; NaN where nothing is asked.
    verdict : {"met", "explained", "open", "missed", ""}
        Empty where nothing is asked.
    baseline : float
        What the sum-of-means predictor says; NaN where it says nothing.
    note : str
        What there is to say.
    """

    metric: str
    measured: Interval
    predicted: Interval
    error: Interval
    allowed: float = math.nan
    verdict: Outcome = ""
    baseline: float = math.nan
    note: str = ""


def judge(error: Interval, allowed: float) -> Outcome:
    """Whether an error is shown to be within what is allowed, or shown to be beyond it."""
    if not error.known:
        return "open"
    if -allowed <= error.low and error.high <= allowed:
        return "met"
    return "missed" if error.low > allowed or error.high < -allowed else "open"


def within(value: float, resampled: Floats) -> Interval:
    """Return a value with the interval that its resamples give."""
    low, high = ends(resampled)
    # Rounding, and distributions kept at points only, may put a value beside its resamples.
    return Interval(value, min(low, value), max(high, value))


def relative(predicted: Floats, measured: Floats) -> Floats:
    """Relative error of predictions; 0 where both are infinite."""
    same = predicted == measured
    with np.errstate(invalid="ignore", divide="ignore"):
        error: Floats = np.where(same, 0.0, predicted / measured - 1)
    return error


def chance(held: NDArray[np.bool_]) -> Outcome:
    """Judge a condition by the share of resamples in which it holds."""
    share = float(held.mean())
    tail = (1 - CONFIDENCE) / 2
    return "met" if share >= 1 - tail else "missed" if share <= tail else "open"


def worst(verdicts: Sequence[Outcome]) -> Outcome:
    """Return the verdict of several together."""
    return max(verdicts, key=ORDER.index, default="")
