"""Judged predictions: predicted and measured figures, and whether their errors are allowed.

A goal is `met` if the complete 95 % interval of the prediction's error is within the allowed error,
`missed` if it is completely beyond, else `open`: more runs would decide. The interval comes from
resampling the measured and the simulated runs independently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model import Problem
from dwell.model.number_arrays import Floats
from dwell.study.intervals import CONFIDENCE, Interval, rule_of_three
from dwell_lab.validation.qos_sample import QosSample
from dwell_lab.validation.resampling import ends, resample_units, resample_windows

Outcome: TypeAlias = Literal["met", "explained", "open", "missed", ""]

L95_ALLOWED = 0.10
POINTS_ALLOWED = 0.02
USE_ALLOWED = 0.05
#: From good to bad.
ORDER: tuple[Outcome, ...] = ("", "met", "explained", "open", "missed")
UNKNOWN = Interval(math.nan, math.nan, math.nan)


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
        The prediction's error: relative for ``l95_ms``, elsewhere the difference.
    allowed : float
        Largest allowed error; NaN without a goal.
    verdict : {"met", "explained", "open", "missed", ""}
        Empty without a goal.
    baseline : float
        Prediction of the sum of means; NaN if it makes none.
    note : str
        Remark on the verdict.
    """

    metric: str
    measured: Interval
    predicted: Interval
    error: Interval = UNKNOWN
    allowed: float = math.nan
    verdict: Outcome = ""
    baseline: float = math.nan
    note: str = ""


def judge(error: Interval, allowed: float) -> Outcome:
    """Return whether an error is shown to be within the allowed error, or beyond it."""
    if not error.known:
        return "open"
    if -allowed <= error.low and error.high <= allowed:
        return "met"
    return "missed" if error.low > allowed or error.high < -allowed else "open"


def within(value: float, resampled: Floats) -> Interval:
    """Return a value with the interval of its resamples."""
    low, high = ends(resampled)
    # Rounding, and distributions kept at points only, may put a value outside its resamples.
    return Interval(value, min(low, value), max(high, value))


def relative(predicted: Floats | float, measured: Floats | float) -> Floats:
    """Relative error of predictions; 0 where both are infinite."""
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.divide(predicted, measured) - 1
    errors: Floats = np.where(np.equal(predicted, measured), 0.0, error)
    return errors


def chance(held: NDArray[np.bool_]) -> Outcome:
    """Judge a condition by the share of resamples in which it holds."""
    share = float(held.mean())
    tail = (1 - CONFIDENCE) / 2
    return "met" if share >= 1 - tail else "missed" if share <= tail else "open"


def worst(verdicts: Sequence[Outcome]) -> Outcome:
    """Return the verdict of several together."""
    return max(verdicts, key=ORDER.index, default="")


class Both(NamedTuple):
    """A figure as it was measured and predicted, and both in every resample."""

    measured: float
    predicted: float
    measured_resamples: Floats
    predicted_resamples: Floats

    @property
    def relative_error(self) -> Interval:
        """The prediction's error as a share of the measured figure."""
        return within(
            float(relative(self.predicted, self.measured)),
            relative(self.predicted_resamples, self.measured_resamples),
        )


