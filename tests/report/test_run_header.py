"""The header of a run's page: what its record says, and what it leaves out."""

from __future__ import annotations

import math

import pytest

import dwell
from dwell.errors import RunError
from dwell.report.run_header import RunHeader, Tracking
from dwell.report.run_page import run_page
from tests.cells.small import make_problem
from tests.report.live_runs import TRACKING, live_run

PROBLEM = make_problem()


def tables(run: dwell.Run) -> dict[str, object]:
    return {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}


def test_a_simulated_run_says_what_it_is_of() -> None:
    run = dwell.simulate(
        PROBLEM, scenario="robot-cpu-stress", policy="cusum+corrected", seed=7, windows=6
    )
    header = RunHeader.of(run)
    assert (header.kind, header.live) == ("simulated", False)
    assert (header.problem.name, header.scenario, header.seed) == (
        PROBLEM.name,
        "robot-cpu-stress",
        "7",
    )
    assert header.policy_name == "Cusum"
    assert header.estimator == "Corrected"
    assert header.shadows == "0.05 under LOC, 0.05 under SO, 0.05 under HYB"
    assert header.problem.candidates == PROBLEM.candidates
    assert header.problem.window_cycles == PROBLEM.window_cycles
    assert [one.kind for one in header.disturbed] == ["robot stress"]


def test_a_live_run_says_so_and_what_is_unknown_is_a_dash() -> None:
    run = live_run()
    header = RunHeader.of(run)
    assert header.live
    bare = {name: value for name, value in run.meta.items() if name not in ("policy", "seed")}
    bare = RunHeader.of(dwell.Run(bare, tables(run)))  # type: ignore[arg-type, assignment]
    assert (bare.policy, bare.policy_name, bare.seed) == ("–", "–", "–")  # type: ignore[attr-defined]


def test_a_record_without_its_problem_cannot_be_reported() -> None:
    run = dwell.simulate(PROBLEM, policy="LOC", seed=1, windows=3)
    meta = {name: value for name, value in run.meta.items() if name != "problem"}
    with pytest.raises(RunError, match="its record of the problem is incomplete"):
        RunHeader.of(dwell.Run(meta, tables(run)))  # type: ignore[arg-type]


# ---------------------------------------------------------------------------- tracking error


def test_a_run_without_one_has_none() -> None:
    assert Tracking.of({}) is None


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
