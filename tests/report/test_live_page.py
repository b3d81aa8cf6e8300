"""The page of a live run: the same report, and what only a live run has to say."""

from __future__ import annotations

import pytest

from dwell.report import run_html
from dwell.report.run_page import run_page
from tests.report.live_runs import PERIOD_NS, PLAYED, TRACKING, live_run
from tests.report.pages import facts_of, table_of


def test_it_says_what_was_played_and_what_every_phase_showed() -> None:
    run = live_run(scenario="demo", seed=1, played=PLAYED, tracking=TRACKING)
    page = run_page(run)
    assert "scenario Demo" in page.subtitle
    assert "E: 2 busy threads" in next(page.figures).frames["spans"]["what"]
    assert [row["name"] for row in table_of(page, "phases").rows] == [
        "baseline", "edge stress", "baseline"
    ]  # fmt: skip


def test_a_run_in_earnest_has_no_phases() -> None:
    page = run_page(live_run())
    assert page.subtitle.startswith("live")
    assert "phases" not in {table.slug for table in page.tables}


def test_moves_of_the_guard_are_told_apart_from_migrations() -> None:
    page = run_page(live_run())
    assert facts_of(page)["migrations"].value == "1"
    assert facts_of(page)["moves of the guard"].value == "1"
    frames = next(page.figures).frames
    moves = {row["reason"]: row["time"] for row in frames["moves"].to_dicts()}
    assert moves["migrate"] == pytest.approx(0.66)
    # Before the fourth window, whose first cycle is the 32nd.
    assert moves["guard"] == pytest.approx(32 * PERIOD_NS / 1e9)
    spans = {row["what"]: row["begin"] for row in frames["spans"].to_dicts()}
    assert spans["clocks unproven"] == moves["guard"]


def test_it_says_how_well_it_is_known() -> None:
    rows = {row["what"]: row["value"] for row in table_of(run_page(live_run()), "known").rows}
    assert rows["windows unproven"] == "1"
    assert rows["cycles in no window, before the first of a placement"] == "2"
    assert rows["cycles of which nothing was heard (counted as lost)"] == "1"
    assert rows["commands that arrived and were not applied: too old, or behind a later one"] == "1"
    assert rows["closed"] == "yes"


def test_a_torn_journal_is_told() -> None:
    recovered = {"sealed": False, "opened": 2, "torn_bytes": 17, "damaged_bytes": 0}
    table = table_of(run_page(live_run(recovered=recovered)), "known")
    rows = {row["what"]: row["value"] for row in table.rows}
    assert rows["starts of the controller"] == "2"
    assert rows["bytes torn off the journal’s end by a kill"] == "17"
    assert rows["closed"] == "no"


def test_a_run_without_an_error_has_no_panel_for_it() -> None:
    assert "tracking" not in run_html(live_run(), static=True)
    assert "tracking error" in run_html(live_run(tracking=TRACKING), static=True)
