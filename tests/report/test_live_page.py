"""The page of a live run: the same report, and what only a live run has to say."""

from __future__ import annotations

import math

import pytest

from dwell.errors import RunError
from dwell.report import run_html
from dwell.report.phase_rows import phase_rows
from dwell.report.run_header import RunHeader
from dwell.report.timeline import GUARD, MIGRATIONS, run_timeline
from dwell.report.tracking import Tracking
from tests.report.live_runs import PERIOD_NS, live_run
from tests.report.pages import Page

PLAYED = [{"node": "E", "stress_threads": 2, "at_s": 0.66, "for_s": 0.36}]
TRACKING = {
    "begin_s": 0.0,
    "step_s": 0.33,
    "rms_mm": [None, 3.0, 4.0, 1.0, 1.0, 1.0],
    "rms_px": [None, 6.0, 8.0, 2.0, 2.0, 2.0],
}


def test_it_says_what_was_played_and_what_every_phase_showed() -> None:
    run = live_run(scenario="demo", seed=1, played=PLAYED, tracking=TRACKING)
    page = Page(run_html(run))
    assert "Live, scenario “Demo”" in page.text
    assert "edge stress (E: 2 busy threads)" in page.text
    calm, stress, after = phase_rows(run, RunHeader.of(run))
    assert (calm.name, stress.name, after.name) == ("baseline", "edge stress", "baseline")
    assert (stress.migrations, stress.guard_moves) == (1, 1)
    assert stress.shares == {"SO": 10 / 11, "LOC": 1 / 11}
    assert calm.rms_mm == 3.0
    assert stress.rms_px == 8.0
    assert after.lost == 1


def test_a_run_in_earnest_has_no_scenario_and_no_phases() -> None:
    page = Page(run_html(live_run()))
    assert "Live: 5 windows" in page.text
    assert "scenario “" not in page.text
    assert "Played:" not in page.text


def test_moves_of_the_guard_are_told_apart_from_migrations() -> None:
    run = live_run()
    text = Page(run_html(run)).text
    assert "with 1 migration" in text
    assert "guard moved it 1 time" in text
    assert text.count("by the guard") == 1
    shown = run_timeline(
        run.windows, run.decisions, candidates=("LOC", "SO", "HYB"), period_ms=33,
        deadline_ms=50, slug="t",
    )  # fmt: skip
    assert shown.spans is not None
    marks = dict(shown.spans.select("label", "begin").rows())
    assert marks[MIGRATIONS] == pytest.approx(0.66)
    # Before the fourth window, whose first cycle is the 32nd.
    assert marks[GUARD] == pytest.approx(32 * PERIOD_NS / 1e9)
    assert marks["clocks unproven"] == marks[GUARD]


def test_it_says_how_well_it_is_known() -> None:
    text = Page(run_html(live_run())).text
    assert "1 of 6 windows (17 %) are unproven" in text
    assert "2 cycles are in no window (lead cycles)" in text
    assert "Of 1 of 62 cycles nothing was heard" in text
    assert "1 commands" not in text
    assert "1 command arrived and was not applied" in text


def test_a_torn_journal_is_told() -> None:
    recovered = {"sealed": False, "opened": 2, "torn_bytes": 17, "damaged_bytes": 0}
    text = Page(run_html(live_run(recovered=recovered))).text
    assert "The controller was started 2 times" in text
    assert "17 bytes at the journal's end were torn by a kill" in text
    assert "The run was not closed" in text


def test_a_run_without_an_error_has_no_panel_for_it() -> None:
    assert "tracking" not in run_html(live_run())
    assert "tracking error" in run_html(live_run(tracking=TRACKING))


@pytest.mark.parametrize(
    "told",
    [[], {"begin_s": 0}, {**TRACKING, "step_s": 0}, {**TRACKING, "rms_px": [1.0]}],
)
def test_an_error_that_cannot_be_read_is_refused(told: object) -> None:
    with pytest.raises(RunError, match="tracking error cannot be read"):
        run_html(live_run(tracking=told))


def test_rms_is_of_the_stretches_between_two_instants() -> None:
    tracking = Tracking.of({"tracking": TRACKING})
    assert tracking is not None
    mm, px = tracking.rms(0.33, 0.99)
    assert mm == pytest.approx(math.sqrt((9 + 16) / 2))
    assert px == pytest.approx(math.sqrt((36 + 64) / 2))
    assert math.isnan(tracking.rms(10, 11)[0])
