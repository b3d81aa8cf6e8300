"""Numbers beside bounds: within, beyond, or open."""

from __future__ import annotations

import math

import pytest

from dwell.study import Interval, keeps
from dwell.study.kept_bounds import ABOVE_ZERO


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [
        (0.91, 0.95, True),
        (0.9, 0.9, True),
        (0.5, 0.5, False),
        (0.2, 0.89, False),
        (0.2, 0.9, None),
        (0.86, 1.0, None),
        (math.nan, math.nan, None),
    ],
)
def test_a_whole_interval_says_whether_a_bound_is_kept(
    low: float, high: float, found: bool | None
) -> None:
    known = Interval((low + high) / 2, low, high)
    assert keeps(known, at_least=0.9) is found
    # The other direction, mirrored.
    assert keeps(Interval(-known.value, -high, -low), at_most=-0.9) is found


@pytest.mark.parametrize(
    ("low", "high", "found"),
    [(0.1, 0.2, True), (0.0, 0.2, None), (-0.1, 0.1, None), (-0.2, 0.0, False), (0.0, 0.0, False)],
)
def test_above_zero_is_not_at_least_zero(low: float, high: float, found: bool | None) -> None:
    assert keeps(Interval(0.0, low, high), at_least=ABOVE_ZERO) is found


def test_both_bounds_at_once() -> None:
    assert keeps(Interval(0.5, 0.4, 0.6), at_least=0.3, at_most=0.7) is True
    assert keeps(Interval(0.5, 0.4, 0.6), at_least=0.5, at_most=0.7) is None
    assert keeps(Interval(0.9, 0.8, 0.95), at_least=0.5, at_most=0.7) is False
