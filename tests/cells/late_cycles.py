"""A run that ends while its cell migrates: its last cycles are late, and in no window."""

from __future__ import annotations

import dwell
from dwell.model import Constant, ControllerSettings, Execution, Node, Problem, Task
from tests.cells.generated import make_problem
from tests.cells.two_nodes import Script

#: Windows of the run, and windows that were drawn.
CLOSED, DRAWN, W = 2, 8, 10


def late_problem() -> Problem:
    """Return a cell that is late on R and in time on E, and takes for ever to migrate."""
    on = {"R": Execution(Constant(30.0), workers=2), "E": Execution(Constant(5.0))}
    return make_problem(
        [Node("R", "robot", 4), Node("E", "edge", 4)],
        [Task("work", on, start_ms=1e6)],
        candidates={"LOC": {"work": "R"}, "OFF": {"work": "E"}},
        period_ms=20.0,
        window_cycles=W,
        controller=ControllerSettings(migration="cold"),
    )


def late_run() -> dwell.Run:
    """Return a run of it that is ordered to E after its second window."""
    policy = Script("LOC", "OFF")
    return dwell.simulate(late_problem(), policy=policy, seed=1, windows=DRAWN, jobs=True)


def without_late_cycles(run: dwell.Run) -> dwell.Run:
    """Return the same run with the cycles of its windows alone."""
    end = CLOSED * W
    tables = {
        "cycles": run.cycles[:end],
        "windows": run.windows,
        "decisions": run.decisions,
        "jobs": run.jobs.filter(run.jobs["cycle"] < end),
    }
    return dwell.Run(run.meta, tables)
