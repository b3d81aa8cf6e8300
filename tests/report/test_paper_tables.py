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
    assert r"\bottomrule" in chapter_tables.latex(empty, look, "x")


# -------------------------------------------------------------------------------------- LaTeX

RULES = (r"\toprule", r"\midrule", r"\addlinespace", r"\bottomrule")


def check(latex: str) -> list[list[str]]:
    """Check what would break a document; return the cells of the rows between the rules."""
    lines = [line for line in latex.splitlines() if not line.startswith("%")]
    text = "\n".join(lines)
    assert all(letter.isascii() or ord(letter) < 0x180 for letter in text)
    bare = re.sub(r"\\[\\&%$#_{}]", lambda found: "\\\\" if found[0] == r"\\" else "", text)
    assert bare.count("{") == bare.count("}")
    opened: list[str] = []
    for what, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if what == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert not opened
    for line in lines:
        plain = re.sub(r"\\[&%$#_{}]", "", line)
        assert plain.count("$") % 2 == 0, line
        assert "#" not in plain
        assert plain.count("%") == (1 if plain.endswith("%") else 0), line
        outside = re.sub(r"\$[^$]*\$", "", plain)
        assert not re.search(r"[_^]", outside), line
    columns = re.search(r"\\begin\{(?:tabular|longtable)\}\{@\{\}([lr]+)@\{\}\}", text)
    assert columns is not None
    rules = [text.index(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")]
    assert rules == sorted(rules)
    rows = []
    # The longer kind of table has its rules before its rows.
    end = text.index(r"\end{longtable}") if "longtable" in text else rules[2]
    for line in text[rules[0] : end].splitlines():
        if not line.endswith(r"\\"):
            assert line in (*RULES, r"\endfirsthead", r"\endhead", r"\endfoot")
            continue
        assert not line.startswith("[")
        wide = re.match(r"\\multicolumn\{(\d+)\}", line)
        cells = re.split(r"(?<!\\)&", line.removesuffix(r"\\"))
        width = int(wide[1]) if wide else len(cells)
        assert width == len(columns[1]), line
        rows.append([cell.strip() for cell in cells])
    return rows


def test_latex_is_whole_whatever_stands_in_it(look: PageStyle) -> None:
    rows = check(chapter_tables.latex(ROUGH, look, "chapter-rough"))
    assert rows[0] == [r"n\_a \& m\%e", r"x (\%)", "p (Holm)", "yes"]
    assert rows[1] == [
        r"$\alpha_{\mathrm{L}}$, $V_{\mathrm{D}}$",
        "5.0 [1.0, 9.0]",
        r"\textless{}0.001",
        "yes",
    ]
    assert rows[3][0] == "{[1]}"
    assert rows[4][1] == r"$\infty$ [100, $\infty$]"
    assert len(rows) == 1 + ROUGH.frame.height


def test_latex_has_every_number_with_the_ends_of_its_interval(look: PageStyle) -> None:
    table = main_table()
    latex = chapter_tables.latex(table, look, "table")
    rows = check(latex)
    groups = [row for row in rows if row[0].startswith(r"\multicolumn")]
    assert len(groups) == len(SCENARIOS)
    body = rows[2:]
    assert len(rows) == 1 + len(SCENARIOS) + table.frame.height
    assert all(
        re.fullmatch(r"[\d.]+ \[[\d.]+, [\d.]+\]|0\.0", row[1]) for row in body if row not in groups
    )
    assert r"\label{tab:table}" in latex
    assert r"V_{\mathrm{D}}$ (\%)" in latex
    assert r"\usepackage{booktabs,graphicx}" in latex


def test_every_table_of_the_chapters_is_whole(look: PageStyle) -> None:
    tables = [table for chapter in every_kind() for table in chapter.tables]
    long = replace(main_table(), frame=pl.concat([main_table().frame] * 3))
    for table in (*tables, long):
        check(chapter_tables.latex(table, look, table.slug))
