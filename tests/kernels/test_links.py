"""Links: what has the link before a message is waited for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray

import dwell
from dwell.model import (
    Constant,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    Problem,
    Process,
    Task,
    Uniform,
)
from tests.cells.deterministic import cell
from tests.cells.generated import MS, make_problem


def test_a_flow_waits_for_its_link() -> None:
    # 5 ms on R, 1 ms and 8 * 12500 / 100e3 = 1 ms to E, 5 ms there.
    execution = Execution(Constant(5.0))
    problem = make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("a", {"R": execution}), Task("b", {"E": execution})],
        [Flow("a", "b", 12_500)],
        links=[Link("R", "E", Constant(1.0), rate_mbps=100.0)],
        window_cycles=5,
    )
    row = dwell.simulate(problem, policy="LOC", seed=1, windows=2).cycles.row(0, named=True)
    assert (row["latency_ns"], row["compute_ns"], row["queue_ns"], row["network_ns"]) == (
        12 * MS,
        10 * MS,
        0,
        2 * MS,
    )


def test_each_message_is_lost_by_itself() -> None:
    problem = cell(estimator="profile", scenario=[LinkDisturbance("R", "E", loss=0.5)])
    run = dwell.simulate(problem, scenario="disturbed", policy="OFF", seed=1, windows=4)
    assert 0.3 < (run.cycles["outcome"] == "dropped").mean() < 0.7  # type: ignore[operator]


def reliable(
    *,
    in_order: bool,
    period_ms: float,
    loss: float,
    retransmit_ms: float,
    delay_ms: Process | None = None,
    stretch_s: float = 0.0,
) -> Problem:
    """Return a cell whose link loses attempts, and loses all of them for a stretch of time."""
    nothing = Execution(Constant(0.0))
    link = Link("R", "E", delay_ms or Constant(5.0), loss=loss, retransmit_ms=retransmit_ms)
    return make_problem(
        [Node("R", "robot"), Node("E", "edge")],
        [Task("a", {"R": nothing}), Task("b", {"E": nothing})],
        [Flow("a", "b")],
        links=[replace(link, in_order=in_order)],
        period_ms=period_ms,
        window_cycles=100,
        scenario=[LinkDisturbance("R", "E", for_s=stretch_s, loss=1.0)] if stretch_s else (),
    )


def arrivals_ns(problem: Problem, windows: int) -> NDArray[np.int64]:
    """Arrival of the message of every cycle."""
    run = dwell.simulate(
        problem, scenario="disturbed", policy="LOC", seed=1, windows=windows, jobs=True
    )
    assert run.jobs is not None
    received = run.jobs.filter(pl.col("task") == "b").sort("cycle")
    assert received["cycle"].to_list()[: 100 * windows - 100] == list(range(100 * windows - 100))
    return received["ready_ns"].to_numpy()[: 100 * windows - 100]


@pytest.mark.parametrize(
    ("period_ms", "loss", "retransmit_ms", "missed"),
    [(100 / 3, 0.02, 200.0, 0.1086), (10.0, 0.02, 40.0, 0.0737), (20.0, 0.05, 100.0, 0.2302)],
)
def test_messages_behind_one_that_is_repeated_wait_for_it(
    period_ms: float, loss: float, retransmit_ms: float, missed: float
) -> None:
    kept, free = (
        arrivals_ns(
            reliable(in_order=order, period_ms=period_ms, loss=loss, retransmit_ms=retransmit_ms),
            windows=300,
        )
        for order in (True, False)
    )
    assert (np.diff(free) < 0).any()
    assert (kept == np.maximum.accumulate(free)).all()
    released_ns = np.round(np.arange(len(kept)) * period_ms * MS)
    assert (kept - released_ns > period_ms * MS).mean() == pytest.approx(missed, abs=0.0005)


def test_messages_wait_for_as_many_as_there_are_before_them() -> None:
    kept, free = (
        arrivals_ns(
            reliable(
                in_order=order,
                period_ms=1.0,
                loss=0.1,
                retransmit_ms=7.0,
                delay_ms=Uniform(1.0, 9.0),
                stretch_s=1.0,
            ),
            windows=20,
        )
        for order in (True, False)
    )
    # A thousand messages at a time are under way.
    assert (free[:900] > 1000 * MS).all()
    assert (kept == np.maximum.accumulate(free)).all()
