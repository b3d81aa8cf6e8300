"""Calibrate: runs of a cell that is known give that cell back, from the file of another one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.errors import RunError
from dwell.model import Constant, Problem
from dwell.record import Run
from dwell.sim import draw, simulate_realisation
from lab.tests.testbed.calibrated import Calibrated, calibrate
from tests.cells.known_cost import (
    BACKGROUND,
    CELL,
    observed,
)


@pytest.mark.parametrize(
    ("placement", "scenario"), [("LOC", "baseline"), ("OFF", "baseline"), ("OFF", "stress")]
)
def test_the_calibrated_cell_predicts_the_true_one(
    calibrated: Calibrated, truth: Problem, placement: str, scenario: str
) -> None:
    shown = []
    for problem, seed in ((truth, 11), (calibrated.problem, 12)):
        real = draw(problem, scenario=scenario, seed=seed, windows=150)
        run = simulate_realisation(problem, real, policy=placement)
        latency_ms = run.cycles["latency_ns"].to_numpy() / 1e6
        busy = [run.windows[f"u_{node}"].mean() for node in BACKGROUND]
        shown.append((np.quantile(latency_ms, 0.95), latency_ms.mean(), *busy))
    (true_l95, true_mean, *true_busy), (l95, mean, *busy) = shown
    assert l95 == pytest.approx(true_l95, rel=0.03)
    assert mean == pytest.approx(true_mean, rel=0.03)
    assert busy == pytest.approx(true_busy, abs=0.02)


def test_the_sidecar_names_the_runs_and_checks_the_cell(calibrated: Calibrated) -> None:
    said = json.loads(calibrated.sidecar.read_text())
    assert calibrated.sidecar.name == "measured.calibration.json"
    assert said["runs"] == ["LOC-baseline", "OFF-baseline", "OFF-stress", "OFF-far"]
    for row in said["check"]:
        assert row["predicted"]["mean_ms"] == pytest.approx(row["measured"]["mean_ms"], rel=0.04)


def test_the_check_plays_runs_with_the_estimators_that_they_had(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    """Shadow jobs load nodes: of a run without any, a cell that has some says nothing."""
    probing = tmp_path / "probing.yaml"
    half = "estimator: shadow, shadow_fraction: 0.5"
    probing.write_text(CELL.replace("estimator: profile", half))
    run, at = dwell.open_run(folders[0]), tmp_path / "runs"
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    tables |= {"processes": run.processes, "jobs": run.jobs}
    told = {name: Run({**run.meta, "estimator": name}, tables) for name in ("Profile", "Shadow")}
    runs = [*(one.save(at / name) for name, one in told.items()), folders[1]]
    said = calibrate(probing, runs, tmp_path / "out.yaml", say=lambda line: None).report["check"]
    without, beside = (row["predicted"]["u_E"] for row in said[:2])
    assert beside > without + 0.05
    # One of a user's own cannot be played.
    told["Oracle"] = Run({**run.meta, "estimator": "Oracle"}, tables)
    mine = [told["Oracle"].save(at / "Oracle"), folders[1]]
    said = calibrate(probing, mine, tmp_path / "out.yaml", say=lambda line: None).report["check"]
    assert [row["run"] for row in said] == [folders[1].name]


def test_a_node_without_a_quota_is_given_no_finding_that_only_a_quota_has(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    assert "background_beside" in calibrate(
        nominal, folders, tmp_path / "with.yaml", say=lambda line: None
    ).cell.read_text(encoding="utf-8")
    cell = tmp_path / "without.yaml"
    cell.write_text(CELL.replace(", quota: {cpu: 0.8, period_ms: 4}", ""), encoding="utf-8")
    written = calibrate(cell, folders, tmp_path / "out.yaml", say=lambda line: None).problem
    assert written.fabric.nodes["E"].background_beside is None
    assert written.fabric.nodes["R1"].background_beside is not None


def test_what_was_not_visited_stays(nominal: Path, folders: list[Path], tmp_path: Path) -> None:
    said: list[str] = []
    found = calibrate(nominal, folders[:1], tmp_path / "out.yaml", say=said.append)
    assert found.missing == ("find@E",)
    assert found.problem.pipeline.tasks["find"].on["E"].exec_ms == Constant(9)
    assert "find@E: not measured, unchanged" in said


def test_bad_input_is_refused_all_at_once(
    nominal: Path, truth: Problem, folders: list[Path], tmp_path: Path
) -> None:
    bare = dwell.simulate(truth, seed=1, windows=3, policy="LOC").save(tmp_path / "bare")
    other = observed(truth, nominal, "LOC")
    other.meta["problem"]["window_cycles"] = 20
    other.meta["problem"]["nodes"]["X"] = {"tier": "robot"}
    others = other.save(tmp_path / "other")
    with pytest.raises(RunError) as caught:
        calibrate(nominal, [bare, others, tmp_path / "none"], tmp_path / "out.yaml")
    said = str(caught.value)
    assert "bare: it kept no jobs with CPU times; record it with --jobs" in said
    assert "other: its nodes are E, R1, X, those of the cell E, R1" in said
    assert "other: window_cycles was 20, not 30" in said
    assert "none: no such folder" in said
    assert not (tmp_path / "out.yaml").exists()
    for out, words in ((nominal, "is the cell itself"), (tmp_path / "out", "ends in .yaml")):
        with pytest.raises(RunError, match=words):
            calibrate(nominal, folders, out)
    with pytest.raises(RunError, match="LOC-baseline: named twice"):
        calibrate(nominal, [folders[0], folders[0]], tmp_path / "out.yaml")
