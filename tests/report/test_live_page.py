"""The page of a live run: the same report, and what only a live run has to say."""

from __future__ import annotations

import math

import pytest

from dwell.errors import RunError
from dwell.report import run_html
from dwell.report.phase_rows import phase_rows
from dwell.report.recovery import recovery
from dwell.report.run_header import RunHeader
from dwell.report.run_page import run_page
from dwell.report.tracking import Tracking
from tests.report.live_runs import PERIOD_NS, live_run
from tests.report.pages import facts_of, table_of

PLAYED = [{"node": "E", "stress_threads": 2, "at_s": 0.66, "for_s": 0.36}]
TRACKING = {
    "begin_s": 0.0,
    "step_s": 0.33,
    "rms_mm": [None, 3.0, 4.0, 1.0, 1.0, 1.0],
    "rms_px": [None, 6.0, 8.0, 2.0, 2.0, 2.0],
}


def test_it_says_what_was_played_and_what_every_phase_showed() -> None:
    run = live_run(scenario="demo", seed=1, played=PLAYED, tracking=TRACKING)
    page = run_page(run)
    assert "scenario Demo" in page.subtitle
    assert "E: 2 busy threads" in next(page.figures).frames["spans"]["what"]
    assert [row["name"] for row in table_of(page, "phases").rows] == [
        "baseline", "edge stress", "baseline"
    ]  # fmt: skip
    calm, stress, after = phase_rows(run, RunHeader.of(run))
    assert (stress.migrations, stress.guard_moves) == (1, 1)
    assert stress.shares == {"SO": 10 / 11, "LOC": 1 / 11}
    assert calm.rms_mm == 3.0
    assert stress.rms_px == 8.0
    assert after.lost == 1


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
    text = " ".join(recovery(recovered))
    assert "The controller was started 2 times" in text
    assert "17 bytes at the journal's end were torn by a kill" in text
    assert "The run was not closed" in text


def test_a_run_without_an_error_has_no_panel_for_it() -> None:
    assert "tracking" not in run_html(live_run(), static=True)
    assert "tracking error" in run_html(live_run(tracking=TRACKING), static=True)


@pytest.mark.parametrize(
    "told",
    [[], {"begin_s": 0}, {**TRACKING, "step_s": 0}, {**TRACKING, "rms_px": [1.0]}],
)
def test_an_error_that_cannot_be_read_is_refused(told: object) -> None:
    with pytest.raises(RunError, match="tracking error cannot be read"):
        run_page(live_run(tracking=told))


def test_rms_is_of_the_stretches_between_two_instants() -> None:
    tracking = Tracking.of({"tracking": TRACKING})
    assert tracking is not None
    mm, px = tracking.rms(0.33, 0.99)
    assert mm == pytest.approx(math.sqrt((9 + 16) / 2))
    assert px == pytest.approx(math.sqrt((36 + 64) / 2))
    assert math.isnan(tracking.rms(10, 11)[0])
