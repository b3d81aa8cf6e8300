"""Pages of cells with several rates: idle cycles are no lost cycles, and L95 may be of ages."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import dwell
from dwell.cellfile.cell import from_document
from dwell.model import Problem
from dwell.report.charts import latency_limit
from dwell.report.comparison_page import comparison_page
from dwell.report.phases import phase_rows
from dwell.report.run_header import RunHeader
from dwell.report.run_page import run_page
from dwell.report.study_page import study_page
from dwell.study import Contender, Point, Study, compare, open_study, run_study
from dwell.study.summary import GRID_PER_DEADLINE
from tests.report.pages import figure_of, table_of


def sparse(**changes: object) -> Problem:
    """Return a cell whose only sink runs in every fourth cycle, and takes 3 ms."""
    document: dict[str, Any] = {
        "dwell": 1,
        "name": "sparse",
        "period_ms": 5,
        "window_cycles": 8,
        "nodes": {"R": {"tier": "robot"}},
        "tasks": {
            "see": {"every": 8, "on": {"R": {"exec_ms": 1}}},
            "act": {"every": 4, "on": {"R": {"exec_ms": 3}}},
        },
        "flows": [{"from": "see", "to": "act", "sampled": True}],
        "chains": {"see-act": {"from": "see", "to": "act", "max_age_ms": 90}},
        "candidates": {"R": {}},
        "scenarios": {"busy": [{"node": "R", "at_s": 0.2, "stress_threads": 1}]},
        **changes,
    }
    return from_document(document)


@cache
def run() -> dwell.Run:
    return dwell.simulate(sparse(), scenario="busy", policy="R", seed=1, windows=10)


def test_phases_have_no_idle_cycles() -> None:
    calm, busy = phase_rows(run(), RunHeader.of(run()))
    assert [calm.cycles, busy.cycles] == [10, 10]
    assert [calm.lost, busy.lost] == [0, 0]
    assert math.isfinite(calm.l95_ms)
    assert math.isfinite(busy.l95_ms)
    assert busy.violation_rate == 1.0


def test_equal_latencies_are_a_line_with_one_step() -> None:
    free = sparse(nodes={"R": {"tier": "robot", "cores": 2}})
    found = compare(
        free, scenarios=("baseline",), policies=("R",), seeds=(1,), windows=3, processes=1
    )
    (rows,) = figure_of(comparison_page(found), "latencies").frames.values()
    step_ms = sparse().pipeline.deadline_ms / GRID_PER_DEADLINE
    *before, (at_ms, share) = rows.select("latency_ms", "longer").rows()
    assert before[0] == (0.0, 1.0)
    assert {longer for _, longer in before} == {1.0}
    assert share == 0.0
    assert 3.0 <= at_ms < 3.0 + step_ms


def test_figures_have_no_idle_cycles() -> None:
    page = run_page(run())
    (longer,) = figure_of(page, "latencies").frames.values()
    assert longer.filter(longer["longer"] < 0.1).height > 0
    cycles = next(one for one in page.figures if one.slug.startswith("cycles-"))
    assert cycles.frames["lost"].is_empty()
    assert cycles.frames["parts"]["cycle"].n_unique() == 2


def test_the_limit_of_l95_is_of_the_chain_in_j() -> None:
    assert latency_limit(sparse()) == (5.0, "deadline")
    assert latency_limit(sparse(objective={"latency": "see-act"})) == (90.0, "age limit")


def test_a_page_without_an_age_limit_has_no_line() -> None:
    unbounded = sparse(
        chains={"see-act": {"from": "see", "to": "act"}}, objective={"latency": "see-act"}
    )
    page = run_page(dwell.simulate(unbounded, policy="R", seed=1, windows=10))
    caption = figure_of(page, "time").caption
    assert "of the data ages of see-act" in caption
    assert "limit" not in caption


def test_a_study_with_parameters_shows_ages(tmp_path: Path) -> None:
    values = ({"deadline_ms": ms} for ms in (4, 5))
    study = Study(
        name="ages",
        points=tuple(Point(one, sparse(**one)) for one in values),
        scenarios=("baseline",),
        contenders=(Contender("R", "R"),),
        seeds=(1,),
        windows=4,
    )
    run_study(study, folder=tmp_path / "ages", processes=1)
    page = study_page(open_study(tmp_path / "ages"))
    rows = table_of(page, "pivot-age_l95_see-act-0").rows
    # Old data are 23 and 44 ms old; in the first window an actuation without data comes after 4.
    assert [(row["4"], row["5"]) for row in rows] == [((23 + 3 * 44) / 4,) * 2]
