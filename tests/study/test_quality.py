"""What the actuator gets, against cases by hand and against counting instant by instant."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dwell.model import MovingTarget, Servo
from dwell.model.instants import NEVER_NS
from dwell.study.quality import (
    EffectiveCommands,
    actuations,
    age_of_information,
    track,
)

Ints = NDArray[np.int64]
MS = 1_000_000


def ns(*values_ms: float | None) -> Ints:
    """Return milliseconds as nanoseconds; None is a cycle that never finished."""
    return np.array([NEVER_NS if v is None else round(v * MS) for v in values_ms], np.int64)


# ------------------------------------------------------------------------- what takes effect


def test_a_late_cycle_actuates_and_a_lost_one_does_not() -> None:
    actuated = actuations(ns(5, 10, 20, 30), ns(8, None, 25, 16))
    assert actuated.start_ns == 5 * MS
    assert actuated.release_ns.tolist() == ns(5, 20, 30).tolist()
    assert actuated.at_ns.tolist() == ns(13, 45, 46).tolist()


def test_what_completes_after_a_newer_cycle_is_discarded() -> None:
    # Completions at 35, 18, 40, 40 and 60: the first is overtaken, two are there at once.
    actuated = actuations(ns(0, 10, 20, 30, 40), ns(35, 8, 20, 10, 20))
    assert actuated.release_ns.tolist() == ns(10, 30, 40).tolist()
    assert actuated.at_ns.tolist() == ns(18, 40, 60).tolist()


def test_nothing_takes_effect_where_all_is_lost() -> None:
    actuated = actuations(ns(3, 10), ns(None, None))
    assert (actuated.start_ns, len(actuated.at_ns), len(actuated.release_ns)) == (3 * MS, 0, 0)


cycles = st.lists(
    st.tuples(st.integers(0, 12), st.one_of(st.none(), st.integers(0, 60))), min_size=1, max_size=25
)


def drawn(pairs: list[tuple[int, int | None]]) -> tuple[Ints, Ints]:
    """Return releases and latencies: gaps between releases, and latencies or None."""
    releases = np.cumsum([gap for gap, _ in pairs])
    return releases, np.array([NEVER_NS if late is None else late for _, late in pairs], np.int64)


def newest_by(releases: Ints, latencies: Ints, instant: float) -> int:
    """Return the release of the newest cycle that has completed, or the first release."""
    done = [r for r, late in zip(releases, latencies, strict=True) if r + late <= instant]
    return int(max(done, default=releases[0]))


@given(cycles)
def test_what_is_in_effect_is_the_newest_that_has_completed(
    pairs: list[tuple[int, int | None]],
) -> None:
    releases, latencies = drawn(pairs)
    actuated = actuations(releases, latencies)
    assert (np.diff(actuated.at_ns) > 0).all()
    for instant in range(int(releases[0]), int(releases[-1]) + 61):
        place = int(np.searchsorted(actuated.at_ns, instant, side="right"))
        shown = actuated.release_ns[place - 1] if place else actuated.start_ns
        assert shown == newest_by(releases, latencies, instant)


# ------------------------------------------------------------------------------------- age


def test_the_age_of_a_constant_delay_by_hand() -> None:
    """A sawtooth from L = 12 to L + P = 42 ms."""
    releases = ns(*(30 * i for i in range(100)))
    actuated = actuations(releases, np.full(100, 12 * MS))
    age = age_of_information(actuated, 12 * MS + 30 * MS * 10, 12 * MS + 30 * MS * 90)
    assert age.mean_ms == pytest.approx(12 + 15)
    assert age.p95_ms == pytest.approx(12 + 0.95 * 30)
    assert age.peak_ms == 42
    assert age.mean_peak_ms == pytest.approx(42)


def test_a_lost_cycle_lets_one_tooth_grow_by_a_period() -> None:
    latencies = np.full(100, 12 * MS)
    latencies[50] = NEVER_NS
    actuated = actuations(ns(*(30 * i for i in range(100))), latencies)
    age = age_of_information(actuated, 12 * MS, 12 * MS + 99 * 30 * MS)
    assert age.peak_ms == 72
    # 97 teeth of 30 ms and one of 60 ms.
    assert age.mean_ms == pytest.approx((97 * 30 * 27 + 60 * 42) / (99 * 30))
    # 97 actuations inside ended them; the one at the end did not.
    assert age.mean_peak_ms == pytest.approx((96 * 42 + 72) / 97)


def test_before_the_first_actuation_the_age_counts_from_the_first_release() -> None:
    nothing = EffectiveCommands(5 * MS, ns(), ns())
    age = age_of_information(nothing, 15 * MS, 105 * MS)
    assert (age.mean_ms, age.peak_ms, age.mean_peak_ms) == (55.0, 100.0, 100.0)
    assert age.p95_ms == pytest.approx(95.5)


@given(cycles, st.data())
def test_the_age_is_what_counting_instants_gives(
    pairs: list[tuple[int, int | None]], data: st.DataObject
) -> None:
    """Whole nanoseconds, so that half-way between them is on every tooth's inside."""
    releases, latencies = drawn(pairs)
    end = int(releases[-1]) + data.draw(st.integers(1, 80))
    begin = data.draw(st.integers(int(releases[0]), end - 1))
    found = age_of_information(actuations(releases, latencies), begin, end)
    middles = np.arange(begin, end) + 0.5
    ages = np.array([t - newest_by(releases, latencies, t) for t in middles])
    assert found.mean_ms * MS == pytest.approx(ages.mean())
    # The age grows up to the end of a nanosecond; nothing else takes place within one.
    assert found.peak_ms * MS == pytest.approx(ages.max() + 0.5)
    p95 = found.p95_ms * MS
    below, above = (np.clip(at - (ages - 0.5), 0, 1).mean() for at in (p95 - 1, p95 + 1))
    assert below <= 0.95 + 1e-9
    assert above >= 0.95 - 1e-9


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=60), st.integers(1, 10**9))
def test_the_percentile_of_any_teeth_has_its_share_below(gaps: list[int], latency: int) -> None:
    """Teeth over seven orders of magnitude, as of outages."""
    releases = np.concatenate(([0], np.cumsum(gaps)))
    actuated = actuations(releases, np.full(len(releases), latency))
    end = int(releases[-1]) + latency + 1
    p95 = round(age_of_information(actuated, 0, end).p95_ms * MS)
    since = np.concatenate(([0], actuated.at_ns))
    low = since - np.concatenate(([0], actuated.release_ns))
    high = low + np.diff(np.append(since, end))
    below = [(np.clip(at, low, high) - low).sum() / end for at in (p95 - 1, p95 + 1)]
    assert below[0] <= 0.95 + 1e-12
    assert below[1] >= 0.95 - 1e-12


