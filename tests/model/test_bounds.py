"""Bounds: what is inside, and in what words."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import ProblemError
from dwell.model.bounds import Bound, counted, shown


@pytest.mark.parametrize(
    ("bound", "text"),
    [
        (Bound(0, 1e9), "a number from 0 to 1e9"),
        (Bound(1e-4), "a number of at least 0.0001"),
        (Bound(0, above=True), "a number above 0"),
        (Bound(0, 1, below=True), "a number of at least 0 and below 1"),
        (Bound(-1, 1, above=True, below=True), "a number above -1 and below 1"),
        (Bound(0, 1e9, above=True), "a number above 0 and at most 1e9"),
        (Bound(1, 4096, whole=True), "a whole number from 1 to 4096"),
    ],
)
def test_a_bound_says_what_it_is(bound: Bound, text: str) -> None:
    assert str(bound) == text


@given(st.floats(allow_nan=False))
def test_a_bound_holds_what_is_between_its_ends(value: float) -> None:
    assert Bound(0, 2).holds(value) == (0 <= value <= 2)
    assert Bound(0, 2, above=True, below=True).holds(value) == (0 < value < 2)
    assert Bound(0).holds(value) == (value >= 0)


@pytest.mark.parametrize("value", [math.nan, True, "1", None, 1j, [1]])
def test_what_is_no_number_is_in_no_bound(value: object) -> None:
    assert not Bound(-10, 10).holds(value)


def test_whole_numbers_may_be_those_of_numpy() -> None:
    bound = Bound(0, 10, whole=True)
    assert bound.holds(np.int64(3))
    assert not bound.holds(3.0)
    assert not bound.holds(10**400)


def test_what_is_refused_is_named() -> None:
    with pytest.raises(ProblemError) as caught:
        Bound(0, 10).check("a.b", 11)
    assert str(caught.value) == "a.b: 11 is not allowed; it must be a number from 0 to 10"


def test_one_thing_is_not_many() -> None:
    counts = [(1, "window"), (2, "policy"), (0, "process"), (1, "policy"), (2.5, "key")]
    texts = ["1 window", "2 policies", "0 processes", "1 policy", "2.5 keys"]
    assert [counted(*count) for count in counts] == texts


def test_no_value_is_too_long_to_show() -> None:
    for value in (10**5000, -(10**5000), "x" * 1000, list(range(1000))):
        assert len(shown(value)) <= 80
