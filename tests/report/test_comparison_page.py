"""The page of a comparison, and its text: whole, and saying what its numbers say."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest

from dwell.report import comparison_html, comparison_text
from dwell.report.comparison_page import comparison_page
from dwell.report.figure import Figure
from dwell.report.table import Table
from dwell.study import compare
from tests.cells.small import SEEDS, make_comparison, make_problem
from tests.dash.browser import chromium, in_browser, opened
from tests.report.pages import Page, silent_on_warmup, small_comparison, table_of

Shown: TypeAlias = dict[tuple[str, str], Mapping[str, float | Sequence[float]]]

NOISE = np.linspace(-0.01, 0.01, len(SEEDS))


@pytest.fixture(scope="module")
def html() -> str:
    return comparison_html(small_comparison(), static=True)


def test_it_is_whole_and_nothing_is_loaded_from_elsewhere(html: str) -> None:
    page = Page(html)
    assert page.outside == []
    assert "script" not in page.tags
    assert len(set(page.ids)) == len(page.ids)
    # The topology has two pictures, for large and for small screens.
    assert page.tags.count("svg") == page.tags.count("figure") + 1 == len(page.labels)


def test_verdict_rates_and_the_cell_are_first_and_the_rest_is_folded() -> None:
    found = small_comparison()
    page = comparison_page(found)
    first, cell, *others = page.sections
    assert [block.slug for block in first.blocks if isinstance(block, Figure)] == ["violation_rate"]
    assert first.note.startswith("V_D under 5 %")
    drawing, placements = cell.blocks
    assert isinstance(drawing, Figure)
    assert isinstance(placements, Table)
    assert [row["placement"] for row in placements.rows] == list(found.problem.candidates)
    assert not first.folded
    assert not cell.folded
    assert all(section.folded for section in others)


def test_every_table_says_whether_the_warm_up_is_in() -> None:
    assert silent_on_warmup(comparison_page(small_comparison())) == []


def test_every_policy_stands_in_every_scenario_and_a_reader_can_choose() -> None:
    found, page = small_comparison(), comparison_page(small_comparison())
    rows = table_of(page, "results").rows
    assert {(row["scenario"], row["policy"]) for row in rows} == {
        (scenario, policy) for scenario in found.scenarios for policy in found.policies
    }
    assert list(page.policies or ()) == ["LOC", "SO", "HYB", "ATP", "DTP"]
    assert tuple(page.seeds) == found.seeds


def test_the_deadline_is_on_every_latency_axis() -> None:
    deadline_ms = make_problem().pipeline.deadline_ms
    page = comparison_page(small_comparison())
    for slug in ("l95_ms", "latencies", "split", "time-baseline"):
        figure = next(one for one in page.figures if one.slug == slug)
        assert {"datum": deadline_ms} in list(inner(figure.spec()))


def inner(value: Any) -> Iterator[Any]:
    """Yield every mapping inside of a drawing."""
    if isinstance(value, dict):
        yield value
    for item in value.values() if isinstance(value, dict) else value:
        if isinstance(item, dict | list):
            yield from inner(item)


def test_the_same_comparison_makes_the_same_page(html: str) -> None:
    assert comparison_html(small_comparison(), static=True) == html


def test_a_cell_without_dtp_or_predictions_has_a_page() -> None:
    found = compare(
        make_problem(),
        scenarios=("baseline",),
        policies=("SO",),
        seeds=(1,),
        windows=4,
        processes=1,
    )
    page = Page(comparison_html(found, static=True))
    assert page.outside == []
    assert not any("through time" in heading for heading in page.headings)


def test_several_comparisons_stand_in_one_page() -> None:
    first = small_comparison()
    second = replace(first, problem=replace(first.problem, name="other"))
    page = Page(comparison_html(first, second, static=True))
    assert len(set(page.ids)) == len(page.ids)
    assert {"small: Results", "other: Results"} <= set(page.headings)


# -------------------------------------------------------------------------- what words stand


def test_predictions_are_judged_where_they_were_run() -> None:
    shown: Shown = {
        ("baseline", "dtp"): {"share_SO": 1.0, "share_LOC": 0.0, "share_HYB": 0.0},
        ("baseline", "LOC"): {"violation_rate": [0.02 + x for x in NOISE]},
    }
    comparison = make_comparison(shown, scenarios=("baseline", "robot-cpu-stress"))
    rows = table_of(comparison_page(comparison), "predictions").rows
    assert {row["scenario"] for row in rows} == {"baseline", "robot-cpu-stress"}
    answers = {(row["policy"], row["words"]): row["answer"] for row in rows}
    assert answers["dtp", "Mostly LOC; occasional HYB"] == "differs"
    assert answers["LOC", "Low V_D"] == "agrees"


def test_estimates_stand_beside_what_was_measured() -> None:
    shown: Shown = {("baseline", "SO"): {"cost": 9.84}}
    comparison = make_comparison(shown, estimated={"LOC": 1.1, "SO": 0.91, "HYB": 0.99})
    example = small_comparison().examples["baseline", "dtp"]
    comparison = replace(comparison, examples={("baseline", "dtp"): example})
    rows = table_of(comparison_page(comparison), "beliefs").rows
    so = next(row for row in rows if row["candidate"] == "SO" and row["policy"] == "dtp")
    assert so["estimated"] == pytest.approx(0.91)
    assert so["alone"] == pytest.approx(9.84)


# ------------------------------------------------------------------------------ the terminal


def test_text_has_a_table_for_every_scenario_and_the_answer_last() -> None:
    comparison = small_comparison()
    text = comparison_text(comparison)
    for name in ("Baseline", "Robot CPU stress"):
        assert name in text.splitlines()
    assert "ATP is our reconstruction" in " ".join(text.split())
    assert text.rindex("V_D and the aim of 5 %") > text.rindex("Every policy in every scenario")
    assert "\x1b" not in text
    assert all(line == line.rstrip() for line in text.splitlines())


def test_text_folds_into_a_narrow_terminal() -> None:
    assert max(map(len, comparison_text(small_comparison(), width=80).splitlines())) <= 80


def test_contenders_are_called_as_in_the_page() -> None:
    policies = ("LOC", "SO", "HYB", "dtp", "dtp+corrected", "cusum+corrected")
    text = comparison_text(make_comparison({}, policies=policies))
    assert "+corrected" not in text
    for name in ("DTP (corrected)", "CUSUM (corrected)"):
        assert text.count(f"\n{name} ") == 2


@in_browser
def test_the_page_has_at_most_three_screens_until_a_section_is_opened(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(comparison_html(small_comparison()), encoding="utf-8")
    drawn = "document.querySelector('.drawing.live')"
    with (
        chromium() as browser,
        opened(browser, file.as_uri(), ready=drawn) as page,
    ):
        assert page.evaluate("document.documentElement.scrollHeight") <= 3 * 1000
        words = page.locator("main").inner_text().split()
        assert len(words) < 400
        page.locator("summary").first.focus()
        page.keyboard.press("Enter")
        assert page.locator("details[open]").count() == 1
