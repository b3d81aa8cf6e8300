"""When a disturbance is on, and how strongly."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.kernels.on_off_intervals import OnOffIntervals, drawn_intervals, interval, ramp
from dwell.model import Constant, Exponential, LogNormal, Process, Uniform
from dwell.model.instants import HORIZON_NS
from dwell.model.scenario import RAMP_STEPS
from tests.kernels.levels import levels_at

S = 1_000_000_000


def drawn(
    every: Process, length: Process, *, begin_ns: int = 0, horizon_ns: int = 1000 * S, seed: int = 1
) -> OnOffIntervals:
    rngs = np.random.default_rng((seed, 0)), np.random.default_rng((seed, 1))
    return drawn_intervals(every, length, float(S), rngs, begin_ns, horizon_ns)


def level(intervals: OnOffIntervals, at_ns: int) -> int:
    return int(levels_at(intervals, np.array([at_ns]))[0])


# ------------------------------------------------------------------------------------- ramps


def test_a_ramp_is_a_staircase_up_and_its_mirror_image_down() -> None:
    intervals = ramp(10 * S, 100 * S, 31 * S)
    for at_s, steps in (
        (0, 0),
        (10.999, 0),  # the first step is reached 1/31 of the ramp after the begin
        (11, 1),
        (11.999, 1),
        (12, 2),
        (25.5, 15),
        (40.999, 30),
        (41, 31),
        (68.999, 31),
        (69, 30),
        (70, 29),
        (98, 1),
        (98.999, 1),
        (99, 0),
        (1000, 0),
    ):
        assert level(intervals, round(at_s * S)) == steps, at_s


def test_a_ramp_that_lasts_for_ever_does_not_fall() -> None:
    intervals = ramp(0, HORIZON_NS, 31 * S)
    assert [level(intervals, at_s * S) for at_s in (0, 1, 30, 31, 10_000_000)] == [0, 1, 30, 31, 31]


def test_a_ramp_of_half_its_time_falls_as_soon_as_it_has_grown() -> None:
    intervals = ramp(0, 62 * S, 31 * S)
    assert [level(intervals, at_s * S) for at_s in (30, 31, 32, 33)] == [30, 30, 29, 28]
    assert levels_at(intervals, np.arange(0, 62 * S, S // 7)).max() == 30


@given(
    st.integers(0, 10**12),
    st.integers(0, 10**12),
    st.integers(0, 10**12),
    st.lists(st.floats(0, 1), min_size=1, max_size=20),
)
def test_a_ramp_is_never_a_step_off_the_line(
    begin: int, ramp_ns: int, flat_ns: int, shares: list[float]
) -> None:
    end = begin + 2 * ramp_ns + flat_ns
    intervals = ramp(begin, end, ramp_ns)
    assert (np.diff(intervals.begin) >= 0).all()
    at = np.array([begin + round(share * (end - begin)) for share in shares])
    since = np.minimum(at - begin, end - at)
    line = np.ones(len(at)) if ramp_ns == 0 else np.minimum(since / ramp_ns, 1)
    found = levels_at(intervals, at) / RAMP_STEPS
    near = 1 / max(ramp_ns, 1)  # a nanosecond, as a share of the ramp
    assert (found <= line + near).all()
    if ramp_ns > RAMP_STEPS:
        assert (found[at < end] >= line[at < end] - 1 / RAMP_STEPS - 2 * near).all()


def test_a_spell_is_on_from_its_begin_until_before_its_end() -> None:
    intervals = interval(3, 5)
    assert levels_at(intervals, np.arange(7)).tolist() == [0, 0, 0, RAMP_STEPS, RAMP_STEPS, 0, 0]
    none = OnOffIntervals(*np.empty((3, 0), np.int64))
    assert levels_at(none, np.arange(3)).tolist() == [0, 0, 0]


# ---------------------------------------------------------------------------------- episodes


def test_constant_episodes_begin_with_a_time_off() -> None:
    intervals = drawn(Constant(3), Constant(2), begin_ns=10 * S, horizon_ns=24 * S)
    assert (intervals.begin / S).tolist() == [13, 18, 23]
    assert (intervals.end / S).tolist() == [15, 20, 25]
    assert set(intervals.level) == {RAMP_STEPS}


def test_what_ends_cuts_an_episode_short() -> None:
    intervals = drawn(Constant(3), Constant(2)).until(14 * S)
    assert (intervals.begin / S).tolist() == [3, 8, 13]
    assert (intervals.end / S).tolist() == [5, 10, 14]
    assert len(drawn(Constant(3), Constant(2)).until(3 * S).begin) == 0


def test_nothing_is_drawn_of_what_begins_after_the_run() -> None:
    intervals = drawn(Exponential(1), Exponential(1), begin_ns=5 * S, horizon_ns=4 * S)
    assert len(intervals.begin) == 0


@pytest.mark.parametrize(
    ("every", "length", "off_deviation", "on_deviation"),
    [
        (Exponential(30), Uniform(2, 10), 30, 8 / math.sqrt(12)),
        (Exponential(80), Exponential(40), 80, 40),
        (LogNormal(2, 0.5), Constant(1), 1, 0),
    ],
)
def test_episodes_have_the_moments_declared(
    every: Process, length: Process, off_deviation: float, on_deviation: float
) -> None:
    intervals = drawn(every, length, horizon_ns=200_000 * S)
    on = (intervals.end - intervals.begin) / S
    off = (intervals.begin[1:] - intervals.end[:-1]) / S
    expected = 200_000 / (every.expectation + length.expectation)
    assert len(on) == pytest.approx(expected, rel=0.1)
    for values, process, deviation in (
        (off, every, off_deviation),
        (on, length, on_deviation),
    ):
        error = 4 * deviation / math.sqrt(len(values)) + 1e-6
        assert values.mean() == pytest.approx(process.expectation, abs=error)
        assert values.std() == pytest.approx(deviation, rel=0.15, abs=1e-6)


@given(st.integers(0, 1000), st.integers(1, 3000), st.integers(0, 3000))
def test_a_longer_run_has_the_same_episodes_and_more(seed: int, short_s: int, more_s: int) -> None:
    """However many are drawn at a time."""
    every, length = Exponential(5), Exponential(2)
    some = drawn(every, length, horizon_ns=short_s * S, seed=seed)
    all_of_them = drawn(every, length, horizon_ns=(short_s + more_s) * S, seed=seed)
    count = len(some.begin)
    np.testing.assert_allclose(all_of_them.begin[:count], some.begin, atol=1)
    np.testing.assert_allclose(all_of_them.end[:count], some.end, atol=1)
    assert (all_of_them.begin[count:] >= short_s * S).all()
    assert (some.begin[1:] >= some.end[:-1]).all()
