"""The schema of a Run: what runs have is what it declares, and what the documentation shows."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import polars as pl
import pytest

import dwell
from docs import columns
from dwell.model import REASONS, Problem, Reason
from dwell.model.table_columns import TABLES, Column, Feature
from dwell.record import (
    OUTCOME_SENTENCES,
    OUTCOMES,
    REASON_SENTENCES,
    column_types,
    shown_reason,
)
from dwell.record.schema import frame_of, polars_schema, row_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def problem() -> Problem:
    cell = dwell.load(ROOT / "examples" / "canonical.yaml")
    return replace(cell, window_cycles=20, controller=replace(cell.controller, decide_cycles=20))


def declared(table: str, problem: Problem, *features: Feature) -> pl.Schema:
    return pl.Schema(polars_schema(column_types(table, problem, features)))


@pytest.mark.parametrize("policy", ["dtp", "LOC"])
@pytest.mark.parametrize("estimator", ["profile", "scaling", "shadow", "corrected"])
def test_a_simulated_run_has_the_declared_columns_and_types(
    problem: Problem, policy: str, estimator: str
) -> None:
    run = dwell.simulate(problem, policy=policy, estimator=estimator, seed=1, windows=3, jobs=True)
    shadows: list[Feature] = ["shadows"] if estimator in ("shadow", "corrected") else []
    support: list[Feature] = [] if estimator == "profile" else ["support"]
    assert run.cycles.schema == declared("cycles", problem)
    assert run.windows.schema == declared("windows", problem, *shadows)
    assert run.decisions.schema == declared("decisions", problem, *support)
    assert run.jobs.schema == declared("jobs", problem, *shadows)


@pytest.mark.parametrize("policy", ["dtp", "dtp+scaling"])
def test_decisions_between_closes_have_the_metrics_that_they_look_at(
    problem: Problem, policy: str
) -> None:
    often = replace(problem, controller=replace(problem.controller, decide_cycles=5))
    run = dwell.simulate(often, policy=policy, seed=1, windows=3)
    support: list[Feature] = ["support"] if policy == "dtp+scaling" else []
    assert run.decisions.schema == declared("decisions", often, "between", *support)
    assert run.windows.schema == declared("windows", often)
    # After a whole window under one placement both say the same of its cycles.
    (row,) = run.decisions.filter(pl.col("last_cycle") == 19).iter_rows(named=True)
    window = run.windows.row(0, named=True)
    assert row["cycles"] == 20
    for column in ("seen_l95_ms", "seen_violation_rate", "u_R1", "u_E", "u_R2"):
        assert row[column] == window[column]


@pytest.mark.parametrize("scenario", ["network-impairment", "baseline"])
def test_only_columns_that_say_when_are_null(problem: Problem, scenario: str) -> None:
    run = dwell.simulate(problem, scenario=scenario, policy="dtp", seed=1, windows=6, jobs=True)
    for name in ("cycles", "windows", "decisions", "jobs"):
        frame: pl.DataFrame = getattr(run, name)
        for column in TABLES[name].columns:
            for found in matching(frame, column):
                assert column.null or frame[found].null_count() == 0, found
                assert not (column.null and frame[found].dtype == pl.Float64) or (
                    not frame[found].is_nan().any()
                ), found


def matching(frame: pl.DataFrame, column: Column) -> list[str]:
    """Return the columns of a table that a declaration stands for."""
    pattern = re.sub(r"\\\{\w+\\\}", ".+", re.escape(column.name))
    return [name for name in frame.columns if re.fullmatch(pattern, name)]


def test_columns_of_nodes_and_candidates_are_in_the_cells_order(problem: Problem) -> None:
    names = [name for name in column_types("decisions", problem) if name.startswith("est_u_")]
    assert names == [
        f"est_u_{node}_{candidate}"
        for node in problem.fabric.nodes
        for candidate in problem.candidates
    ]


def test_a_live_run_has_a_simulated_ones_columns_first(problem: Problem) -> None:
    for table in ("cycles", "windows"):
        simulated = list(column_types(table, problem))
        assert list(column_types(table, problem, ["live"]))[: len(simulated)] == simulated


def test_values_go_by_name(problem: Problem) -> None:
    types = column_types("processes", problem)
    values = {"cpu_ns": 7, "node": "E", "process": "agent@E", "window": 3}
    assert row_of(types, values) == (3, "agent@E", "E", 7)
    frame = frame_of("processes", problem, {name: [value] for name, value in values.items()})
    assert frame.rows() == [(3, "agent@E", "E", 7)]
    assert frame.schema == declared("processes", problem)


def test_a_missing_and_an_unknown_column_are_named(problem: Problem) -> None:
    values = {"cpu_time_ns": 7, "node": "E", "process": "agent@E", "window": 3}
    with pytest.raises(ValueError, match=r"without values: cpu_ns; .* columns: cpu_time_ns"):
        row_of(column_types("processes", problem), values)
    with pytest.raises(ValueError, match=r"without values: cpu_ns; .* columns: cpu_time_ns"):
        frame_of("processes", problem, {name: [value] for name, value in values.items()})


def test_nan_is_null_only_where_a_column_may_be(problem: Problem) -> None:
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=2)
    values: dict[str, object] = {name: run.windows[name] for name in run.windows.columns}
    values |= {"cost": np.array([np.nan, 1.0]), "l95_ms": np.array([np.inf, 2.0])}
    frame = frame_of("windows", problem, values)
    assert frame["cost"].to_list() == [None, 1.0]
    assert frame["l95_ms"].to_list() == [np.inf, 2.0]


def test_every_outcome_and_reason_has_a_sentence() -> None:
    assert set(OUTCOME_SENTENCES) == set(OUTCOMES)
    assert tuple(REASON_SENTENCES) == REASONS == get_args(Reason)


def test_only_infeasible_is_shown_by_its_sentence() -> None:
    assert shown_reason("hold") == "hold"
    assert shown_reason("infeasible") == "all candidates are over a cap, this one least"


def test_the_page_of_columns_is_the_schema() -> None:
    """`python -m docs.columns` writes its tables."""
    assert columns.PAGE.read_text(encoding="utf-8") == columns.page()
