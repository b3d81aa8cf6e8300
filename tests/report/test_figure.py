"""Figures: data and a drawing, as SVG of a page and as files for a paper."""

from __future__ import annotations

import math
import re

import polars as pl
import pytest

from dwell.report.charts import limit_rule
from dwell.report.figure import Figure, Spec, pdf, printed_svg, svg
from dwell.report.palette import INK, PRINTED


def draw(width: float) -> Spec:
    point = {
        "data": {"name": "rows"},
        "mark": {"type": "point", "color": INK, "clip": True},
        "encoding": {
            "x": {"field": "x", "type": "quantitative"},
            "y": {"field": "y", "type": "quantitative"},
        },
    }
    return {"width": width - 60, "height": 60, "layer": [point, *limit_rule("y", 2.0, "limit")]}


FRAME = pl.DataFrame({"x": [1.0, 2.0, 3.0], "y": [1.23456789, math.nan, math.inf]})


@pytest.fixture
def figure() -> Figure:
    return Figure("one", "What <it> shows", {"rows": FRAME}, draw)


def test_what_json_has_not_is_null_and_digits_nobody_sees_go(figure: Figure) -> None:
    rows = figure.spec()["datasets"]["rows"]
    assert [row["y"] for row in rows] == [1.23457, None, None]


def test_a_page_s_drawing_says_what_it_is_and_keeps_the_page_s_colours(figure: Figure) -> None:
    text = svg(figure)
    assert text.startswith("<svg ")
    assert 'role="img" aria-label="What &lt;it&gt; shows"' in text
    assert text.count("role=") == 1
    assert INK in text


def test_names_within_drawings_are_theirs_whatever_was_drawn_before(figure: Figure) -> None:
    other = Figure("other", "", {"rows": FRAME}, draw)
    first, second, again = svg(figure), svg(other), svg(figure)
    assert first == again
    names = [set(re.findall(r'id="([^"]*)"', text)) for text in (first, second)]
    assert names[0]
    assert not names[0] & names[1]
    for text, known in zip((first, second), names, strict=True):
        assert set(re.findall(r"url\(#([^)]*)\)", text)) <= known


@pytest.mark.parametrize("width_pt", [252.0, 516.0])
def test_a_file_is_as_wide_as_asked_for_with_letters_of_the_same_size(
    figure: Figure, width_pt: float
) -> None:
    text = printed_svg(figure, width_pt)
    wide = re.search(r'width="([\d.]+)pt"', text)
    assert wide is not None
    assert width_pt - 2 <= float(wide[1]) <= width_pt
    assert {float(size) for size in re.findall(r'font-size="([\d.]+)px"', text)} == {7.0}
    assert "var(" not in text
    assert PRINTED[INK] in text
    assert pdf(figure, width_pt).startswith(b"%PDF")
