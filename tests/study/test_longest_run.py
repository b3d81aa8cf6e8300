"""Runs are no longer than recorded traces allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dwell.errors import TraceError
from dwell.model import Problem, Trace, TraceTable
from dwell.study import longest_run
from tests.cells.small import make_problem


def with_trace(rows: int, *, wrap: bool = False) -> Problem:
    """Return the small cell with a trace of so many rows in the place of its scale."""
    problem = make_problem()
    table = TraceTable(file="scene.csv", columns={"scale": np.ones(rows)}, wrap=wrap)
    pipeline = replace(problem.pipeline, scales={"scene": Trace(table, "scale")})
    return replace(problem, pipeline=pipeline)


@pytest.mark.parametrize(("rows", "windows"), [(1000, 40), (400, 40), (399, 39), (35, 3)])
def test_a_short_trace_shortens_the_run(rows: int, windows: int) -> None:
    assert longest_run(with_trace(rows), 40) == windows


def test_a_trace_that_wraps_does_not() -> None:
    assert longest_run(with_trace(35, wrap=True), 40) == 40


def test_a_trace_shorter_than_the_warm_up_is_an_error() -> None:
    with pytest.raises(TraceError, match="needs 30 cycles"):
        longest_run(with_trace(29), 40)
