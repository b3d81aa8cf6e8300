"""The timeline of a run: marks, estimates, moves, and what is shaded."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.model.disturbed import Disturbed
from dwell.report.figure import Figure, printed_svg, svg
from dwell.report.timeline import (
    MOST_BINS,
    MOST_MARKS,
    begins_by_number,
    resources_in,
    run_timeline,
)
from tests.cells.examples import EXAMPLES
from tests.cells.small import make_problem

PROBLEM = make_problem()
STRESS = Disturbed(3.0, 1e9, "R1: 2 busy threads", "robot stress")


def timeline(run: dwell.Run, **more: object) -> Figure:
    return run_timeline(
        run.windows,
        run.decisions,
        begins_by_number(run.windows, PROBLEM.pipeline.period_ms),
        PROBLEM,
        slug="time",
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


def test_a_printed_figure_has_no_links(run: dwell.Run) -> None:
    figure = timeline(run, links={0: "#window-0"})
    assert '"#window-0"' in svg(figure)
    printed = printed_svg(figure)
    assert "#window-0" not in printed
    assert "vega.github.io" not in printed


def test_resources_are_those_that_windows_tell_of() -> None:
    problem = dwell.load(EXAMPLES / "fan-in.yaml")
    windows = dwell.simulate(problem, policy="EDGE", seed=1, windows=2).windows
    assert resources_in(windows, problem) == ("R1", "R2", "E", "E.gpu")
    unmeasured = windows.with_columns(pl.lit(None, pl.Float64).alias("u_E.gpu"))
    assert resources_in(unmeasured, problem) == ("R1", "R2", "E")


def test_what_goes_on_beyond_the_run_is_shaded_to_its_end(run: dwell.Run) -> None:
    figure = timeline(run, disturbed=[STRESS])
    window_s = PROBLEM.window_cycles * PROBLEM.pipeline.period_ms / 1e3
    spans = {what: ends for what, *ends in figure.frames["spans"].rows()}
    assert spans[STRESS.what] == pytest.approx([3.0, 60 * window_s])
    assert spans["warm-up"] == pytest.approx([0.0, 2 * window_s])
    assert STRESS.what in svg(figure)


def long_run(run: dwell.Run, windows: int) -> dwell.Run:
    """Return a run of so many windows, those of a shorter one again and again."""
    tables = pl.concat([run.windows] * math.ceil(windows / run.windows.height)).head(windows)
    numbers = pl.int_range(0, windows, dtype=pl.Int64)
    repeated = tables.with_columns(window=numbers, first_cycle=numbers * PROBLEM.window_cycles)
    return dwell.Run(
        run.meta, {"cycles": run.cycles, "windows": repeated, "decisions": run.decisions}
    )


@pytest.mark.parametrize(
    ("field", "column", "factor"),
    [("v_d", "violation_rate", 100), ("l95", "seen_l95_ms", 1), ("j", "cost", 1)],
)
def test_a_mark_of_several_windows_shows_their_quantiles(
    field: str, column: str, factor: int, run: dwell.Run
) -> None:
    whole = long_run(run, 1_501)
    marks = timeline(whole).frames["windows"]
    assert 100 <= marks.height <= MOST_BINS
    assert marks["windows"].sum() == 1_501
    assert field not in marks.columns
    values, ends = whole.windows[column].to_numpy() * factor, np.cumsum(marks["windows"])
    for number, part in enumerate(np.split(values, ends[:-1])):
        shares = [np.quantile(part, share) for share in (0, 0.25, 0.5, 0.75, 1)]
        found = marks.row(number, named=True)
        names = [f"{field}_{end}" for end in ("min", "q1", "median", "q3", "max")]
        assert [found[name] for name in names] == pytest.approx(shares)


def test_use_and_estimates_of_several_windows_are_no_maxima(run: dwell.Run) -> None:
    whole = long_run(run, 1_501)
    used = timeline(whole).frames["nodes"]
    for node in PROBLEM.fabric.nodes:
        mine, every = used.filter(node=node), whole.windows[f"u_{node}"].cast(pl.Float64) * 100
        assert mine["used_min"].min() == pytest.approx(every.min())
        assert mine["used_max"].max() == pytest.approx(every.max())
        assert (mine["used_q1"] <= mine["used_median"]).all()
        assert (mine["used_median"] <= mine["used_q3"]).all()


def test_a_figure_says_how_many_windows_a_mark_is(run: dwell.Run) -> None:
    figure = timeline(long_run(run, 1_501), caption="More.")
    for text in (svg(figure), printed_svg(figure)):
        assert "a mark: median, quartiles, extremes of 13 windows" in text
    assert "quartiles" in figure.caption
    assert "windows" not in svg(timeline(run))
    assert timeline(run, caption="More.").caption.startswith("A mark is a window")


def test_a_mark_of_several_windows_has_the_placement_that_most_had_or_the_first(
    run: dwell.Run,
) -> None:
    count = 1_200
    windows = long_run(run, count).windows.with_columns(
        placement=pl.Series((["SO"] * 5 + ["LOC"] * 5) * (count // 10)),
    )
    tables = {"cycles": run.cycles, "windows": windows, "decisions": run.decisions}
    marks = timeline(dwell.Run(run.meta, tables)).frames["windows"]
    assert marks["placement"].to_list() == ["SO"] * MOST_BINS


def test_up_to_six_hundred_windows_each_has_a_mark(run: dwell.Run) -> None:
    assert timeline(long_run(run, MOST_MARKS)).frames["windows"].height == MOST_MARKS
    assert timeline(long_run(run, MOST_MARKS + 1)).frames["windows"].height <= MOST_BINS
