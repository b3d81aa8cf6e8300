"""Links: what has the link before a message is waited for."""

from __future__ import annotations

import dwell
from dwell.model import (
    Constant,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    Task,
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
