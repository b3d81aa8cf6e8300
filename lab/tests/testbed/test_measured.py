"""What a run shows of its tasks, before anything is calibrated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.model import Problem
from dwell.record import Run
from dwell_lab.testbed.measured import look_at


def test_a_job_beside_a_job_is_no_background(
    nominal: Path, truth: Problem, folders: list[Path]
) -> None:
    run = dwell.open_run(folders[0])
    shadowed = (pl.col("task").cast(pl.String) == "find") & (pl.col("cycle") % 5 == 0)
    # A shadow begins within the job, and ends after it; what it takes is counted as others'.
    shadows = run.jobs.filter(shadowed).with_columns(
        start_ns=(pl.col("start_ns") + pl.col("end_ns")) // 2,
        end_ns=pl.col("end_ns") + 10**6,
        shadow=pl.lit(value=True),
    )
    jobs = run.jobs.with_columns(
        others_ns=pl.col("others_ns") + pl.when(shadowed).then(5 * 10**6).otherwise(0),
        shadow=pl.lit(value=False),
    )
    jobs = pl.concat([jobs, shadows.select(jobs.columns)])
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    both = [
        look_at("one", one, dwell.load(nominal))
        for one in (run, Run(run.meta, {**tables, "processes": run.processes, "jobs": jobs}))
    ]
    (taken_s, took_s), (left_s, out_of_s) = (one.beside["R1"] for one in both)
    assert left_s / out_of_s == pytest.approx(taken_s / took_s, rel=1e-3)
    assert out_of_s < 0.95 * took_s
    for one in both:
        assert np.abs(one.visits["find", "R1"].beside_ms).max() < 0.01


def test_what_the_end_of_a_cycle_takes_is_counted_where_it_can_be(
    nominal: Path, folders: list[Path], tmp_path: Path
) -> None:
    run = dwell.open_run(folders[0])
    last = pl.col("task").cast(pl.String) == "act"
    jobs = run.jobs.with_columns(ending_ns=pl.when(last).then(pl.lit(700_000)))
    tables = {"cycles": run.cycles, "windows": run.windows, "decisions": run.decisions}
    told = Run(run.meta, {**tables, "processes": run.processes, "jobs": jobs})
    found = [look_at("one", one, dwell.load(nominal)).ends_ms for one in (run, told)]
    assert found[0]["act", "R1"] < 0.5
    assert found[1] == {("act", "R1"): pytest.approx(0.7)}
