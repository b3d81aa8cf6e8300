"""Tables of chapters: in the page, and for LaTeX, where nothing may break the document."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import polars as pl
import pytest

from dwell.report import chapter_tables
from dwell.report.formatting import OURS
from dwell.report.style import PageStyle
from dwell.study.chapter import Table
from tests.report.pages import Page
from tests.report.paper_chapters import POLICIES, SCENARIOS, every_kind, main_table
from tests.study.cell import make_problem

ROUGH = Table(
    slug="rough",
    title="Rough & 100 % of_it #1 {x} ~ ^",
    frame=pl.DataFrame(
        {
            "name": ["α_L, V_D", "a_b & c%", "[1]", None, "dtp+corrected", "∞ → −1 ☃"],
            "x": [0.05, None, math.nan, math.inf, -3.25, 1e7],
            "x_low": [0.01, None, math.nan, 1.0, -4.0, None],
            "x_high": [0.09, None, math.nan, math.inf, -2.0, None],
            "p": [1e-9, 0.04, 1.0, None, 0.5, 0.2],
            "yes": [True, False, None, True, True, False],
            "hidden": [1, 2, 3, 4, 5, 6],
        }
    ),
    units={"name": "text", "x": "percent", "p": "p", "yes": "text"},
    headings={"name": "n_a & m%e", "p": "p (Holm)"},
    note="What is 5 % & more",
)


@pytest.fixture(scope="module")
def look() -> PageStyle:
    return PageStyle.of(make_problem(), every_kind())


def page(html: str) -> Page:
    return Page(f"<main>{html}</main>")


# --------------------------------------------------------------------------------------- page


def test_rows_of_one_scenario_stand_under_its_name(look: PageStyle) -> None:
    html = chapter_tables.html(main_table(), look, main=True)
    assert html.count('<tr class="group">') == len(SCENARIOS)
    text = page(html).text
    for name in ("Robot CPU stress", "DTP (corrected)", "V_D is".replace("V_D", "")):
        assert name in text
    assert html.count("</tr>") == 1 + len(SCENARIOS) * (1 + len(POLICIES))


def test_all_rows_of_a_table_have_as_many_columns(look: PageStyle) -> None:
    for table in (main_table(), ROUGH):
        html = chapter_tables.html(table, look)
        widths = set()
        for row in re.findall(r"<tr[^>]*>(.*?)</tr>", html):
            spans = [int(one) for one in re.findall(r'colspan="(\d+)"', row)]
            widths.add(len(re.findall(r"<t[hd]", row)) + sum(spans) - len(spans))
        assert len(widths) == 1


def test_numbers_have_intervals_and_words_their_colour(look: PageStyle) -> None:
    html = chapter_tables.html(main_table(), look)
    assert re.search(r'<td class="num">[\d.]+</td><td class="err">\[[\d.]+, [\d.]+\]</td>', html)
    assert '<span class="good nowrap">under</span>' in html
    assert '<span class="bad nowrap">over</span>' in html


def test_what_is_no_number_is_a_dash(look: PageStyle) -> None:
    text = page(chapter_tables.html(ROUGH, look)).text
    assert "–" in text
    assert "∞" in text
    assert "<0.001" in text
    assert "nan" not in text
    assert "hidden" not in text
    assert "What is 5 % & more." in text


def test_long_tables_are_folded_unless_they_are_what_a_chapter_is_about(look: PageStyle) -> None:
    table = main_table()
    assert "<details>" in chapter_tables.html(table, look)
    assert "45 rows" in chapter_tables.html(table, look)
    assert "<details>" not in chapter_tables.html(table, look, main=True)


def test_what_shows_atp_says_what_it_is(look: PageStyle) -> None:
    assert OURS in page(chapter_tables.html(main_table(), look)).text
    frame = main_table().frame.filter(pl.col("policy") != "atp")
    without = replace(main_table(), frame=frame)
    assert OURS not in page(chapter_tables.html(without, look)).text
    assert chapter_tables.noted(replace(main_table(), note=OURS), look).count(OURS) == 1


def test_an_empty_table_has_its_head(look: PageStyle) -> None:
    empty = replace(main_table(), frame=main_table().frame.clear())
    html = chapter_tables.html(empty, look)
    assert "policy" in page(html).text
