"""Percentiles that are never interpolated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.model.order_statistic import order_statistic, percentile, rank_of


@given(st.integers(1, 99), st.integers(1, 10_000))
def test_no_rounding_moves_the_rank(percent: int, count: int) -> None:
    rank = rank_of(percent, count)
    assert 100 * rank >= percent * count > 100 * (rank - 1)


@pytest.mark.parametrize(("percent", "rank"), [(5, 3), (50, 25), (95, 48), (99, 50)])
def test_it_is_the_value_at_that_rank(percent: int, rank: int) -> None:
    values = np.random.default_rng(1).permutation(50) + 1.0
    assert percentile(values, percent) == rank
    assert percentile(np.array([7.0]), percent) == 7.0


@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=200))
def test_it_has_its_share_below(values: Sequence[float]) -> None:
    l95 = percentile(np.array(values), 95)
    assert l95 in values
    assert sum(value <= l95 for value in values) >= 0.95 * len(values)
    assert sum(value < l95 for value in values) < 0.95 * len(values)


def test_rows_have_one_each() -> None:
    rows = np.array([[3, 1, 2], [9, 8, 7]])
    assert order_statistic(rows, 50).tolist() == [2, 8]
