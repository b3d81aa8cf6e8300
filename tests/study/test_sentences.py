"""Numbers and names in sentences."""

from __future__ import annotations

import math

import pytest

from dwell.study.sentences import (
    counted,
    listed,
    number,
    percent,
    points,
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (percent(0.0424), "4.2 %"),
        (points(0.0131), "+1.3 points"),
        (points(-0.0131), "−1.3 points"),
        (number(-0.04), "0.0"),
        (number(math.inf), "∞"),
        (number(-math.inf), "−∞"),
        (number(math.nan), "–"),
        (listed([]), "none"),
        (listed(["a"]), "a"),
        (listed(["a", "b", "c"]), "a, b and c"),
        (counted(2, 3, "scenarios"), "2 of 3 scenarios"),
    ],
)
def test_texts(text: str, expected: str) -> None:
    assert text == expected
