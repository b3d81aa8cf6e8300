"""The timeline of a run: marks, estimates, moves, and what is shaded."""

from __future__ import annotations

from dataclasses import replace

import polars as pl
import pytest

import dwell
from dwell.report.figure import Figure, svg
from dwell.report.palette import Palette
from dwell.report.phases import Disturbed
from dwell.report.timeline import MOST_MARKS, begins_by_number, run_timeline
from tests.cells.small import make_problem

PROBLEM = make_problem()
STRESS = Disturbed(3.0, 1e9, "R1: 2 busy threads", "robot stress")


def timeline(run: dwell.Run, **more: object) -> Figure:
    return run_timeline(
        run.windows,
        run.decisions,
        begins_by_number(run.windows, PROBLEM.pipeline.period_ms),
        slug="time",
        palette=Palette.of(tuple(PROBLEM.candidates)),
        nodes=tuple(PROBLEM.fabric.nodes),
        deadline_ms=PROBLEM.pipeline.deadline_ms,
        **more,  # type: ignore[arg-type]
    )


@pytest.fixture(scope="module")
def run() -> dwell.Run:
    problem = replace(PROBLEM, warmup_windows=2)
    return dwell.simulate(
        problem, scenario="robot-cpu-stress", policy="latency-first", seed=1, windows=60
    )


def test_every_window_has_a_mark_with_what_it_showed(run: dwell.Run) -> None:
    frames = timeline(run, links={0: "#window-0"}).frames
    marks = frames["windows"]
    assert marks["window"].to_list() == list(range(60))
    assert marks["v_d"].to_list() == (run.windows["violation_rate"] * 100).to_list()
    assert marks["link"].to_list() == ["#window-0", *[None] * 59]
    assert set(frames["nodes"]["node"]) == set(PROBLEM.fabric.nodes)
    moved = run.decisions["migrated"].sum()
    assert moved
    assert frames["moves"].height == moved


def test_what_goes_on_beyond_the_run_is_shaded_to_its_end(run: dwell.Run) -> None:
    figure = timeline(run, disturbed=[STRESS])
    window_s = PROBLEM.window_cycles * PROBLEM.pipeline.period_ms / 1e3
    spans = {what: ends for what, *ends in figure.frames["spans"].rows()}
    assert spans[STRESS.what] == pytest.approx([3.0, 60 * window_s])
    assert spans["warm-up"] == pytest.approx([0.0, 2 * window_s])
    assert STRESS.what in svg(figure)


def test_of_too_many_windows_the_worst_of_several_is_a_mark(run: dwell.Run) -> None:
    windows = pl.concat([run.windows] * 25).with_columns(
        window=pl.int_range(0, 1500, dtype=pl.Int64),
        first_cycle=pl.int_range(0, 1500, dtype=pl.Int64) * PROBLEM.window_cycles,
    )
    tables = {"cycles": run.cycles, "windows": windows, "decisions": run.decisions}
    marks = timeline(dwell.Run(run.meta, tables)).frames["windows"]
    assert 0 < marks.height <= MOST_MARKS
    assert marks["v_d"].max() == pytest.approx(100 * run.windows["violation_rate"].to_numpy().max())


def test_a_mark_of_several_windows_has_the_placement_that_most_had_or_the_first(
    run: dwell.Run,
) -> None:
    count = 2 * MOST_MARKS
    windows = pl.concat([run.windows.head(1)] * count).with_columns(
        window=pl.int_range(0, count, dtype=pl.Int64),
        first_cycle=pl.int_range(0, count, dtype=pl.Int64) * PROBLEM.window_cycles,
        placement=pl.Series(["SO", "LOC"] * MOST_MARKS),
    )
    tables = {"cycles": run.cycles, "windows": windows, "decisions": run.decisions}
    marks = timeline(dwell.Run(run.meta, tables)).frames["windows"]
    assert marks["placement"].to_list() == ["SO"] * MOST_MARKS
