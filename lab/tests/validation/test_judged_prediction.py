"""Whether a prediction was good enough: by the whole interval of its error."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dwell.study.intervals import Interval
from dwell_lab.validation.judged_prediction import chance, judge, relative, within, worst


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (-0.1, 0.1, "met"),
        (-0.05, 0.02, "met"),
        (0.11, 0.2, "missed"),
        (-0.3, -0.11, "missed"),
        (0.05, 0.11, "open"),
        (-0.2, 0.2, "open"),
        (math.nan, math.nan, "open"),
    ],
)
def test_an_error_is_met_or_missed_as_a_whole(low: float, high: float, verdict: str) -> None:
    assert judge(Interval((low + high) / 2, low, high), 0.1) == verdict


def test_a_value_is_within_its_interval() -> None:
    resampled = np.linspace(1.0, 2.0, 1_000)
    assert within(1.5, resampled) == pytest.approx((1.5, 1.025, 1.975), abs=0.01)
    assert within(0.5, resampled).low == 0.5
    assert within(2.5, resampled).high == 2.5


def test_what_is_lost_in_both_is_no_error() -> None:
    predicted, measured = np.array([math.inf, 3.0, math.inf]), np.array([math.inf, 2.0, 5.0])
    assert relative(predicted, measured).tolist() == [0.0, 0.5, math.inf]


@pytest.mark.parametrize(
    ("held", "verdict"),
    [(1000, "met"), (975, "met"), (974, "open"), (26, "open"), (25, "missed"), (0, "missed")],
)
def test_a_condition_is_judged_by_its_share_of_resamples(held: int, verdict: str) -> None:
    assert chance(np.arange(1000) < held) == verdict


def test_several_verdicts_are_as_good_as_the_worst() -> None:
    assert worst(["met", "", "explained"]) == "explained"
    assert worst(["open", "missed", "met"]) == "missed"
    assert worst([]) == ""
