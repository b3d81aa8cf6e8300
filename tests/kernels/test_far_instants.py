"""Sums of times that 64 bits may not hold."""

from __future__ import annotations

import math

import pytest

from dwell.kernels.compiled import njit
from dwell.kernels.far_instants import LAST_NS, later, whole_ns


@njit
def sum_of(t: int, duration: int) -> int:
    """Return the sum as kernels have it, from Python."""
    return later(t, duration)


@njit
def rounded(duration: float) -> int:
    """Return the whole nanoseconds as kernels have them, from Python."""
    return whole_ns(duration)


def test_the_last_instant_is_exact_as_a_float_and_fits_64_bits() -> None:
    assert int(float(LAST_NS)) == LAST_NS < 1 << 63


@pytest.mark.parametrize(
    ("t", "duration", "sum_ns"),
    [
        (0, 0, 0),
        (5, 7, 12),
        (LAST_NS - 3, 3, LAST_NS),
        (LAST_NS - 3, 4, LAST_NS),
        (LAST_NS, LAST_NS, LAST_NS),
    ],
)
def test_sums_end_at_the_last_instant(t: int, duration: int, sum_ns: int) -> None:
    assert sum_of(t, duration) == sum_ns


@pytest.mark.parametrize(
    ("duration", "whole"),
    [(0.0, 0), (3.0, 3), (1e18, 10**18), (1e19, LAST_NS), (math.inf, LAST_NS)],
)
def test_durations_end_there_too(duration: float, whole: int) -> None:
    assert rounded(duration) == whole
