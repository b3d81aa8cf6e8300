"""Durations: known, unknown, lost, in flight; and the patience after which something is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dwell.estimators.spans import patience_ns, spans_ms
from dwell.model import Constant, Execution, Node, Problem, Task
from tests.cells.generated import make_problem
from tests.estimators.windows import MS

LIMIT_MS = 50.0


def cell(window_cycles: int, period_ms: float) -> Problem:
    return make_problem(
        [Node("R", "robot")],
        [Task("A", {"R": Execution(Constant(1.0))})],
        period_ms=period_ms,
        window_cycles=window_cycles,
    )


@pytest.mark.parametrize(
    ("begun_ms", "ended_ms", "span_ms"),
    [
        (0.0, 5.0, 5.0),
        (7.25, 9.5, 2.25),
        # On one node a message is handed over at once.
        (5.0, 5.0, 0.0),
        (60.0, 61.0, 1.0),
        # What has not ended is lost only after a while.
        (49.999999, None, math.inf),
        (50.0, None, math.nan),
        (60.0, None, math.nan),
        (None, None, math.nan),
    ],
)
def test_a_duration_is_known_or_lost_or_unknown(
    begun_ms: float | None, ended_ms: float | None, span_ms: float
) -> None:
    begun, ended = (
        np.array([[-1 if ms is None else round(ms * MS)]]) for ms in (begun_ms, ended_ms)
    )
    np.testing.assert_array_equal(spans_ms(begun, ended, round(LIMIT_MS * MS)), [[span_ms]])


def test_columns_may_have_limits_of_their_own() -> None:
    begun, ended = np.array([[0, 0]]) * MS, np.array([[-1, -1]])
    limits = np.array([-10, 10]) * MS
    np.testing.assert_array_equal(spans_ms(begun, ended, limits), [[math.nan, math.inf]])


def test_every_column_is_for_itself() -> None:
    begun = np.array([[0, -1, 10], [0, 60, 70]]) * MS
    ended = np.array([[3, -1, -1], [4, 61, -1]]) * MS
    begun[begun < 0] = ended[ended < 0] = -1
    found = spans_ms(begun, ended, round(LIMIT_MS * MS))
    np.testing.assert_array_equal(found, [[3.0, math.nan, math.inf], [4.0, 1.0, math.nan]])


@pytest.mark.parametrize(("cycles", "periods"), [(1, 0), (2, 1), (3, 2), (100, 2)])
def test_the_patience_is_never_longer_than_the_window(cycles: int, periods: int) -> None:
    assert patience_ns(cell(cycles, 33.3)) == round(periods * 33.3 * MS)


@pytest.mark.parametrize(("cycles", "periods"), [(100, 20), (21, 20), (20, 19), (12, 11)])
def test_the_patience_follows_the_rate(cycles: int, periods: int) -> None:
    assert patience_ns(cell(cycles, 10.0), 10) == periods * 10 * MS


@pytest.mark.parametrize(("cycles", "periods"), [(1, 3), (2, 4), (3, 5), (100, 5)])
def test_beyond_the_period_the_patience_grows_with_the_deadline(cycles: int, periods: int) -> None:
    problem = cell(cycles, 10.0)
    problem = replace(problem, pipeline=replace(problem.pipeline, deadline_ms=40.0))
    assert patience_ns(problem) == periods * 10 * MS
