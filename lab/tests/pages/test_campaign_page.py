"""The page and the text of a campaign, and the commands that write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.report.page import page_html
from dwell.study import UNTOLD
from dwell_lab.pages.campaign_page import campaign_page, campaign_text
from dwell_lab.testbed.campaign import Campaign, default_entrants, default_scenarios, entrant
from dwell_lab.testbed.execution import run_campaign
from dwell_lab.validation.measured_campaign import MeasuredCampaign, read_measured
from lab.tests.testbed.simulated_runs import ALWAYS_IDLE, SimulatedRuns
from tests.cells.small import make_problem
from tests.report.pages import Page, facts_of, table_of

PROBLEM = make_problem()
SECONDS = (PROBLEM.warmup_windows + 4) * PROBLEM.window_cycles * PROBLEM.pipeline.period_ms / 1e3


def made(folder: Path, names: tuple[str, ...], repetitions: int) -> Path:
    entrants = tuple(entrant(PROBLEM, name) for name in names) or default_entrants(PROBLEM)
    asked = Campaign(PROBLEM, default_scenarios(PROBLEM), entrants, repetitions, SECONDS)
    play = SimulatedRuns(lambda names: "pressure" if len(names) == 3 else "")
    run_campaign(asked, folder, play, tell=lambda line: None, wait=ALWAYS_IDLE)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("campaign") / "there", (), 2)


@pytest.fixture(scope="module")
def measured(folder: Path) -> MeasuredCampaign:
    return read_measured(folder)


def test_the_page_is_whole_and_loads_nothing(measured: MeasuredCampaign) -> None:
    page = Page(page_html(campaign_page(measured), static=True))
    assert page.outside == []
    assert "script" not in page.tags
    assert len(page.ids) == len(set(page.ids))
    for heading in ("Results", "Figures", "Times of jobs", "Delays of messages"):
        assert heading in page.headings
    # Of every policy and scenario: four measures, five distributions; shares, parts, delays.
    assert page.tags.count("svg") == 12


def test_the_page_counts_what_does_not_count(measured: MeasuredCampaign) -> None:
    page, runs = campaign_page(measured), measured.log.height
    facts = facts_of(page)
    assert facts["made of"].value == "simulated runs"
    assert facts["windows excluded"].value == str(runs)
    assert facts["windows excluded"].error.startswith(f"of {4 * runs}")
    assert facts["attempts that failed"].value == "1"
    assert [row["outcome"] for row in table_of(page, "failed").rows] == ["failed"]


def test_a_verdict_says_the_least_p_that_it_can_have(measured: MeasuredCampaign) -> None:
    table = table_of(campaign_page(measured), "question-0")
    assert table.caption.endswith(f" {UNTOLD}: cannot tell with 2 seeds.")
    for row in table.rows:
        # Of two repetitions no p is below 1/2, before Holm.
        assert row["p_least"] >= 0.5
        assert row["word"] == UNTOLD


def test_the_text_has_everything_and_the_answers_last(measured: MeasuredCampaign) -> None:
    text = campaign_text(measured)
    for words in ("Every policy in every scenario", "CUSUM (corrected)", "Answer: not shown"):
        assert words in text
    assert max(map(len, campaign_text(measured, width=100).splitlines())) <= 100


def test_a_campaign_of_one_policy_has_a_page(tmp_path: Path) -> None:
    found = read_measured(made(tmp_path / "there", ("LOC",), 1))
    page = Page(page_html(campaign_page(found), static=True))
    assert "RQ1" not in page.text
    assert page.outside == []
