"""Intervals against closed forms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.study.intervals import (
    mean_interval,
    median_interval,
    rule_of_three,
    share_interval,
    share_limits,
)

T_975_2, T_95_2 = 4.302652729749464, 2.919985580355516


def test_a_mean_has_students_t() -> None:
    half = T_975_2 / math.sqrt(3)
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.0 - half, 2.0 + half))


def test_equal_values_have_no_width() -> None:
    assert mean_interval([0.1] * 7) == pytest.approx((0.1, 0.1, 0.1), abs=1e-15)


def test_one_value_has_no_interval() -> None:
    interval = mean_interval([3.0])
    assert interval.value == 3.0
    assert not interval.known
    assert not share_interval([0.5]).known
    assert share_limits([0.5]) == (0.0, 1.0)


def test_a_share_stays_between_0_and_1() -> None:
    half = T_975_2 * np.std([0.0, 0.0, 0.3], ddof=1) / math.sqrt(3)
    assert share_interval([0.0, 0.0, 0.3]) == pytest.approx((0.1, 0.0, 0.1 + half))
    assert share_interval([1.0, 1.0, 0.9]).high == 1.0


def test_limits_are_one_sided() -> None:
    values = [0.1, 0.2, 0.3]
    half = T_95_2 * 0.1 / math.sqrt(3)
    assert share_limits(values) == pytest.approx((0.2 - half, 0.2 + half))


@pytest.mark.parametrize("runs", [1, 5, 20, 59])
def test_no_miss_at_all_is_limited_by_the_rule_of_three(runs: int) -> None:
    limit = rule_of_three(runs)
    assert (1 - limit) ** runs == pytest.approx(0.05)
    assert limit <= 3 / runs
    assert share_interval([0.0] * runs) == (0.0, 0.0, limit)
    assert share_limits([0.0] * runs) == (0.0, limit)
    assert share_interval([1.0] * runs) == (1.0, 1.0 - limit, 1.0)
    assert share_limits([1.0] * runs) == (1.0 - limit, 1.0)


@pytest.mark.parametrize(("count", "rank"), [(6, 1), (8, 1), (9, 2), (20, 6), (30, 10)])
def test_a_median_lies_between_order_statistics(count: int, rank: int) -> None:
    def below(r: int) -> float:
        """Probability that fewer than r of the values lie below the median."""
        return math.fsum(math.comb(count, k) / 2.0**count for k in range(r))

    assert below(rank) <= 0.025 < below(rank + 1)
    values = np.random.default_rng(1).permutation(np.arange(1.0, count + 1))
    expected = ((count + 1) // 2, rank, count + 1 - rank)
    assert median_interval(values) == tuple(map(float, expected))


def test_a_median_may_be_infinite() -> None:
    values = [1.0] * 4 + [math.inf] * 6
    assert median_interval(values) == (math.inf, 1.0, math.inf)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_values_leave_a_median_without_interval(count: int) -> None:
    interval = median_interval(range(count))
    assert interval.value == (count + 1) // 2 - 1
    assert not interval.known


@given(st.lists(st.floats(0, 1), min_size=2, max_size=30))
def test_limits_lie_inside_the_interval(values: Sequence[float]) -> None:
    value, low, high = share_interval(values)
    at_least, at_most = share_limits(values)
    assert 0 <= low <= value + 1e-12
    assert value - 1e-12 <= high <= 1
    assert low - 1e-12 <= at_least
    assert at_most <= high + 1e-12