class GroupJudge:
    """Judges the figures of a group, all from the same resamples.

    Parameters
    ----------
    sum_ms, sum_rate : float
        L95 and V_D of the sum-of-means predictor.
    """

    def __init__(
        self,
        problem: Problem,
        measured: QosSample,
        predicted: QosSample,
        sum_ms: float,
        sum_rate: float,
    ) -> None:
        self.problem, self.measured, self.predicted = problem, measured, predicted
        self.sum_ms, self.sum_rate = sum_ms, sum_rate
        self._measured = resample_windows(measured.lengths)
        # Another seed: the two are resampled independently.
        self._predicted = resample_units(predicted.units, seed=2)
        self.allowed_rates = (
            predicted.rate_if(1 - L95_ALLOWED),
            predicted.rate_if(1 + L95_ALLOWED),
        )
        self.dominant = (measured.dominant, predicted.dominant)
        self._known: dict[str, Both] = {}

    def figures(self) -> dict[str, Judged]:
        """Return every figure of the group (see `dwell_lab.validation.validation.Group`)."""
        l95 = self._l95()
        figures = [
            l95,
            self._difference("window_l95_ms"),
            self._violations(l95.verdict),
            *(
                self._use(f"u_{name}")
                for name in self.problem.fabric.resources
                if self._shows(name)
            ),
            self._placed(),
            self._better(),
            *(self._difference(f"share_{name}") for name in self.problem.candidates),
            self._migrations(),
        ]
        return {figure.metric: figure for figure in figures}

    def _both(self, name: str) -> Both:
        if name not in self._known:
            self._known[name] = Both(
                self.measured.figure(name),
                self.predicted.figure(name),
                self.measured.resampled(name, self._measured),
                self.predicted.resampled(name, self._predicted),
            )
        return self._known[name]

    def _l95(self) -> Judged:
        both, note = self._both("l95_ms"), ""
        error = both.relative_error
        if math.isinf(both.measured) and math.isinf(both.predicted):
            # More than 5 % are lost, as predicted: only the L95 of windows can be judged.
            error = self._both("window_l95_ms").relative_error
            note = "more than 5 % of the cycles are lost: judged by the mean of windows"
        return Judged(
            "l95_ms",
            within(both.measured, both.measured_resamples),
            within(both.predicted, both.predicted_resamples),
            error,
            L95_ALLOWED,
            judge(error, L95_ALLOWED),
            self.sum_ms,
            note,
        )

    def _difference(self, name: str) -> Judged:
        measured, predicted, seen, simulated = self._both(name)
        error = within(predicted - measured, simulated - seen)
        return Judged(name, within(measured, seen), within(predicted, simulated), error)

    def _migrations(self) -> Judged:
        judged = self._difference("migrations")
        if len(self.measured.lengths) > 1:
            return judged
        # One run has one number of migrations: its windows say nothing of another run's.
        open_ends = {"low": math.nan, "high": math.nan}
        return replace(
            judged,
            measured=judged.measured._replace(**open_ends),
            error=judged.error._replace(**open_ends),
        )

    def _shows(self, resource: str) -> bool:
        """Whether it was measured how busy a resource was; of accelerators it need not be."""
        name = f"u_{resource}"
        return name in self.measured.sums and not math.isnan(self.measured.figure(name))

    def _use(self, name: str) -> Judged:
        judged = self._difference(name)
        return replace(judged, allowed=USE_ALLOWED, verdict=judge(judged.error, USE_ALLOWED))

    def _violations(self, l95: Outcome) -> Judged:
        judged = self._difference("violation_rate")
        measured, error = judged.measured, judged.error
        # Zero observed misses bound the rate, but do not prove it to be zero.
        most = rule_of_three(self.measured.windows)
        if measured.value == 0:
            measured = measured._replace(high=most)
            error = error._replace(low=error.low - most)
        elif measured.value == 1:
            measured = measured._replace(low=1 - most)
            error = error._replace(high=error.high + most)
        verdict = judge(error, POINTS_ALLOWED)
        low, high = self.allowed_rates
        note = ""
        if verdict != "met" and low <= measured.low and measured.high <= high:
            if l95 in ("met", "open"):
                verdict = "explained" if l95 == "met" else "open"
                note = (
                    "latencies 10 % shorter or longer, as L95 may be off, give "
                    f"{100 * low:.2f} to {100 * high:.2f} %"
                )
        elif verdict == "missed" and measured.low <= high and low <= measured.high:
            verdict = verdict if l95 == "missed" else "open"
        return replace(
            judged,
            measured=measured,
            error=error,
            allowed=POINTS_ALLOWED,
            verdict=verdict,
            baseline=self.sum_rate,
            note=note,
        )

    def _placed(self) -> Judged:
        """Judge whether the same placement has the most windows."""
        both = [self._both(f"share_{name}") for name in self.problem.candidates]
        seen = np.argmax([one.measured_resamples for one in both], axis=0)
        same = seen == np.argmax([one.predicted_resamples for one in both], axis=0)
        verdict = chance(same)
        # What most resamples show is not against what the runs themselves show.
        agree = self.dominant[0] == self.dominant[1]
        if verdict == ("missed" if agree else "met"):
            verdict = "open"
        shares = [self._difference(f"share_{name}") for name in self.dominant]
        return Judged(
            "dominant",
            shares[0].measured,
            shares[1].predicted,
            verdict=verdict,
            note=f"{self.dominant[0]} measured, {self.dominant[1]} predicted",
        )

    def _better(self) -> Judged:
        """Judge whether the prediction is closer to the measurement than the sum of means is."""
        measured, predicted, seen, simulated = self._both("l95_ms")
        sums = np.full_like(seen, self.sum_ms)
        ours, theirs = np.abs(relative(simulated, seen)), np.abs(relative(sums, seen))
        rates = self._both("violation_rate")
        off = np.abs(rates.predicted_resamples - rates.measured_resamples)
        off_sum = np.abs(self.sum_rate - rates.measured_resamples)
        not_worse = (off <= off_sum) | (np.maximum(off, off_sum) <= POINTS_ALLOWED)
        return Judged(
            "sum_of_means",
            within(measured, seen),
            within(predicted, simulated),
            within(float(relative(self.sum_ms, measured)), relative(sums, seen)),
            math.nan,
            chance((ours < theirs) & not_worse),
            self.sum_ms,
        )
