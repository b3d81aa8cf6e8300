"""When a window closes: after its last deadline, a grace after the release beyond it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dwell.model import Constant, Execution, Node, Task
from dwell.model.window_close import window_close_ns
from dwell.sim import draw
from tests.cells.generated import make_problem

PROBLEM = make_problem([Node("R", "robot")], [Task("a", {"R": Execution(Constant(1.0))})])


@given(
    st.floats(1.0, 100.0),
    st.floats(0.1, 64.0),
    st.floats(0.0, 50.0),
    st.lists(st.integers(0, 10**8), min_size=2, max_size=20),
)
def test_no_deadline_is_open_at_a_close_and_closes_never_decrease(
    period_ms: float, share: float, grace_ms: float, gaps_ns: list[int]
) -> None:
    pipeline = replace(PROBLEM.pipeline, period_ms=period_ms, deadline_ms=period_ms * share)
    controller = replace(PROBLEM.controller, close_grace_ms=grace_ms)
    problem = replace(PROBLEM, pipeline=pipeline, controller=controller)
    release_ns = np.cumsum(gaps_ns)
    close_ns = window_close_ns(problem, release_ns[:-1], release_ns[1:])
    # A deadline between two nanoseconds has passed after the first of them.
    due_ns = pipeline.deadline_ms * 1e6 * (1 - 1e-12)
    assert (close_ns - release_ns[:-1] > due_ns - 1).all()
    assert (close_ns - release_ns[1:] >= round(grace_ms * 1e6)).all()
    assert (np.diff(close_ns) >= 0).all()


@given(st.floats(1.0, 100.0), st.floats(0.0, 50.0))
def test_without_jitter_a_window_closes_a_grace_after_the_release_beyond_it(
    period_ms: float, grace_ms: float
) -> None:
    pipeline = replace(PROBLEM.pipeline, period_ms=period_ms, deadline_ms=period_ms)
    controller = replace(PROBLEM.controller, close_grace_ms=grace_ms)
    problem = replace(PROBLEM, pipeline=pipeline, controller=controller)
    release_ns = draw(problem, scenario="baseline", seed=1, windows=200).release_ns
    close_ns = window_close_ns(problem, release_ns[:-1], release_ns[1:])
    np.testing.assert_array_equal(close_ns, release_ns[1:] + round(grace_ms * 1e6))
