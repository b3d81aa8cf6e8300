"""Ticks that people would write, with room for their labels."""

from __future__ import annotations

import math

import pytest

from dwell.report.scales import is_wide, log_ticks


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (10.0, 60.0, [10.0, 20.0, 50.0]),
        (2.0, 160.0, [3.0, 10.0, 30.0, 100.0]),
        (30.0, 5000.0, [30.0, 100.0, 300.0, 1000.0, 3000.0]),
        (30.0, 50000.0, [100.0, 1000.0, 10000.0]),
        (0.1, 120.0, [0.1, 1.0, 10.0, 100.0]),
    ],
)
def test_log_ticks(low: float, high: float, ticks: list[float]) -> None:
    assert log_ticks(low, high) == pytest.approx(ticks)


def test_wide_is_what_a_linear_axis_would_squeeze() -> None:
    assert is_wide([1.0, 100.0, math.inf])
    assert not is_wide([20.0, 60.0])
    assert not is_wide([0.0, 60.0])
    assert not is_wide([])