# ---------------------------------------------------------------------------- misses in K


def test_the_percentile_of_ages_whose_sum_64_bits_do_not_hold() -> None:
    """Ten million seconds of a queue that only grows, by the number of its cycles."""
    release_ns = np.arange(20_000, dtype=np.int64) * 10**15
    latency_ns = release_ns // 2 + 1
    actuated = actuations(release_ns, latency_ns)
    end_ns = int(actuated.at_ns[-1])
    age = age_of_information(actuated, 0, end_ns)
    # At t the newest command in effect was released at 2 t / 3.
    assert age.p95_ms == pytest.approx(0.95 * end_ns / 3 / 1e6, rel=1e-3)


# -------------------------------------------------------------------------------- tracking

SERVO = Servo("integrator", 4, MovingTarget(40, 1.6))


def test_errors_are_proportional_to_the_amplitude() -> None:
    actuated = actuations(ns(*(30 * i for i in range(200))), np.full(200, 20 * MS))
    small = track(SERVO, actuated, 0, 6_000 * MS)
    large = track(Servo("integrator", 4, MovingTarget(400, 1.6)), actuated, 0, 6_000 * MS)
    assert large.rms_mm == pytest.approx(10 * small.rms_mm)
    assert large.iae_mm_s == pytest.approx(10 * small.iae_mm_s)
    assert (small.seconds, small.mean_mm) == (6.0, small.iae_mm_s / 6)
    assert small.mean_mm < small.rms_mm < 40 / math.sqrt(2)


def test_the_clock_starts_at_the_first_release() -> None:
    releases = ns(*(30 * i for i in range(200)))
    here = track(SERVO, actuations(releases, np.full(200, 20 * MS)), 0, 6_000 * MS)
    releases = releases + 10**15
    shifted = actuations(releases, np.full(200, 20 * MS))
    assert track(SERVO, shifted, 10**15, 10**15 + 6_000 * MS) == pytest.approx(here)


def test_a_cycle_that_was_overtaken_commands_nothing() -> None:
    releases = ns(*(30 * i for i in range(100)))
    latencies = np.full(100, 20 * MS)
    overtaken, lost = latencies.copy(), latencies.copy()
    overtaken[40], lost[40] = 70 * MS, NEVER_NS
    spans = 0, 3_000 * MS
    tracked = [track(SERVO, actuations(releases, late), *spans) for late in (overtaken, lost)]
    assert tracked[0] == tracked[1] != track(SERVO, actuations(releases, latencies), *spans)


def test_delay_costs_tracking_and_instability_costs_all_of_it() -> None:
    releases = ns(*(30 * i for i in range(3000)))
    rms_mm = []
    for late_ms in (0, 20, 60, 200, 500):
        actuated = actuations(releases, np.full(3000, late_ms * MS))
        rms_mm.append(track(SERVO, actuated, 0, 90_000 * MS).rms_mm)
    assert rms_mm == sorted(rms_mm)
    assert rms_mm[-2] < math.inf == rms_mm[-1]


def test_a_double_integrator_is_told_from_an_integrator() -> None:
    actuated = actuations(ns(*(30 * i for i in range(200))), np.full(200, 20 * MS))
    other = Servo("double-integrator", 30, MovingTarget(40, 1.6), damping=8)
    assert track(other, actuated, 0, 6_000 * MS) != track(SERVO, actuated, 0, 6_000 * MS)
