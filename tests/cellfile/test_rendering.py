from __future__ import annotations

import math

import pytest

from dwell.model.bounds import as_read


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "nothing"),
        (True, "true"),
        (False, "false"),
        (math.nan, "NaN"),
        (math.inf, "infinity"),
        (-math.inf, "-infinity"),
        ({"a": 1}, "a mapping"),
        ([1], "a list"),
        (2.5, "2.5"),
        ("yes", "'yes'"),
    ],
)
def test_a_value_as_its_author_wrote_it(value: object, text: str) -> None:
    assert as_read(value) == text
