"""Sums of times that 64 bits may not hold."""

from __future__ import annotations

import ctypes
import math

import pytest

from dwell.kernels.codes import LAST_NS
from tests.kernels.parts import parts, whole


def test_the_last_instant_is_exact_as_a_float_and_fits_64_bits() -> None:
    assert int(float(LAST_NS)) == LAST_NS < 1 << 63
    assert whole("last_ns") == LAST_NS


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
    assert whole("later", t, duration) == sum_ns


@pytest.mark.parametrize(
    ("duration", "whole_ns"),
    [(0.0, 0), (3.0, 3), (1e18, 10**18), (1e19, LAST_NS), (math.inf, LAST_NS)],
)
def test_durations_end_there_too(duration: float, whole_ns: int) -> None:
    assert parts().part_whole_ns(ctypes.c_double(duration)) == whole_ns


@pytest.mark.parametrize(
    "duration", [-1.5, -1.0, -0.5, -0.0, 0.0, 1e-300, 0.5, 1.0, 1.5, 2.0**52 - 0.5, 2.0**53, 1e18]
)
def test_a_part_of_a_nanosecond_counts_as_a_whole_one(duration: float) -> None:
    assert parts().part_ceil_ns(ctypes.c_double(duration)) == math.ceil(duration)


@pytest.mark.parametrize("duration", [float(LAST_NS), 1e19, math.inf])
def test_rounded_durations_end_there_too(duration: float) -> None:
    assert parts().part_ceil_ns(ctypes.c_double(duration)) == LAST_NS
