"""Numbers by the unit of their column."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.report.units import labelled, measure_of, write, write_over_seeds
from dwell.study import Interval
from dwell.study.chapter import Unit

UNITS: tuple[Unit, ...] = ("count", "number", "percent", "change", "ms", "cost", "p")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0512, "percent", "5.1"),
        (0.081, "change", "+8.1"),
        (-0.02, "change", "−2.0"),
        (0.0, "change", "0.0"),
        (31.77, "ms", "31.8"),
        (1.2345, "cost", "1.23"),
        (-0.001, "cost", "0.00"),
        (12.0, "count", "12"),
        (12.35, "count", "12.3"),
        (0.05, "number", "0.05"),
        (0.00123, "number", "0.00123"),
        (1234.5, "number", "1\u2009234"),
        (3.0, "number", "3"),
        (1e-5, "p", "<0.001"),
        (0.0421, "p", "0.042"),
        (1.0, "p", "1.00"),
        (math.nan, "percent", "–"),
        (math.inf, "ms", "∞"),
        (math.nan, "count", "–"),
        (-math.inf, "number", "−∞"),
    ],
)
def test_numbers(value: float, unit: Unit, text: str) -> None:
    assert write(value, unit) == text


@given(st.floats(allow_nan=True, allow_infinity=True), st.sampled_from(UNITS))
def test_every_number_can_be_written(value: float, unit: Unit) -> None:
    assert write(value, unit)


def test_numbers_of_a_column_have_the_same_decimals() -> None:
    settings = [0.0, 0.05, 0.2, 0.8]
    measure = measure_of("number", settings)
    assert [write(value, "number", measure) for value in settings] == [
        "0.00",
        "0.05",
        "0.20",
        "0.80",
    ]
    # Settings do not become nothing, as what is measured may.
    envelopes = [0.001, 0.5, 4.0, 32.0]
    measure = measure_of("number", envelopes)
    assert [write(value, "number", measure) for value in envelopes[::3]] == ["0.001", "32.0"]
    wide = [0.0034, 1.3, 17.0, 814.0, 12.0]
    measure = measure_of("number", wide)
    assert {write(value, "number", measure).rpartition(".")[2] for value in wide[:2]} == {"0", "1"}


@pytest.mark.parametrize(
    ("interval", "unit", "page"),
    [
        (Interval(0.08, 0.02, 0.15), "change", "+8.0 [+2.0, +15.0]"),
        (Interval(1.21, 1.19, 1.23), "cost", "1.21 ± 0.02"),
        (Interval(0.0, 0.0, 0.139), "percent", "0 [0.0, 13.9]"),
        (Interval(3.0, math.nan, math.nan), "ms", "3.0"),
        (Interval(math.inf, 85.0, math.inf), "ms", "∞ [85.0, ∞]"),
    ],
)
def test_intervals(interval: Interval, unit: Unit, page: str) -> None:
    assert str(write_over_seeds(interval, unit)) == page


def test_a_heading_has_its_unit_once() -> None:
    assert labelled("V_D", "percent") == "V_D (%)"
    assert labelled("V_D (%)", "percent") == "V_D (%)"
    assert labelled("L95 in ms", "ms") == "L95 in ms"
    assert labelled("J", "cost") == "J"
    assert labelled("", "percent") == ""
