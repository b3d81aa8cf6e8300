"""How long jobs and messages took: known, unknown, lost, in flight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dwell.estimators.spans import Spans, patience_ns, spans_of
from dwell.model import Constant, Execution, Flow, Link, Node, Problem, Task
from tests.cells.generated import make_problem
from tests.estimators.windows import MS, Row, instants

LIMIT_MS = 50.0


def cell(window_cycles: int = 10, period_ms: float = 20.0) -> Problem:
    """Two tasks on two nodes."""
    one = Execution(Constant(1.0))
    return make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("A", {"R": one}), Task("B", {"E": one})],
        [Flow("A", "B")],
        links=[Link("R", "E", Constant(1.0))],
        period_ms=period_ms,
        window_cycles=window_cycles,
    )


def measure(row: Row) -> Spans:
    """Spans of one cycle of the cell."""
    found = instants([row])
    return spans_of(found, found.end_ns[:, [0]], round(LIMIT_MS * MS))


def test_what_has_ended_took_from_begin_to_end() -> None:
    spans = measure(([0.0, 7.25], [5.0, 9.5], [7.25]))
    assert spans.job_ms.tolist() == [[5.0, 2.25]]
    assert spans.message_ms.tolist() == [[2.25]]


def test_on_one_node_a_message_takes_nothing() -> None:
    assert measure(([0.0, 5.0], [5.0, 9.0], [5.0])).message_ms.tolist() == [[0.0]]


@pytest.mark.parametrize(
    ("begun_ms", "span_ms"), [(49.999999, math.inf), (50.0, math.nan), (60.0, math.nan)]
)
def test_what_has_not_ended_is_lost_only_after_a_while(begun_ms: float, span_ms: float) -> None:
    job = measure(([begun_ms, None], [None, None], [None])).job_ms
    np.testing.assert_array_equal(job, [[span_ms, math.nan]])
    message = measure(([0.0, None], [begun_ms, None], [None])).message_ms
    np.testing.assert_array_equal(message, [[span_ms]])


def test_what_has_not_begun_is_unknown() -> None:
    spans = measure(([None, None], [None, None], [None]))
    assert np.isnan(spans.job_ms).all()
    assert np.isnan(spans.message_ms).all()


@pytest.mark.parametrize(("cycles", "periods"), [(1, 0), (2, 1), (3, 2), (100, 2)])
def test_the_patience_is_never_longer_than_the_window(cycles: int, periods: int) -> None:
    assert patience_ns(cell(cycles, 33.3)) == round(periods * 33.3 * MS)
