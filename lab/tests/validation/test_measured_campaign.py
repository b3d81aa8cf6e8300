"""What a campaign has measured, read from folders whose runs are simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import dwell
from dwell import Run
from dwell.cellfile import from_document
from dwell.errors import RunError
from dwell.model.document import to_document
from dwell.record import seal_run
from dwell.study.summary import summarise
from dwell_lab.testbed.campaign import Campaign, entrant
from dwell_lab.testbed.execution import run_campaign
from dwell_lab.validation.campaign_questions import (
    fault_scenarios,
    questions,
    stress_scenarios,
)
from dwell_lab.validation.measured_campaign import MeasuredCampaign, read_measured, without_excluded
from lab.tests.testbed.simulated_runs import ALWAYS_IDLE, SimulatedRuns
from tests.cells.small import make_problem

PROBLEM = make_problem()
SCENARIOS = ("baseline", "robot-cpu-stress", "network-impairment")
POLICIES = ("LOC", "SO", "HYB", "atp", "dtp")


def campaign(repetitions: int) -> Campaign:
    window_s = PROBLEM.window_cycles * PROBLEM.pipeline.period_ms / 1e3
    return Campaign(
        PROBLEM,
        SCENARIOS,
        tuple(entrant(PROBLEM, name) for name in POLICIES),
        repetitions,
        seconds=(PROBLEM.warmup_windows + 6) * window_s,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("campaign") / "there"
    play = SimulatedRuns(lambda names: "error" if len(names) == 4 else "")
    run_campaign(campaign(2), found, play, tell=lambda line: None, wait=ALWAYS_IDLE)
    return found


@pytest.fixture(scope="module")
def measured(folder: Path) -> MeasuredCampaign:
    return read_measured(folder)


def test_a_repetition_takes_the_place_of_a_seed(measured: MeasuredCampaign) -> None:
    comparison = measured.comparison
    assert comparison.seeds == (1, 2)
    assert comparison.scenarios == SCENARIOS
    assert comparison.policies == POLICIES
    assert comparison.runs.height == 3 * 5 * 2
    assert len(comparison.values("baseline", "dtp", "violation_rate")) == 2
    assert measured.repetitions == 2
    assert measured.kinds == {"simulated"}


def test_excluded_windows_and_failures_are_counted(measured: MeasuredCampaign) -> None:
    # One of six windows of every run is excluded, see SimulatedRuns.
    assert measured.log["excluded"].to_list() == [1] * 30
    assert measured.log["windows"].to_list() == [6] * 30
    assert set(measured.comparison.runs["windows"]) == {5}
    assert measured.failed["outcome"].to_list() == ["error"]
    assert measured.log["attempt"].max() == 2


def test_excluded_windows_leave_with_their_cycles() -> None:
    run = dwell.simulate(PROBLEM, scenario="baseline", policy="LOC", seed=1, windows=8, jobs=True)
    gone = PROBLEM.warmup_windows + 1
    told = Run(
        {**run.meta, "pressure": {"excluded": [gone]}},
        {
            "cycles": run.cycles,
            "windows": run.windows,
            "decisions": run.decisions,
            "jobs": run.jobs,
        },
    )
    left = without_excluded(told, PROBLEM)
    first = int(run.windows["first_cycle"][gone])
    lost = set(range(first, first + PROBLEM.window_cycles))
    assert set(run.cycles["cycle"]) - set(left.cycles["cycle"]) == lost
    assert not lost & set(left.jobs["cycle"])
    assert gone not in left.windows["window"]
    row = summarise(left, PROBLEM, {}).row
    assert row["cycles"] == (7 - PROBLEM.warmup_windows) * PROBLEM.window_cycles


def test_latencies_are_shares_of_all_cycles(measured: MeasuredCampaign) -> None:
    runs, latencies = measured.comparison.runs, measured.comparison.latencies
    deadline_ms = PROBLEM.pipeline.deadline_ms
    for (scenario, policy), mine in runs.group_by("scenario", "policy"):
        at = latencies.filter(
            (pl.col("scenario") == scenario)
            & (pl.col("policy") == policy)
            & ((pl.col("latency_ms") - deadline_ms).abs() < 1e-6)
        )["share"]
        rates, cycles = (mine[name].to_numpy() for name in ("violation_rate", "cycles"))
        assert at.item() == pytest.approx(1 - np.average(rates, weights=cycles))


def test_a_campaign_that_goes_on_can_be_read(tmp_path: Path) -> None:
    there = tmp_path / "there"
    with pytest.raises(RunError, match="not a campaign"):
        read_measured(there)

    def stopped(names: object) -> str:
        return "stop" if isinstance(names, list) and len(names) == 8 else ""

    with pytest.raises(KeyboardInterrupt):
        run_campaign(
            campaign(3), there, SimulatedRuns(stopped), tell=lambda line: None, wait=ALWAYS_IDLE
        )
    found = read_measured(there)
    assert (found.log.height, found.planned, found.repetitions) == (7, 45, 0)
    # One repetition, and not everything of it: nothing is tested, nothing breaks.
    for chapter in questions(found):
        assert chapter.answer == "not shown"


def test_questions_are_asked_where_they_apply(measured: MeasuredCampaign) -> None:
    names = tuple(PROBLEM.scenarios)
    assert "robot-cpu-stress" in stress_scenarios(PROBLEM, names)
    assert fault_scenarios(PROBLEM, SCENARIOS) == ("network-impairment",)
    one, two = questions(measured)
    assert one.title.startswith("RQ1")
    assert two.title.startswith("RQ2")
    assert one.answer == two.answer == "not shown"
    for asked in (one, two):
        assert set(asked.table["word"]) == {"cannot tell with 2 seeds"}
        assert (asked.table["p_least"] > 0.05).all()
        assert set(asked.table["metric"]) == {"violation_rate", "l95_ms", "u_robot", "cost"}
    comparison = replace(measured.comparison, policies=("LOC", "dtp"))
    assert questions(replace(measured, comparison=comparison)) == ()


def test_jobs_are_not_needed(folder: Path, tmp_path: Path) -> None:
    run = dwell.simulate(PROBLEM, scenario="baseline", policy="LOC", seed=1, windows=8)

    def play(problem: object, *, out: Path, **_: object) -> Path:
        path = run.save(out / "runs" / "1")
        seal_run(path, pressure=None)
        return path

    asked = replace(campaign(1), scenarios=("baseline",), entrants=(entrant(PROBLEM, "LOC"),))
    run_campaign(asked, tmp_path / "there", play, tell=lambda line: None, wait=ALWAYS_IDLE)
    found = read_measured(tmp_path / "there")
    assert found.profiles.is_empty()
    assert found.links.is_empty()


def test_a_campaign_is_read_without_the_files_that_its_cell_replays(tmp_path: Path) -> None:
    file = tmp_path / "beside" / "times.csv"
    file.parent.mkdir()
    file.write_text("took\n4.0\n6.0\n")
    document = to_document(PROBLEM)
    replayed = {"trace": {"file": file.name, "column": "took", "wrap": True}}
    document["tasks"]["perception"]["on"]["R1"]["exec_ms"] = replayed
    problem = from_document(document, folder=file.parent)
    seconds = campaign(1).seconds
    problem = replace(problem, folder=str(file.parent))
    asked = Campaign(problem, ("baseline",), (entrant(problem, "LOC"),), 1, seconds)
    found = tmp_path / "there"
    run_campaign(asked, found, SimulatedRuns(), tell=lambda line: None, wait=ALWAYS_IDLE)
    file.unlink()
    comparison = read_measured(found).comparison
    assert comparison.problem.pipeline.tasks["perception"].on["R1"].exec_ms.expectation == 5.0
