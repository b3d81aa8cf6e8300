"""Numbers and names as they are written."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from dwell.display import Measure, write_number
from dwell.report.formatting import (
    few_seeds,
    listed,
    percent,
    shown_contender,
    shown_policy,
    shown_scenario,
    write_interval,
)
from dwell.report.table import Table
from dwell.study import Interval

MS = Measure("l95_ms", "L95", "ms")
COST = Measure("cost", "J", decimals=2)
SHARE = Measure("share_LOC", "LOC", "%", 100.0)


@pytest.mark.parametrize(
    ("value", "decimals", "text"),
    [
        (3.36, 1, "3.4"),
        (0.0, 1, "0.0"),
        (-0.25, 2, "−0.25"),
        (-0.001, 2, "0.00"),
        (9.837, 2, "9.84"),
        (23.59, 2, "23.6"),
        (225.58, 1, "226"),
        (14467.0, 1, "14\u2009467"),
        (math.inf, 1, "∞"),
        (math.nan, 1, "–"),
    ],
)
def test_numbers_have_three_digits_that_count(value: float, decimals: int, text: str) -> None:
    assert write_number(value, decimals) == text


@pytest.mark.parametrize(
    ("interval", "measure", "text"),
    [
        (Interval(31.76, 31.56, 31.96), MS, "31.8 ± 0.2"),
        (Interval(1.2118, 1.2098, 1.2138), COST, "1.21 ± <0.01"),
        (Interval(225.6, 211.8, 239.4), MS, "226 ± 14"),
        (Interval(0.0, 0.0, 0.0), MS, "0"),
        (Interval(36.0, 36.0, 36.0), MS, "36.0"),
        (Interval(3.0, math.nan, math.nan), MS, "3.0"),
        (Interval(0.546, 0.538, 0.554), SHARE, "54.6 ± 0.8"),
        # Halves that differ by a unit of the last digit, and by more.
        (Interval(31.8, 31.5, 32.0), MS, "31.8 ± 0.3"),
        (Interval(31.8, 31.5, 31.9), MS, "31.8 [31.5, 31.9]"),
        (Interval(226.0, 212.0, 241.0), MS, "226 ± 15"),
        (Interval(226.0, 212.0, 242.0), MS, "226 [212, 242]"),
        # An end that has the sign of the number keeps it, and 0 is not crossed.
        (Interval(0.2, 0.05, 0.41), MS, "0.2 [0.1, 0.4]"),
        (Interval(-0.2, -0.41, -0.05), MS, "−0.2 [−0.4, −0.1]"),
        (Interval(0.2, -0.05, 0.46), MS, "0.2 ± 0.3"),
        (Interval(0.01, 0.002, 0.03), MS, "0.0 ± <0.1"),
        (Interval(0.01, 0.0, 0.03), SHARE, "1.0 [0.0, 3.0]"),
        (Interval(0.0, 0.0, 0.139), SHARE, "0 [0.0, 13.9]"),
        (Interval(1.0, 0.861, 1.0), SHARE, "100 [86.1, 100]"),
        (Interval(98.9, 85.0, math.inf), MS, "98.9 [85.0, ∞]"),
        (Interval(math.inf, 85.0, math.inf), MS, "∞ [85.0, ∞]"),
        (Interval(30.0, 29.0, 31.0), replace(MS, ends=True), "30.0 [29.0, 31.0]"),
    ],
)
def test_intervals(interval: Interval, measure: Measure, text: str) -> None:
    assert str(write_interval(interval, measure)) == text


def test_a_table_that_is_short_of_room_has_the_larger_half() -> None:
    assert str(write_interval(Interval(62.2, 58.1, 68.0), MS, larger_half=True)) == "62.2 ± 5.8"
    endless = Interval(98.9, 85.0, math.inf)
    assert str(write_interval(endless, MS, larger_half=True)) == "98.9 [85.0, ∞]"


def test_names() -> None:
    assert shown_scenario("robot-cpu-stress") == "Robot CPU stress"
    assert shown_policy("dtp") == "DTP"
    assert shown_policy("atp") == "ATP (our reconstruction)"
    assert shown_policy("atp+corrected") == "ATP (our reconstruction; corrected)"
    assert shown_contender("atp+corrected") == "ATP (corrected)"
    assert shown_policy("dtp+corrected") == "DTP (corrected)"
    assert shown_policy("my own") == "my own"


def test_lists_and_shares() -> None:
    assert listed([]) == ""
    assert listed(["a"]) == "a"
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert listed(["a", "b"], "or") == "a or b"
    assert percent(0.05) == "5 %"
    assert percent(0.139, 1) == "13.9 %"


def test_few_seeds_ask_for_more() -> None:
    assert [bool(few_seeds(count)) for count in (1, 3, 4, 5, 20)] == [True] * 3 + [False] * 2
    assert "at least 5" in few_seeds(3)


def test_times_that_would_be_nothing_have_more_decimals_and_others_as_before() -> None:
    sizes = (40.0, 0.2, 0.012, 0.0, math.inf)
    assert [MS.for_size(size).decimals for size in sizes] == [1, 1, 3, 1, 1]
    assert SHARE.for_size(0.012).decimals == SHARE.decimals
    table = Table("t", "", [MS], [{"l95_ms": 0.0121}, {"l95_ms": 0.0038}])
    ((_, rows),) = table.groups()
    assert [row[0].text for row in rows] == ["0.012", "0.004"]
