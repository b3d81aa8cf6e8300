"""Intervals against closed forms, and against what they promise."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from dwell.study.intervals import (
    FARTHEST,
    FEWEST,
    halves,
    mean_interval,
    median_interval,
    rule_of_three,
    share_difference_interval,
    share_interval,
    share_limits,
    student_quantile,
    studentised_limits,
    under,
)

T_975_2 = 4.302652729749464


def every_t(values: Sequence[float]) -> tuple[list[float], list[float]]:
    """Return t* of all n^n resamples, and how often each occurs; written out, not vectorised."""
    count, mean = len(values), math.fsum(values) / len(values)
    found: dict[float, int] = {}
    for picks in itertools.product(values, repeat=count):
        shift = math.fsum(picks) / count - mean
        spread = math.fsum((pick - math.fsum(picks) / count) ** 2 for pick in picks)
        error = math.sqrt(spread / (count - 1) / count)
        t = shift / error if len(set(picks)) > 1 else math.copysign(math.inf, shift)
        found[t] = found.get(t, 0) + 1
    order = sorted(found)
    return order, [found[t] / count**count for t in order]


def test_a_mean_has_the_studentised_bootstrap() -> None:
    values = [1.0, 2.0, 4.0, 8.0, 9.5]
    mean, low, high = mean_interval(values)
    error = np.std(values, ddof=1) / math.sqrt(5)
    ts, weights = every_t(values)
    below = np.cumsum(weights)
    assert mean == pytest.approx(4.9)
    # Resamples are drawn, so that a limit lies between quantiles near those it is to be.
    for t, tail in (((mean - high) / error, 0.025), ((mean - low) / error, 0.975)):
        first, last = (int(np.searchsorted(below, tail + step)) for step in (-0.005, 0.005))
        assert ts[first] - 1e-9 <= t <= ts[last] + 1e-9
    # What is skewed to the right lies further up than down.
    assert high - mean > mean - low


@pytest.mark.parametrize("tail", [0.005, 0.025, 0.05, 0.3])
def test_quantiles_of_student_are_those_of_scipy(tail: float) -> None:
    free = [*range(1, 60), 100, 101, 999, 1000]
    found = [student_quantile(one, tail) for one in free]
    np.testing.assert_allclose(found, stats.t.ppf(1 - tail, free), rtol=1e-11)


@pytest.mark.parametrize("count", [0, 1, 2, 9, 30, 1000])
def test_tosses_of_a_coin_are_binomial(count: int) -> None:
    expected = stats.binom.cdf(np.arange(count + 1), count, 0.5)
    np.testing.assert_allclose(halves(count), expected, rtol=1e-12, atol=1e-300)


def test_the_same_values_have_the_same_interval() -> None:
    values = np.random.default_rng(5).lognormal(size=20)
    assert studentised_limits(values, 0.05) == studentised_limits(values.copy(), 0.05)
    assert mean_interval(values, seed=1) == mean_interval(values)
    other = mean_interval(values, seed=2)
    assert other != mean_interval(values)
    assert other == pytest.approx(mean_interval(values), rel=0.03)


@given(
    st.lists(st.floats(-5, 5), min_size=4, max_size=12),
    st.floats(0.1, 10),
    st.floats(-10, 10),
)
def test_limits_follow_the_unit(values: Sequence[float], scale: float, shift: float) -> None:
    assume(np.ptp(values) > 1e-3)
    low, high = studentised_limits(values, 0.025)
    moved = studentised_limits(np.asarray(values) * scale + shift, 0.025)
    assert moved == pytest.approx((low * scale + shift, high * scale + shift), rel=1e-5, abs=1e-5)


def test_few_values_have_students_t() -> None:
    half = T_975_2 / math.sqrt(3)
    assert FEWEST == 4
    assert studentised_limits([1.0, 2.0, 3.0], 0.025) == (-math.inf, math.inf)
    assert mean_interval([1.0, 2.0, 3.0]) == pytest.approx((2.0, 2.0 - half, 2.0 + half))


def test_one_value_that_differs_leaves_one_side_without_limit() -> None:
    # (19/20)^20 = 36 % of the resamples do not hold it.
    values = [5.0] * 19 + [4.0]
    low, high = studentised_limits(values, 0.025)
    assert low == -math.inf
    assert 4.95 <= high < 5.05
    interval = mean_interval(values)
    half = stats.t.ppf(0.975, 19) * np.std(values, ddof=1) / math.sqrt(20)
    assert interval == pytest.approx((4.95, 4.95 - half, high))


def test_values_that_nearly_agree_have_limits_at_a_distance_that_makes_sense() -> None:
    # Ten in 256 of the resamples hold nothing but the first two, which differ by a hair.
    values = [44.0, 44.01, 50.0, 55.0]
    low, high = studentised_limits(values, 0.025)
    mean = np.mean(values)
    half = stats.t.ppf(0.975, 3) * np.std(values, ddof=1) / math.sqrt(4)
    assert high - mean > 100 * half
    assert mean_interval(values) == pytest.approx((mean, low, mean + FARTHEST * half))
    down = mean_interval([-value for value in values])
    assert down == pytest.approx((-mean, -mean - FARTHEST * half, -low))


def test_a_value_at_the_mean_is_no_surprise() -> None:
    # Four in six: 9 % of the resamples hold nothing else. Its distance to the mean is rounding, and
    # must not make them infinite.
    values = [0.05, 0.1, 0.1, 0.1, 0.1, 0.15]
    assert np.mean(values) != 0.1
    assert np.isfinite(studentised_limits(values, 0.025)).all()


def test_what_is_not_finite_has_no_interval() -> None:
    assert not mean_interval([1.0, math.nan, 2.0, 3.0]).known
    assert not mean_interval([1.0, math.inf, 2.0, 3.0]).known


def test_equal_values_have_no_width() -> None:
    assert mean_interval([0.1] * 7) == pytest.approx((0.1, 0.1, 0.1), abs=1e-15)


def test_one_value_has_no_interval() -> None:
    interval = mean_interval([3.0])
    assert interval.value == 3.0
    assert not interval.known
    assert not share_interval([0.5]).known
    assert share_limits([0.5]) == (0.0, 1.0)


def test_shares_alone_are_limited_by_what_every_distribution_allows() -> None:
    unseen = 1 - 0.025 ** (1 / 3)
    found = share_interval([0.1, 0.2, 0.3])
    assert found == pytest.approx((0.2, 0.1 * (1 - unseen), 0.3 * (1 - unseen) + unseen))
    assert share_interval([1.0, 1.0, 0.9]).high == 1.0


def test_limits_are_one_sided() -> None:
    unseen = 1 - 0.05 ** (1 / 3)
    limits = (0.1 * (1 - unseen), 0.3 * (1 - unseen) + unseen)
    assert share_limits([0.1, 0.2, 0.3]) == pytest.approx(limits)
    values = np.linspace(0.01, 0.05, 20)
    _, low, high = share_interval(values, windows=4000)
    at_least, at_most = share_limits(values, windows=4000)
    assert low < at_least < 0.03 < at_most < high
    assert (low, high) == studentised_limits(values, 0.025)
    assert at_least == studentised_limits(values, 0.05)[0]


def test_what_no_window_showed_limits_what_the_runs_agree_in() -> None:
    unseen = 1 - 0.025 ** (1 / 400)
    for rate in (0.0, 0.0002, 0.4, 1.0):
        found = share_interval([rate] * 10, windows=400)
        ends = (rate * (1 - unseen), rate * (1 - unseen) + unseen)
        assert found == pytest.approx((rate, *ends))


def test_a_side_without_a_bootstrap_has_a_limit_still() -> None:
    # Nine of ten runs without a miss: a third of the resamples have none either.
    values = [0.0] * 9 + [0.1]
    assert studentised_limits(values, 0.025)[1] == math.inf
    found = share_interval(values, windows=100_000)
    half = float(stats.t.ppf(0.975, 9)) * 0.01
    assert 0.01 + half < found.high < 0.1
    mirrored = share_interval([1 - value for value in values], windows=100_000)
    assert (mirrored.low, mirrored.high) == pytest.approx((1 - found.high, 1 - found.low))


def test_limits_of_skewed_rates_keep_their_promise() -> None:
    """Rates of 2.4 % on average, in most runs less: 19 upper limits of 20 are above that."""
    shape, runs, samples = 0.5, 20, 300
    rates = np.random.default_rng(11).beta(shape, 20, size=(samples, runs))
    mean = shape / (shape + 20)
    kept = sum(share_limits(row, windows=100_000)[1] >= mean for row in rates)
    quantile = stats.t.ppf(0.95, runs - 1)
    errors = rates.std(axis=1, ddof=1) / math.sqrt(runs)
    student = int((rates.mean(axis=1) + quantile * errors >= mean).sum())
    three_sigma = 3 * math.sqrt(0.95 * 0.05 * samples)
    assert kept >= 0.95 * samples - three_sigma
    assert student < 0.95 * samples - three_sigma


@pytest.mark.parametrize(
    ("values", "windows", "verdict"),
    [
        ([0.0] * 10, None, "not shown"),
        ([0.0] * 5 + [0.0002] * 5, None, "not shown"),
        ([0.0] * 58, None, "not shown"),
        ([0.0] * 59, None, "under"),
        ([1.0] * 4, None, "over"),
        ([0.0] * 10, 400, "under"),
        ([0.0] * 5 + [0.0002] * 5, 400, "under"),
        ([0.0] * 2, 50, "not shown"),
        ([0.0] * 2, 60, "under"),
        ([0.03], 4000, "not shown"),
        ([0.01, 0.02, 0.03] * 7, 4000, "under"),
        ([0.04, 0.05, 0.06] * 7, 4000, "not shown"),
        ([0.06, 0.07, 0.08] * 7, 4000, "over"),
    ],
)
def test_under_is_said_where_the_limit_says_so(
    values: Sequence[float], windows: int | None, verdict: str
) -> None:
    assert under(values, windows=windows) == verdict


def test_another_limit_may_be_asked_for() -> None:
    values = [0.01, 0.02, 0.03] * 7
    assert under(values, 0.02, windows=4000) == "not shown"
    assert under(values, 0.01, windows=4000) == "over"
    assert under([0.0] * 20, 0.14) == "under"


RATES = st.lists(st.floats(0, 0.12) | st.sampled_from([0.0, 0.04, 1.0]), min_size=1, max_size=24)


@given(RATES, st.none() | st.integers(1, 60), st.data())
def test_fewer_misses_never_take_the_word_away(
    values: list[float], windows: int | None, data: st.DataObject
) -> None:
    each = windows or 0
    limit = data.draw(st.sampled_from([0.03, 0.05, 0.1]))
    lower = [data.draw(st.sampled_from([0.0, 0.5, 1.0])) * value for value in values]
    longer = [*values, 0.0]
    before = share_limits(values, windows=each * len(values) or None)
    for fewer in (lower, longer):
        after = share_limits(fewer, windows=each * len(fewer) or None)
        assert after[1] <= before[1] + 1e-12
        if under(values, limit, windows=each * len(values) or None) == "under":
            word = under(fewer, limit, windows=each * len(fewer) or None)
            assert word == "under" or after[1] == pytest.approx(limit, abs=1e-12)


def test_the_limit_is_above_the_bootstraps_where_few_runs_agree() -> None:
    values = [0.030, 0.032, 0.034, 0.036, 0.038]
    at_most = share_limits(values, windows=100_000)[1]
    assert studentised_limits(values, 0.05)[1] < at_most < 1.2 * max(values)


@pytest.mark.parametrize("runs", [2, 5, 20, 59])
def test_no_miss_at_all_is_limited_by_the_rule_of_three(runs: int) -> None:
    limit = rule_of_three(runs)
    assert (1 - limit) ** runs == pytest.approx(0.05)
    assert limit <= 3 / runs
    assert share_limits([0.0] * runs) == (0.0, limit)
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


@given(st.lists(st.floats(0, 1), min_size=2, max_size=30), st.none() | st.integers(30, 10_000))
def test_intervals_of_shares_hold_the_mean(values: Sequence[float], windows: int | None) -> None:
    value, low, high = share_interval(values, windows=windows)
    at_least, at_most = share_limits(values, windows=windows)
    assert 0 <= low <= value + 1e-12
    assert value - 1e-12 <= high <= 1
    assert low - 1e-12 <= at_least <= at_most <= 1


# --------------------------------------------------------------------- differences of shares

ALL, NONE = [1.0] * 12, [0.0] * 12
SOME = [0.031, 0.033, 0.034, 0.031, 0.035, 0.037, 0.032, 0.033, 0.031, 0.034, 0.033, 0.032]


def test_a_difference_is_known_no_better_than_its_parts() -> None:
    for windows in (None, 400):
        value, low, high = share_difference_interval(ALL, SOME, windows=windows)
        assert value == pytest.approx(1 - np.mean(SOME))
        # What the first part did not show is open of the difference, too.
        least = share_interval(ALL, windows=windows).low
        alone = mean_interval(1 - np.array(SOME))
        assert low == pytest.approx(alone.low - (1 - least))
        assert high == pytest.approx(alone.high)
        mirrored = share_difference_interval(SOME, ALL, windows=windows)
        assert (mirrored.low, mirrored.high) == pytest.approx((-high, -low))


def test_a_part_without_a_miss_opens_the_other_side() -> None:
    low, high = share_difference_interval(NONE, SOME)[1:]
    alone = mean_interval(-np.array(SOME))
    assert low == pytest.approx(alone.low)
    assert high == pytest.approx(alone.high + share_interval(NONE).high)


def test_shares_that_were_always_all_or_none_may_differ_in_a_run_to_come() -> None:
    for windows in (None, 400):
        p = 1 - 0.025 ** (1 / (windows or 12))
        for mine in (ALL, NONE, SOME):
            found = share_difference_interval(mine, mine, windows=windows)
            assert found == pytest.approx((0.0, -p, p)) or mine != SOME
        found = share_difference_interval(ALL, NONE, windows=windows)
        assert found == pytest.approx((1.0, 1 - 2 * p, 1.0))


def test_one_pair_has_no_interval() -> None:
    found = share_difference_interval([0.5], [0.25])
    assert (found.value, found.known) == (0.25, False)


def test_rates_of_which_every_run_shows_some_have_the_bootstrap_of_their_differences() -> None:
    rng = np.random.default_rng(3)
    first, second = rng.beta(20, 60, 20), rng.beta(20, 60, 20)
    assert share_difference_interval(first, second) == mean_interval(first - second)


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1)), min_size=2, max_size=8))
def test_it_lies_in_its_range_and_holds_the_mean(pairs: list[tuple[float, float]]) -> None:
    value, low, high = share_difference_interval(*map(list, zip(*pairs, strict=True)))
    assert -1 <= low <= value + 1e-12
    assert value - 1e-12 <= high <= 1


def test_it_covers_where_a_part_seldom_shows_what_it_can() -> None:
    """One run in ten misses fewer; the bootstrap of the differences alone holds 68 of 100."""
    rng = np.random.default_rng(5)
    truth, held = 0.95 - 20 / 600, 0
    for _ in range(200):
        first = np.where(rng.random(12) < 0.1, rng.random(12), 1.0)
        low, high = share_difference_interval(first, rng.beta(20, 580, 12))[1:]
        held += low <= truth <= high
    assert held >= 190


def test_what_is_open_of_either_part_is_open_of_their_difference() -> None:
    some, none = np.linspace(0.09, 0.11, 20), np.zeros(20)
    least, most = studentised_limits(some, 0.025)
    unseen = share_interval(none, windows=400).high
    _, low, high = share_difference_interval(some, none, windows=400)
    assert (low, high) == pytest.approx((least - unseen, most))
    _, low, high = share_difference_interval(none, some, windows=400)
    assert (low, high) == pytest.approx((-most, unseen - least))
