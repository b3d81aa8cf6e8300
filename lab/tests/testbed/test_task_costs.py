"""Task costs: what every task takes, from runs of a cell whose costs are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.record import Run
from lab.tests.testbed.calibrated import Calibrated, calibrate
from tests.cells.known_cost import (
    MESSAGING_MS,
    STAGE_MS,
)


def test_execution_times_are_found(calibrated: Calibrated) -> None:
    about = calibrated.report["tasks"]
    for (task, node), stage_ms in STAGE_MS.items():
        found = about[f"{task}@{node}"]
        assert found["stage_ms"] == pytest.approx(stage_ms, rel=0.02)
    # What a message took of its sender and of its receiver is parted by their messaging in all.
    for node in ("R1", "E"):
        way = [("see", "R1"), ("find", node), ("act", "R1")]
        of = [about[f"{task}@{where}"] for task, where in way]
        besides_ms = sum(one["before_ms"] + one["after_ms"] for one in of)
        assert besides_ms == pytest.approx(sum(MESSAGING_MS[site] for site in way), rel=0.08)
    assert calibrated.missing == ()
    # What is stressed says nothing of its node, and a link that is worse nothing of itself.
    assert "OFF-stress" not in about["find@E"]["of_runs"]
    assert "OFF-stress" in about["see@R1"]["of_runs"]


def test_what_a_node_takes_beside_a_job_varies_with_the_job(
    nominal: Path, folders: list[Path], calibrated: Calibrated, tmp_path: Path
) -> None:
    run = dwell.open_run(folders[0])
    found = run.jobs["task"].cast(pl.String) == "find"
    more_ns = np.random.default_rng(1).gamma(2, 0.5e6, run.jobs.height)
    more = pl.Series(np.where(found, more_ns, 0)).cast(pl.Int64)
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    tables |= {"processes": run.processes}
    jobs = run.jobs.with_columns(others_ns=pl.col("others_ns") + more)
    folder = Run(run.meta, {**tables, "jobs": jobs}).save(tmp_path / "LOC-baseline")
    said = calibrate(nominal, [folder, *folders[1:]], tmp_path / "out.yaml", say=lambda line: None)
    usual, now = (one.report["tasks"]["find@R1"] for one in (calibrated, said))
    # The mean is the background's, what it varies by is the job's: the quota is the same.
    assert now["mean_ms"] == pytest.approx(usual["mean_ms"], abs=0.01)
    assert now["std_ms"] ** 2 == pytest.approx(usual["std_ms"] ** 2 + 0.5, rel=0.2)
    # All of the background at most.
    assert said.report["background_beside"]["R1"] == said.report["background"]["R1"]
