"""Paired differences: hand examples, SciPy's own permutation test, and simulated coverage."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from dwell.errors import SimulationError
from dwell.study.intervals import mean_interval
from dwell.study.pairs import (
    EXACT_PAIRS,
    FLIPS,
    PairedDifference,
    paired_difference,
    paired_median,
    sign_flip_p,
)

INF = math.inf
# Sums of whole numbers are exact, so that ties are ties.
wholes = st.lists(st.integers(-20, 20), min_size=1, max_size=10)


def naive_p(differences: Sequence[float]) -> float:
    """All 2^n assignments of signs, one by one."""
    observed = abs(sum(differences))
    flips = itertools.product((-1, 1), repeat=len(differences))
    sums = [abs(sum(s * d for s, d in zip(signs, differences, strict=True))) for signs in flips]
    return sum(total >= observed for total in sums) / len(sums)


def test_a_difference_has_its_interval_and_effects() -> None:
    first, second = [1.0, 2.0, 3.0, 5.0, 4.0], [2.0, 4.0, 3.0, 4.0, 8.0]
    found = paired_difference(first, second)
    differences = np.array([-1.0, -2.0, 0.0, 1.0, -4.0])
    assert (found.mean, found.low, found.high) == mean_interval(differences)
    assert found.n == 5
    assert found.direction == -1
    # Lower in three, equal in one, of five.
    assert found.superiority == pytest.approx(0.7)
    # J(4) = Γ(2) / (√2 Γ(3/2)), by hand.
    correction = 1 / (math.sqrt(2) * math.sqrt(math.pi) / 2)
    assert correction == pytest.approx(0.7979, abs=1e-4)
    assert found.d_z == pytest.approx(-1.2 / np.std(differences, ddof=1) * correction)
    assert found.p == naive_p(differences.tolist())


def test_swapping_the_pair_turns_everything_round() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.lognormal(size=(2, 20))
    there, back = paired_difference(first, second), paired_difference(second, first)
    assert back.mean == -there.mean
    assert back.d_z == pytest.approx(-there.d_z)
    assert back.superiority == pytest.approx(1 - there.superiority)
    assert back.p == there.p
    assert (back.low, back.high) == pytest.approx((-there.high, -there.low))


def test_the_same_pairs_have_the_same_numbers() -> None:
    first, second = np.random.default_rng(2).normal(size=(2, 40))
    assert paired_difference(first, second) == paired_difference(first, second)
    other = paired_difference(first, second, seed=2)
    assert other.p != paired_difference(first, second).p
    assert other.p == pytest.approx(paired_difference(first, second).p, abs=0.02)


def test_a_single_pair_shows_nothing() -> None:
    found = paired_difference([1.0], [3.0])
    assert (found.mean, found.superiority, found.p, found.n) == (-2.0, 1.0, 1.0, 1)
    assert np.isnan([found.low, found.high, found.d_z]).all()


def test_pairs_that_are_equal_have_no_difference() -> None:
    # 0.1 + 0.2 is not 0.3 to a computer; that is no difference either.
    found = paired_difference([0.1 + 0.2, 1.0, 7.0], [0.3, 1.0, 7.0])
    assert found == PairedDifference(0.0, 0.0, 0.0, 0.0, 0.5, 1.0, 3)
    assert found.direction == 0


def test_the_same_difference_everywhere_has_no_width() -> None:
    second = np.array([0.3, 0.7, 1.1, 5.9, 2.3, 8.1])
    found = paired_difference(second - 0.1, second)
    assert found.mean == pytest.approx(-0.1)
    assert found.low == found.mean == found.high
    assert found.d_z == -INF
    assert found.superiority == 1.0
    assert found.p == 2 / 2**6


def test_two_pairs_have_no_standardised_difference() -> None:
    found = paired_difference([1.0, 2.0], [2.0, 5.0])
    assert math.isnan(found.d_z)
    assert found.p == 0.5
    assert found.low < -2 < found.high


@pytest.mark.parametrize("bad", [INF, -INF])
def test_infinity_has_no_mean(bad: float) -> None:
    with pytest.raises(SimulationError, match=r"second\[1\] is -?inf.*paired_median"):
        paired_difference([1.0, 2.0], [3.0, bad])


@pytest.mark.parametrize("compare", [paired_difference, paired_median])
def test_what_is_no_pair_is_refused(compare: type) -> None:
    with pytest.raises(SimulationError, match=r"shape \(2,\), second \(1,\)"):
        compare([1.0, 2.0], [3.0])
    with pytest.raises(SimulationError, match="at least 1"):
        compare([], [])
    with pytest.raises(SimulationError, match=r"first\[0\] is NaN"):
        compare([math.nan], [3.0])


def test_a_median_of_differences_may_be_infinite() -> None:
    first = [1.0, 2.0, 3.0, 4.0, INF, 6.0, 7.0, 8.0]
    second = [2.0, 3.0, INF, INF, INF, INF, INF, 9.0]
    found = paired_median(first, second)
    # Sorted: four infinities below, then -1 three times, and the tie of two infinities.
    assert (found.median, found.low, found.high) == (-INF, -INF, 0.0)
    assert found.superiority == 7.5 / 8
    assert found.p == 2 / 2**7
    assert (found.direction, found.n) == (-1, 8)


def test_a_median_of_ties_shows_nothing() -> None:
    found = paired_median([INF, 1.0], [INF, 1.0])
    assert (found.median, found.superiority, found.p, found.direction) == (0.0, 0.5, 1.0, 0)


# ---------------------------------------------------------------------------- the sign-flip test


@given(wholes)
def test_all_flips_are_counted(differences: Sequence[int]) -> None:
    assert sign_flip_p(differences) == naive_p(differences)


@given(wholes, st.integers(0, 3))
def test_zeros_change_nothing(differences: Sequence[int], zeros: int) -> None:
    assert sign_flip_p([*differences, *[0] * zeros]) == sign_flip_p(differences)


def test_rounding_breaks_no_tie() -> None:
    # 0.1 + 0.2 - 0.3 is not 0 to a computer: of the 8 sums, 2 are ± 0.6, as far as the one seen.
    assert sign_flip_p([0.1, 0.2, 0.3]) == 2 / 8
    # ± (0.3 + 0.1 - 0.2) = 0.2 is reached by 0.1 + 0.2 + 0.3, ± 0.1 + ... : all but the two zeros.
    assert sign_flip_p([0.3, 0.1, -0.2]) == 6 / 8
    assert sign_flip_p([0.3, -0.1, -0.2]) == 1.0


@pytest.mark.parametrize("count", [7, 12])
def test_scipy_agrees(count: int) -> None:
    differences = np.random.default_rng(count).normal(0.5, size=count)
    oracle = stats.permutation_test(
        (differences,),
        np.mean,
        permutation_type="samples",
        vectorized=True,
        n_resamples=np.inf,
        axis=-1,
    )
    assert sign_flip_p(differences) == pytest.approx(oracle.pvalue)


def test_the_least_p_is_two_in_all_flips() -> None:
    assert sign_flip_p([1.0] * 5) == 2 / 2**5 > 0.05
    assert sign_flip_p([1.0] * EXACT_PAIRS) == 2.0 ** (1 - EXACT_PAIRS)
    # Drawn flips never show a p of 0.
    assert sign_flip_p([1.0] * (EXACT_PAIRS + 10)) == 1 / (FLIPS + 1)


def test_drawn_flips_come_near_counted_ones() -> None:
    """31 pairs are drawn; with one of them 0, they are the 30 that are counted."""
    differences = np.random.default_rng(3).normal(0.3, size=EXACT_PAIRS)
    exact = sign_flip_p(differences)
    assert sign_flip_p([*differences, 0.0]) == exact
    drawn = sign_flip_p([*differences, 1e-9])
    assert 0.02 < exact < 0.5
    assert drawn == pytest.approx(exact, abs=4 * math.sqrt(exact * (1 - exact) / FLIPS))


def test_no_difference_is_found_as_often_as_stated() -> None:
    rng = np.random.default_rng(4)
    found = [sign_flip_p(row) for row in rng.normal(size=(1000, 10))]
    hits = sum(p <= 0.05 for p in found)
    assert abs(hits - 50) <= 3 * math.sqrt(1000 * 0.05 * 0.95)


@given(st.lists(st.floats(-1, 1), min_size=2, max_size=16), st.floats(0.01, 100))
def test_p_does_not_know_the_unit(differences: Sequence[float], scale: float) -> None:
    assume(np.abs(differences).max() > 1e-6)
    scaled = sign_flip_p(np.asarray(differences) * scale)
    assert scaled == pytest.approx(sign_flip_p(differences))
    assert 2 / 2 ** len(differences) <= scaled <= 1


# ------------------------------------------------------------------------------------ coverage


def test_intervals_of_skewed_differences_keep_their_promise() -> None:
    """A second policy that adds a skewed number of misses: 20 seeds, the mean is inside 95 %."""
    samples, seeds, mean = 400, 20, 0.5 / 20.5
    rng = np.random.default_rng(6)
    luck = rng.normal(size=(samples, seeds))
    added = rng.beta(0.5, 20, size=(samples, seeds))
    kept = percentile = 0
    weights = rng.multinomial(seeds, [1 / seeds] * seeds, size=2000) / seeds
    for base, more in zip(luck, added, strict=True):
        found = paired_difference(base + more, base)
        kept += found.low <= mean <= found.high
        low, high = np.quantile(weights @ more, (0.025, 0.975))
        percentile += low <= mean <= high
    three_sigma = 3 * math.sqrt(samples * 0.95 * 0.05)
    assert abs(kept - 0.95 * samples) <= three_sigma
    assert percentile < 0.95 * samples - three_sigma
