"""METRICS: one declaration per metric, with one rounding of V_D."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dwell.model import MovingTarget, Servo
from dwell.study.metric import METRICS, declared, metric_of
from dwell.study.summary import summarise
from dwell.study.verdict import RunVerdict
from tests.cells.small import make_problem
from tests.report.pages import small_run

#: Columns that label or count a run.
OTHER = {"windows", "cycles", "played", "latencies"}
RATE = METRICS["violation_rate"]


def test_every_number_of_a_summary_is_declared() -> None:
    servo = Servo("integrator", 4.0, MovingTarget(40.0, 1.6))
    row = summarise(small_run(), replace(make_problem(), servo=servo), {}).row
    assert "tracking_rms_mm" in row
    assert [name for name in row if name not in OTHER and declared(name) is None] == []


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.8845454, "88.45 %"), (0.034, "3.40 %"), (1.0, "100.00 %"), (0.0, "0.00 %")],
)
def test_a_violation_rate_has_two_decimals_of_a_percent(share: float, text: str) -> None:
    assert RATE.text(share) == text
    assert str(RunVerdict("open", share, None, None, 0.05)).startswith(f"{text} of ")
    assert RATE.heading == "V_D (%)"
    assert RATE.number(share) == text.removesuffix(" %")


def test_integers_have_no_decimals_and_means_have_some() -> None:
    assert METRICS["migrations"].text(3) == "3"
    assert METRICS["migrations"].text(3.0) == "3.0"
    assert METRICS["l95_ms"].text(32.08) == "32.1 ms"
    assert METRICS["l95_ms"].text(0.0042) == "0.0042 ms"


def test_columns_with_names_in_them_and_own_metrics_are_metrics() -> None:
    assert metric_of("share_LOC").heading == "LOC (%)"
    assert metric_of("node_E.gpu").heading == "U of E.gpu (%)"
    assert metric_of("share_kept") is METRICS["share_kept"]
    assert metric_of("slowest_ms").text(3.14159) == "3.14"
    assert declared("slowest_ms") is None
