"""Figures: data and a drawing, as SVG of a page and as files for a paper."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest

from dwell.report.charts import limit_rule
from dwell.report.figure import Figure, Spec, javascript, pdf, printed_svg, svg
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


def script_of_a_process(cache: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", "from dwell.report.figure import javascript; print(javascript())"],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
    )
    return done.stdout.removesuffix("\n")


def test_the_script_of_pages_is_made_once_for_all_processes(tmp_path: Path) -> None:
    cache = tmp_path / "no such folder yet"
    made = script_of_a_process(cache)
    (kept,) = cache.glob("dwell/*")
    assert kept.read_bytes().decode() == made == javascript()
    assert "vegaEmbed" in made
    kept.write_text("// what is kept")
    assert script_of_a_process(cache) == "// what is kept"


def test_pages_have_their_script_where_no_cache_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert script_of_a_process(tmp_path / "file") == javascript()
