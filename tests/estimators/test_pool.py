"""Pools: what they hold, what another regime is, and what is taken over from others."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from dwell.estimators.pool import (
    ENOUGH,
    LARGEST,
    LEAST,
    PlaceSums,
    Pool,
    Reference,
    middle,
    newest,
)

Floats = NDArray[np.float64]

MEMORY = 12.0
BLOCK = 100


def about(mean: float, count: int, seed: int = 1) -> Floats:
    """Lognormal times, spread as evenly as can be, in an order of their own."""
    places = np.random.default_rng(seed).permutation((np.arange(count) + 0.5) / count)
    times: Floats = stats.lognorm.ppf(places, 0.1, scale=mean)
    return times


def drawn(rng: np.random.Generator, count: int, rho: float = 0.0) -> Floats:
    """Lognormal times about 10 ms, each like the one before."""
    normal = rng.standard_normal(count)
    for i in range(1, count if rho else 0):
        normal[i] = rho * normal[i - 1] + math.sqrt(1 - rho**2) * normal[i]
    times: Floats = 10.0 * np.exp(0.2 * normal)
    return times


def lossy(values: Floats, share: float) -> Floats:
    """Values of which some are lost, as evenly as can be."""
    lost = np.diff(np.floor(np.arange(len(values) + 1) * share)) > 0
    return np.where(lost, math.inf, values)


def pool(values: Floats | list[float], additive: bool = False) -> Pool:
    return Pool(Reference(np.array(values, float), BLOCK), additive)


def fresh(mean: float = 10.0) -> Pool:
    return pool(about(mean, 2400))


# ------------------------------------------------------------------------------ what it holds


def test_it_begins_as_declared() -> None:
    values = about(10.0, 2400)
    values[:240] = math.inf
    one = pool(values)
    assert one.is_declared
    assert (one.last, one.measured, one.touched, len(one.held)) == (0, 0, 0, 0)
    assert (one.usual, one.lost, one.error_ms) == (middle(values), 0.1, 0.0)
    assert repr(one) == "<Pool: as declared>"


def test_values_are_held_in_their_order_and_forgotten() -> None:
    one = fresh()
    windows = [about(10.0, 5, window) for window in range(20)]
    for window, values in enumerate(windows, 1):
        assert one.learn(values, window, MEMORY) is False
        kept = windows[max(window - 12, 0) : window]
        np.testing.assert_array_equal(one.held, np.concatenate(kept))
        assert (one.measured, one.last, one.touched) == (len(one.held), window, 0)
    assert one.usual == one.reference.usual


def test_it_holds_the_newest_of_many() -> None:
    one = fresh()
    for window in range(1, 6):
        one.learn(about(10.0, 90, window), window, MEMORY)
    np.testing.assert_array_equal(
        one.held, np.concatenate([about(10.0, 90, window) for window in (4, 5)])
    )


@pytest.mark.parametrize("count", [LARGEST + 1, 100_000, 1_000_000])
def test_of_a_huge_window_it_takes_an_even_share(count: int) -> None:
    one = pool([10.0] * 256)
    one.learn(np.linspace(9.0, 11.0, count), 1, MEMORY)
    assert 0 < len(one.held) <= LARGEST
    assert (one.held.min(), one.held.max()) == pytest.approx((9.0, 11.0), abs=0.1)


def test_a_window_that_is_overwritten_changes_nothing() -> None:
    table = np.ones((1000, 4))
    one = pool([1.0] * 256)
    one.learn(table[:, 2], 1, MEMORY)
    table[:] = 7.0
    assert set(one.held) == {1.0}


def test_the_last_few_are_kept_however_old() -> None:
    one = fresh()
    for window, count in ((1, 8), (2, 8), (50, 3)):
        one.learn(about(10.0, count, window), window, MEMORY)
    # All 19 are kept: without the oldest 8 they would be fewer than are enough.
    assert len(one.held) == 19 < 8 + ENOUGH


@given(
    st.lists(
        st.tuples(st.integers(1, 300), st.sampled_from([1.0, 1.0, 3.0, math.inf]), st.booleans()),
        max_size=30,
    ),
    st.sampled_from([0.01, 3.0, MEMORY, 1e6]),
    st.booleans(),
)
def test_it_is_bounded_whatever_it_is_given(
    windows: list[tuple[int, float, bool]], memory: float, additive: bool
) -> None:
    one = pool(about(10.0, 256), additive)
    for window, (count, factor, skipped) in enumerate(windows, 1):
        if skipped:
            continue
        one.learn(about(10.0, count, window) * factor, window, memory)
        assert 0 <= one.measured <= len(one.held) <= LARGEST
        assert one.last == window
        assert one.touched == (0 if one.is_declared else window)
        assert one.is_declared or len(one.held)
        assert not np.isnan(one.held).any()


# ------------------------------------------------------------------------------------ regimes


def test_another_regime_drops_all_that_was() -> None:
    one = fresh()
    one.learn(about(10.0, 100, 1), 1, MEMORY)
    assert one.learn(about(20.0, 100, 2), 2, MEMORY) is True
    np.testing.assert_array_equal(one.held, about(20.0, 100, 2))
    assert (one.is_declared, one.measured, one.touched) == (False, 100, 2)
    assert one.usual == np.median(one.held)
    assert repr(one) == f"<Pool: 100 values, {one.usual:g} ms>"
    assert one.learn(about(40.0, 100, 3), 3, MEMORY) is True
    np.testing.assert_array_equal(one.held, about(40.0, 100, 3))


def test_more_of_the_same_regime_is_added() -> None:
    one = fresh()
    one.learn(about(20.0, 50, 1), 1, MEMORY)
    assert one.learn(about(20.0, 50, 2), 2, MEMORY) is False
    assert (one.measured, one.touched) == (100, 2)
    assert one.held.std() / 10 <= one.error_ms <= one.held.std()


@pytest.mark.parametrize("count", [12, 50, 200])
def test_the_error_is_that_of_the_95th_percentile(count: int) -> None:
    known = np.sort(about(20.0, 100_000))
    within = 0
    for seed in range(100):
        one = fresh()
        one.learn(about(20.0, count, seed), 1, MEMORY)
        within += bool(
            abs(np.quantile(one.held, 0.95) - np.quantile(known, 0.95)) <= 2 * one.error_ms
        )
    assert within >= 90


def test_a_first_cold_job_is_gone_from_the_second_window_on() -> None:
    times = [about(300.0, 20, seed) for seed in range(3)]
    for cold in ([700.0, *times[0]], [700.0]):
        one = fresh(200.0)
        for window, values in enumerate([cold, times[1], times[2]], 1):
            one.learn(np.array(values), window, MEMORY)
            if window > 1:
                assert not one.is_declared
                assert one.held.max() < 700.0


def test_later_jobs_and_late_messages_are_not_cold() -> None:
    one = fresh(200.0)
    one.learn(about(300.0, 20), 1, MEMORY)
    one.learn(np.array([700.0, *about(300.0, 20)]), 2, MEMORY)
    assert one.held.max() == 700.0
    one = pool(about(20.0, 2400), additive=True)
    one.learn(np.array([70.0, *about(30.0, 20)]), 1, MEMORY)
    assert one.held.max() == 70.0


@pytest.mark.parametrize("begins", [False, True])
def test_a_change_is_seen_as_soon_where_decisions_are_closer(begins: bool) -> None:
    """In one window of five values, or in four stretches of it."""
    for seed in range(10):
        seen = []
        for stretches in (1, 4):
            one = fresh()
            if begins:
                one.learn(about(20.0, 50, 99), 1, MEMORY, 100)
            values = np.array_split(about(40.0, 8, seed), stretches)
            changed = [one.learn(v, 2, MEMORY, 100 // stretches) for v in values]
            seen.append(any(changed))
            assert one.usual == pytest.approx(40.0, rel=0.2)
        assert seen == [True, True]


@pytest.mark.parametrize("additive", [False, True])
@pytest.mark.parametrize("count", [2, 3, 5, 100])
def test_what_was_as_declared_is_so_again(count: int, additive: bool) -> None:
    one = pool(about(10.0, 2400), additive)
    one.learn(about(20.0, 100, 1), 1, MEMORY)
    back = [one.learn(about(10.0, count, 2), window, MEMORY) for window in (2, 3)]
    assert True in back
    assert one.is_declared
    assert (one.usual, one.touched) == (one.reference.usual, 0)


@pytest.mark.parametrize("ms", [[40.0, 41.0], [40.0, 41.0, 42.0], [2.0, 2.1], [2.0, 2.1, 2.2]])
def test_two_values_beyond_everything_are_another_regime(ms: list[float]) -> None:
    assert fresh().learn(np.array(ms), 1, MEMORY) is True


def test_single_values_beyond_everything_are_put_together() -> None:
    one = fresh()
    assert one.learn(np.array([30.0]), 1, MEMORY) is False
    assert one.learn(np.array([31.0]), 7, MEMORY) is True
    assert (one.is_declared, one.touched) == (False, 7)
    assert (one.measured, one.held[-2:].tolist()) == (2, [30.0, 31.0])


def test_a_handful_of_slightly_slow_ones_among_many_is_no_other_regime() -> None:
    times = about(10.0, 100, 2)
    times[:4] *= 1.2
    assert fresh().learn(times, 1, MEMORY) is False


def test_a_slow_drift_is_found_by_what_is_held() -> None:
    one = fresh()
    for window in range(1, 40):
        # None of the windows says it by itself.
        assert fresh().learn(about(10.7, 5, window), 1, MEMORY) is False
        if one.learn(about(10.7, 5, window), window, 1e6):
            break
    assert not one.is_declared
    assert (one.measured, one.touched) == (5 * window, window)
    assert one.usual == pytest.approx(10.7, rel=0.03)


def test_few_values_get_the_declared_shape() -> None:
    one = fresh()
    assert one.learn(np.array([20.0, 21.0, 22.0]), 1, MEMORY) is True
    assert one.measured == 3
    assert len(one.held) == ENOUGH + 3
    assert one.held[-3:].tolist() == [20.0, 21.0, 22.0]
    shape = np.log(one.held[:-3] / 21.0)
    assert np.median(shape) == pytest.approx(0.0, abs=0.1)
    assert np.std(shape) == pytest.approx(0.1, rel=0.5)


def test_the_delays_of_messages_are_shifted_not_stretched() -> None:
    one = pool(about(1.0, 2400), additive=True)
    one.learn(np.array([26.0, 26.0]), 1, MEMORY)
    assert np.std(one.held) < 0.15
    assert one.moved(0.5).min() >= 0.0


def test_a_job_that_took_nothing_is_shifted() -> None:
    one = pool([0.0] * 256)
    assert one.learn(np.array([5.0, 5.0, 5.0]), 1, MEMORY) is True
    assert set(one.held) == {5.0}


def test_equal_values_are_of_one_regime_and_any_other_of_another() -> None:
    one = pool([3.0] * 2400)
    assert one.reference.likeness == 0.0
    for window in range(1, 40):
        assert one.learn(np.full(5, 3.0), window, MEMORY) is False
    assert one.learn(np.full(2, 3.1), 40, MEMORY) is True
    assert one.learn(np.full(2, 3.1), 41, MEMORY) is False
    assert one.learn(np.full(5, 3.0), 42, MEMORY) is True
    assert one.is_declared


def test_a_part_of_which_nothing_is_declared_is_what_is_measured() -> None:
    one = pool([])
    assert (one.usual, one.lost) == (math.inf, 0.0)
    assert one.learn(np.array([2.0, 1.0]), 1, MEMORY) is True
    assert one.learn(np.array([9.0]), 2, MEMORY) is False
    assert (one.held.tolist(), one.touched) == ([2.0, 1.0, 9.0], 2)


def test_a_few_usual_values_end_no_regime_that_has_such_values() -> None:
    rng = np.random.default_rng(3)
    one = fresh()
    late = np.where(rng.random(4000) < 0.7, 90.0, 0.0)
    values = about(10.0, 4000) + late
    assert one.learn(values[:100], 1, MEMORY)
    for window, value in enumerate(values[100:], 2):
        assert one.learn(np.array([value]), window, 240.0) is False
    # Where the cause is gone, they do.
    back = [one.learn(about(10.0, 5, w), w, 240.0) for w in range(4000, 4006)]
    assert True in back


# ------------------------------------------------------------------------------------- losses


def test_losing_everything_is_a_regime_and_so_is_the_recovery() -> None:
    one = fresh()
    assert one.learn(np.full(5, math.inf), 1, MEMORY) is True
    assert (one.lost, one.usual, one.error_ms) == (1.0, math.inf, 0.0)
    assert one.learn(np.full(5, math.inf), 2, MEMORY) is False
    assert one.learn(about(10.0, 5, 3), 3, MEMORY) is True
    assert (one.is_declared, one.lost) == (True, 0.0)


def test_a_share_of_losses_is_kept_as_it_is() -> None:
    one = fresh()
    times = lossy(about(10.0, 100), 0.2)
    assert one.learn(times, 1, MEMORY) is True
    assert one.lost == 0.2
    assert one.usual == middle(times)


def test_losses_that_are_declared_are_no_other_regime() -> None:
    rng = np.random.default_rng(5)

    def times(count: int) -> Floats:
        return np.where(rng.random(count) < 0.1, math.inf, drawn(rng, count))

    one = pool(times(2400))
    assert not any(one.learn(times(100), window, MEMORY) for window in range(1, 100))


def test_what_is_declared_to_lose_everything_can_recover() -> None:
    one = pool([math.inf] * 256)
    assert one.usual == math.inf
    assert one.learn(np.full(5, math.inf), 1, MEMORY) is False
    assert one.learn(np.array([1.0, 2.0, 3.0, 2.0]), 2, MEMORY) is True
    assert one.held.tolist() == [1.0, 2.0, 3.0, 2.0]


# ------------------------------------------------------------------------------- false changes


def changes(rho: float, width: int, windows: int, seed: int) -> int:
    """How often values of the declared distribution are thought to be of another one."""
    rng = np.random.default_rng(seed)
    one = pool(drawn(rng, 2400, rho))
    values = drawn(rng, width * windows, rho).reshape(windows, width)
    return sum(one.learn(mine, window, MEMORY) for window, mine in enumerate(values, 1))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("width", [1, 5, 100])
def test_what_is_as_declared_is_practically_never_another_regime(width: int, seed: int) -> None:
    assert changes(0.0, width, 2000, seed) <= 4


@pytest.mark.parametrize(("rho", "least"), [(0.5, 0.01), (0.9, 0.1), (0.98, 0.3)])
def test_values_that_are_alike_are_not_either(rho: float, least: float) -> None:
    reference = Reference(drawn(np.random.default_rng(0), 2400, rho), BLOCK)
    assert least < reference.likeness < 0.7
    # Were they thought to be independent, every tenth window and more would be.
    assert sum(changes(rho, 100, 400, seed) for seed in range(3)) <= 12


def test_independent_values_are_not_alike() -> None:
    for seed in range(9):
        values = drawn(np.random.default_rng(seed), 2400)
        assert Reference(values, BLOCK).likeness < 0.01


# -------------------------------------------------------------------------- where others changed


def test_a_job_is_slowed_as_its_witness_is() -> None:
    witness, one = fresh(10.0), fresh(30.0)
    witness.learn(about(15.0, 100), 1, MEMORY)
    one.follow(witness, 2)
    assert one.usual == pytest.approx(30.0 * witness.usual / witness.reference.usual)
    assert (one.is_declared, one.measured, one.touched, one.last) == (False, 0, 2, 0)
    assert one.error_ms > one.held.std()


def test_a_message_gets_the_extra_delay_and_the_losses_of_its_witness() -> None:
    witness, one = (pool(about(ms, 2400), additive=True) for ms in (2.0, 5.0))
    witness.learn(lossy(about(22.0, 100), 0.3), 1, MEMORY)
    one.follow(witness, 1)
    assert one.usual == pytest.approx(25.0, rel=0.02)
    assert one.lost == pytest.approx(0.3)
    # No delay is ever less than declared for it.
    faster = pool(about(2.0, 2400), additive=True)
    faster.learn(about(0.5, 100), 1, MEMORY)
    one.follow(faster, 2)
    assert (one.usual, one.lost) == (one.reference.usual, 0.0)


def test_where_the_witness_loses_everything_so_does_a_message() -> None:
    witness, one = (pool(lossy(about(2.0, 2400), share), additive=True) for share in (0.0, 0.1))
    witness.learn(np.full(9, math.inf), 1, MEMORY)
    one.follow(witness, 1)
    assert one.lost == 1.0


def test_a_job_beside_one_that_ends_no_more_keeps_its_time() -> None:
    witness, one = fresh(), fresh(30.0)
    witness.learn(np.full(9, math.inf), 1, MEMORY)
    one.follow(witness, 1)
    assert one.usual == one.reference.usual


def test_a_witness_that_is_as_declared_again_says_so() -> None:
    witness, one = fresh(), fresh(30.0)
    for mean in (20.0, 10.0):
        witness.learn(about(mean, 100), 1, MEMORY)
        one.follow(witness, 1)
        assert one.is_declared == witness.is_declared == (mean == 10.0)


def test_nothing_follows_where_nothing_usual_is_declared() -> None:
    witness, one = fresh(), pool([math.inf] * 256)
    witness.learn(about(20.0, 100), 1, MEMORY)
    one.follow(witness, 1)
    assert one.is_declared
    lost = pool([math.inf] * 256)
    lost.learn(about(20.0, 100), 1, MEMORY)
    follower = fresh()
    follower.follow(lost, 1)
    assert follower.is_declared


def test_a_follower_that_is_measured_forgets_what_it_followed() -> None:
    witness, one = fresh(), fresh(30.0)
    witness.learn(about(20.0, 100), 1, MEMORY)
    one.follow(witness, 1)
    one.learn(about(60.0, 50), 2, MEMORY)
    np.testing.assert_array_equal(one.held, about(60.0, 50))
    assert one.measured == 50


# ----------------------------------------------------------------------------------- the shift


@given(st.lists(st.floats(0.1, 9.0), min_size=1), st.lists(st.floats(0.1, 9.0), min_size=1))
def test_shifts_add_up(first: list[float], second: list[float]) -> None:
    known = np.sort(about(5.0, 100))
    one, other = (PlaceSums.among(np.array(values), known) for values in (first, second))
    both = PlaceSums.among(np.array(first + second), known)
    for found, expected in ((one + other, both), (both - other, one)):
        assert found.size == expected.size
        for name in ("larger", "smaller", "places"):
            assert getattr(found, name) == pytest.approx(getattr(expected, name))


@pytest.mark.parametrize("size", [2, 5, 100])
@pytest.mark.parametrize("deviation", [2.0, 3.0, 4.0])
def test_deviations_are_those_of_fishers_method(size: int, deviation: float) -> None:
    larger = float(stats.gamma.isf(stats.norm.sf(deviation), size))
    shift = PlaceSums(size, larger, 0.0, size / 2)
    assert shift.deviations(0.0) == pytest.approx(deviation, abs=0.1)
    # Values that are all the same count as one; of several windows only those of each are alike.
    assert shift.deviations(1.0) == pytest.approx(shift.deviations(0.0) / math.sqrt(size))
    assert shift.deviations(1.0, together=1) == shift.deviations(0.0)


def test_no_values_are_no_deviation() -> None:
    assert PlaceSums(0, 0.0, 0.0, 0.0).deviations(0.0) == 0.0


# ---------------------------------------------------------------------- changes within a window


def windows(count: int) -> Iterator[Floats]:
    rng = np.random.default_rng(9)
    for _ in range(1000):
        yield drawn(rng, count)


@pytest.mark.parametrize("factor", [0.3, 3.0, math.inf])
@pytest.mark.parametrize("quarter", [1, 2, 3])
@pytest.mark.parametrize("count", [48, 100, 1000])
def test_a_change_within_a_window_is_found(count: int, quarter: int, factor: float) -> None:
    at = quarter * count // 4
    for values in (one for one, _ in zip(windows(count), range(50), strict=False)):
        values[at:] *= factor
        assert newest(values) == at


def test_of_a_change_between_quarters_the_nearest_is_found() -> None:
    values = next(windows(100))
    values[56:] *= 5.0
    assert newest(values) == 50


@pytest.mark.parametrize("count", [LEAST, 100])
def test_independent_values_have_no_change(count: int) -> None:
    assert sum(newest(values) > 0 for values in windows(count)) == 0


@pytest.mark.parametrize("values", [[], [1.0], [1.0] * 8 + [9.0] * (LEAST - 9), [5.0] * 100])
def test_few_values_or_equal_ones_have_no_change(values: list[float]) -> None:
    assert newest(np.array(values, float)) == 0


def test_another_regime_begins_with_the_newest_of_a_window() -> None:
    one = fresh()
    values = about(40.0, 100)
    values[:25] = about(10.0, 25)
    assert one.learn(values, 1, MEMORY) is True
    np.testing.assert_array_equal(one.held, values[25:])


def test_the_middle_is_that_of_what_is_not_lost() -> None:
    assert middle(np.array([1.0, 3.0, math.inf, math.inf, math.inf])) == 2.0
    assert middle(np.array([math.inf])) == math.inf


# ------------------------------------------------------------------- a recording with stalls


def stalls(seed: int = 1, cycles: int = 12_000) -> Floats:
    """A recording of delays whose stalls last for 20 to 150 cycles."""
    rng = np.random.default_rng(seed)
    values = drawn(rng, cycles)
    for begin in np.cumsum(rng.integers(1000, 4000, cycles // 1000)):
        length = int(rng.integers(20, 150))
        values[begin : begin + length] += rng.uniform(10.0, 80.0)
    return values


def of_windows(values: Floats, cycles: int, every: int) -> Iterator[Floats]:
    """Yield what windows of a recording measure, in every cycle or by a shadow in some."""
    for first in range(0, len(values) - cycles + 1, cycles):
        yield values[first : first + cycles : every]


@pytest.mark.parametrize("cycles", [100, 25, 10])
@pytest.mark.parametrize("every", [1, 5])
def test_stalls_of_a_recording_are_no_other_regime(cycles: int, every: int) -> None:
    one, windows = Pool(Reference(stalls(), BLOCK), additive=True), 0
    disturbed = 0
    for window, values in enumerate(of_windows(np.tile(stalls(), 3), cycles, every), 1):
        one.learn(values, window, MEMORY * 100 / cycles, cycles, 100 / cycles)
        windows, disturbed = window, disturbed + (not one.is_declared)
    assert disturbed <= 0.01 * windows


@pytest.mark.parametrize("more_ms", [60.0, math.inf])
@pytest.mark.parametrize("every", [1, 5])
def test_what_lasts_longer_than_any_stall_is_another_regime(every: int, more_ms: float) -> None:
    one = Pool(Reference(stalls(), BLOCK), additive=True)
    windows = of_windows(stalls()[:1000] + more_ms, 100, every)
    changes = [one.learn(values, i, MEMORY, 100) for i, values in enumerate(windows, 1)]
    assert sum(changes) == 1
    assert not one.is_declared


def test_a_delay_that_no_stall_has_is_another_regime_at_once() -> None:
    one = Pool(Reference(stalls(), BLOCK), additive=True)
    assert one.learn(drawn(np.random.default_rng(1), 100) + 500.0, 1, MEMORY, 100)
