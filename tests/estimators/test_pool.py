"""Pools: what they hold, what another regime is, and how they are drawn from."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from dwell.estimators.pool import ENOUGH, LARGEST, LEAST, LEAST_DEVIATIONS, SHIFT, Pool, middle

Floats = NDArray[np.float64]

MEMORY = 12.0


def pool(prior: Floats | list[float], additive: bool = False, draws: int = 1000) -> Pool:
    rng = np.random.default_rng(1)
    places = rng.permutation((np.arange(draws) + 0.5) / draws)
    return Pool(np.array(prior, float), additive, places, rng.standard_normal(draws))


def about(mean: float, count: int, seed: int = 1) -> Floats:
    """Lognormal times, spread as evenly as can be, in an order of their own."""
    places = np.random.default_rng(seed).permutation((np.arange(count) + 0.5) / count)
    times: Floats = stats.lognorm.ppf(places, 0.1, scale=mean)
    return times


def fresh(mean: float = 10.0) -> Pool:
    return pool(about(mean, 256))


# ------------------------------------------------------------------------------ what it holds


def test_it_begins_as_the_profile() -> None:
    prior = about(10.0, 256)
    one = pool(prior)
    np.testing.assert_array_equal(one.ordered, np.sort(prior))
    assert (one.last, one.measured, one.touched) == (0, 0, 0)
    assert one.usual == np.median(prior)


def test_what_is_measured_is_added_and_the_profile_forgotten() -> None:
    one = fresh()
    for window in range(1, 12):
        assert one.learn(about(10.0, 5, window), window, MEMORY) is False
        assert (len(one.ordered), one.measured, one.last) == (256 + 5 * window, 5 * window, window)
    # The profile's are of window 0.
    one.learn(about(10.0, 5, 12), 12, MEMORY)
    assert (len(one.ordered), one.measured) == (60, 60)
    one.learn(about(10.0, 5, 13), 13, MEMORY)
    assert (len(one.ordered), one.measured) == (60, 60)


def test_it_holds_the_newest_of_many() -> None:
    one = fresh()
    for window in range(1, 6):
        one.learn(about(10.0, 150, window), window, MEMORY)
    newest = np.concatenate([about(10.0, 150, 3)[50:], about(10.0, 150, 4), about(10.0, 150, 5)])
    np.testing.assert_array_equal(one.ordered, np.sort(newest))
    assert one.measured == LARGEST


def test_what_is_dropped_of_the_profile_is_no_one_side_of_it() -> None:
    prior = np.sort(about(10.0, 256))[np.random.default_rng(2).permutation(256)]
    one = pool(prior)
    one.learn(np.full(300, np.median(prior)), 1, MEMORY)
    left = one.ordered[one.ordered != np.median(prior)]
    assert len(left) == 100
    assert stats.kstest(left, prior).pvalue > 0.01


@pytest.mark.parametrize("count", [LARGEST + 1, 100_000, 1_000_000])
def test_of_a_huge_window_it_takes_an_even_share(count: int) -> None:
    one = pool([10.0] * 256)
    one.learn(np.linspace(9.0, 11.0, count), 1, MEMORY)
    assert len(one.ordered) <= LARGEST
    assert (one.ordered.min(), one.ordered.max()) == pytest.approx((9.0, 11.0), abs=0.1)


def test_a_window_is_not_kept_alive() -> None:
    table = np.ones((1000, 4))
    one = pool([1.0] * 256)
    one.learn(table[:, 2], 1, MEMORY)
    assert not np.shares_memory(one._held, table)


def test_the_last_few_are_kept_however_old() -> None:
    one = fresh()
    one.learn(about(10.0, 8, 1), 1, MEMORY)
    one.learn(about(10.0, 8, 2), 2, MEMORY)
    one.learn(about(10.0, 3, 50), 50, MEMORY)
    # All 19 are kept: without the oldest 8 they would be 11.
    assert (len(one.ordered), one.measured) == (19, 19)
    assert len(one.ordered) - 8 < ENOUGH


@given(
    st.lists(
        st.tuples(st.integers(1, 300), st.sampled_from([1.0, 1.0, 3.0, math.inf]), st.booleans()),
        max_size=30,
    ),
    st.sampled_from([0.01, 3.0, MEMORY, 1e6]),
    st.booleans(),
)
def test_it_is_bounded_and_ordered_whatever_it_is_given(
    windows: list[tuple[int, float, bool]], memory: float, additive: bool
) -> None:
    one = pool(about(10.0, 256), additive)
    for window, (count, factor, skipped) in enumerate(windows, 1):
        if not skipped:
            one.learn(about(10.0, count, window) * factor, window, memory)
        assert 0 < len(one.ordered) <= LARGEST
        assert 0 <= one.measured <= len(one.ordered)
        assert (one.ordered[1:] >= one.ordered[:-1]).all()
        one.draw(0.03)
        assert not np.isnan(one.drawn).any()
        assert np.isin(one.drawn[np.isinf(one.drawn)], one.ordered).all()


# ------------------------------------------------------------------------------------ regimes


def test_another_regime_drops_all_that_was() -> None:
    one = fresh()
    one.learn(about(10.0, 100, 1), 1, MEMORY)
    assert one.learn(about(20.0, 100, 2), 2, MEMORY) is True
    assert one.measured == len(one.ordered) == 100
    assert one.ordered.min() > 13.0
    assert one.learn(about(10.0, 100, 3), 3, MEMORY) is True
    assert one.ordered.max() < 15.0


def test_few_times_get_the_shape_of_the_profile() -> None:
    prior = about(10.0, 256)
    one = pool(prior)
    assert one.learn(np.array([20.0, 21.0, 22.0]), 1, MEMORY) is True
    assert one.measured == 3
    assert len(one.ordered) >= ENOUGH
    assert np.median(one.ordered) == pytest.approx(21.0, rel=0.02)
    shape = np.setdiff1d(one.ordered, [20.0, 21.0, 22.0]) / 21.0 * np.median(prior)
    assert np.std(np.log(shape)) == pytest.approx(0.1, rel=0.4)


def test_the_times_of_messages_are_shifted_not_stretched() -> None:
    prior = about(1.0, 256)
    one = pool(prior, additive=True)
    one.learn(np.array([26.0, 26.0]), 1, MEMORY)
    assert np.std(one.ordered) < 0.15
    assert one.moved(0.5).min() >= 0.0


def test_a_job_that_took_nothing_is_shifted() -> None:
    one = pool([0.0] * 256)
    assert one.learn(np.array([5.0, 5.0]), 1, MEMORY) is True
    assert set(one.ordered) == {5.0}


def test_equal_times_are_of_one_regime() -> None:
    one = pool([3.0] * 256)
    for window in range(1, 20):
        assert one.learn(np.full(5, 3.0), window, MEMORY) is False


def test_a_handful_of_slow_ones_among_many_is_no_other_regime() -> None:
    one = fresh()
    times = about(10.0, 100, 2)
    times[:10] *= 3
    assert one.learn(times, 1, MEMORY) is False


def test_lost_times_are_a_regime_and_so_is_the_recovery() -> None:
    one = fresh()
    assert one.learn(np.full(5, math.inf), 1, MEMORY) is True
    assert np.isinf(one.ordered).all()
    one.draw(0.5)
    assert np.isinf(one.drawn).all()
    assert one.learn(np.full(5, math.inf), 2, MEMORY) is False
    assert one.learn(about(10.0, 5, 3), 3, MEMORY) is True
    assert np.isfinite(one.ordered).all()


def test_a_share_of_losses_is_kept_as_it_is() -> None:
    one = fresh()
    times = about(10.0, 100)
    times[:20] = math.inf
    assert one.learn(times, 1, MEMORY) is False
    assert np.isinf(one.ordered).sum() == 20


def test_a_profile_that_loses_everything_is_a_pool_too() -> None:
    one = pool([math.inf] * 256)
    assert one.usual == math.inf
    one.draw(0.1)
    assert np.isinf(one.drawn).all()
    assert one.learn(np.array([1.0, 2.0]), 1, MEMORY) is True
    assert one.ordered.tolist() == [1.0, 2.0]


def test_single_times_are_put_together() -> None:
    one = fresh()
    assert one.learn(np.array([30.0]), 1, MEMORY) is None
    assert one.learn(np.array([31.0]), 7, MEMORY) is True
    assert one.measured == LEAST
    assert one.ordered.min() > 20.0
    assert one.learn(np.array([30.0]), 8, MEMORY) is None
    assert one.learn(np.array([31.0]), 9, MEMORY) is False


@given(
    st.lists(st.integers(0, 8), min_size=1, max_size=12),
    st.lists(st.integers(0, 8), min_size=LEAST, max_size=12),
)
def test_the_statistic_counts_ties_half(old: list[int], new: list[int]) -> None:
    one = pool([float(x) for x in old])
    wins = sum((x > y) + 0.5 * (x == y) for x in new for y in old) / len(new) / len(old)
    deviation = math.sqrt((1 / len(new) + 1 / len(old)) / 12)
    expected = not 1 - SHIFT <= wins <= SHIFT and abs(wins - 0.5) > LEAST_DEVIATIONS * deviation
    assert one.learn(np.array(new, float), 1, MEMORY) is expected


def test_false_alarms_are_rare() -> None:
    alarms = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        one = pool(rng.exponential(1.0, 256))
        alarms += one.learn(rng.exponential(1.0, 5), 1, MEMORY) is True
    assert alarms <= 6  # 0.4 % by the distribution of a mean of five uniform ranks


# -------------------------------------------------------------------------------------- draws


def test_draws_are_the_quantiles_of_the_pool() -> None:
    one = pool(np.arange(100.0), draws=1000)
    one.draw(0.0)
    np.testing.assert_array_equal(np.sort(one.drawn), np.repeat(np.arange(100.0), 10))
    first = one.drawn
    one.draw(0.0)
    assert one.drawn is first
    one.learn(np.arange(40.0, 60.0), 1, MEMORY)
    one.draw(0.0)
    assert len(one.drawn) == 1000
    assert np.bincount(one.drawn.astype(int))[50] == pytest.approx(2000 / 120, abs=1)


def test_draws_widen() -> None:
    one = pool([10.0] * 50)
    for deviation in (0.0, 0.1, 0.3):
        one.draw(deviation)
        assert np.std(np.log(one.drawn)) == pytest.approx(deviation, rel=0.05)
    assert one.ordered.tolist() == [10.0] * 50


def test_the_middle_is_that_of_what_is_not_lost() -> None:
    assert middle(np.array([1.0, 3.0, math.inf, math.inf, math.inf])) == 2.0
    assert middle(np.array([math.inf])) == math.inf
