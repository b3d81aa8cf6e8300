"""A short campaign on a real testbed: two policies, one of which moves."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

import dwell
from dwell.errors import LiveError
from dwell.record import open_run
from dwell.report.page import page_html
from dwell_lab.pages.campaign_page import campaign_page
from dwell_lab.testbed.campaign import Campaign, entrant
from dwell_lab.testbed.campaign_folder import read_campaign
from dwell_lab.testbed.execution import run_campaign
from dwell_lab.testbed.idle import Quiet
from dwell_lab.testbed.run import require_machine, run_once
from dwell_lab.validation.measured_campaign import read_measured
from lab.tests.testbed.machine import own_name

CELL = Path(__file__).parents[3] / "examples" / "visual_servoing" / "testbed.yaml"
#: Of each run: four windows of two seconds after that of warm-up.
SECONDS = 10.0
SCENARIOS, POLICIES = ("baseline",), ("SO", "cusum+corrected")
#: Others may use the machine that tests run on: that is recorded, and not waited for.
QUIET = Quiet(for_s=1.0, patience_s=1.0)


def _missing() -> str:
    """Why this machine cannot run the testbed; empty if it can."""
    try:
        require_machine(dwell.load(CELL))
    except LiveError as error:
        return str(error)
    return ""


def test_a_campaign_is_measured_and_reported(tmp_path: Path) -> None:
    why = _missing()
    if why:
        pytest.skip(why)
    problem = replace(dwell.load(CELL), warmup_windows=1)
    asked = Campaign(
        problem, SCENARIOS, tuple(entrant(problem, name) for name in POLICIES), 1, SECONDS
    )
    folder = tmp_path / "there"
    told: list[str] = []
    state = run_campaign(
        asked,
        folder,
        run_once,
        name=own_name(),
        quiet=QUIET,
        repeats=0,
        tell=told.append,
    )
    print("\n".join(told), file=sys.stderr)
    # Pressure of other work may spoil runs of this one, and errors may not.
    kept = read_campaign(folder)
    assert [one for one in kept.failed if one["outcome"] == "error"] == []
    assert state.done + len(state.given_up) == len(SCENARIOS) * len(POLICIES)
    for path in kept.done:
        run = open_run(path)
        assert run.meta["kind"] == "live"
        assert run.windows.height > problem.warmup_windows
        assert run.has_jobs
    if not state.done:
        pytest.skip("the machine was the bottleneck in every run")
    measured = read_measured(folder)
    assert measured.kinds == {"live"}
    assert "Delays of messages" in page_html(campaign_page(measured), static=True)
