"""A chain in which nothing is random: what a candidate takes is known exactly."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import dwell
from dwell.model import (
    Constant,
    ControllerSettings,
    Disturbance,
    Execution,
    Flow,
    Link,
    LinkDisturbance,
    Node,
    NodeDisturbance,
    Problem,
    Task,
)
from dwell.model.fabric import Scheduler
from tests.cells.generated import make_problem

TASKS = {
    "sense": {"R": 2.0},
    "act": {"R": 8.0, "E": 3.0},
    "plan": {"R": 6.0, "E": 2.0},
    "control": {"R": 1.0, "E": 0.5},
}
#: SINK differs from LOC by its sink alone; TWIN is LOC by another name.
MOVES: dict[str, dict[str, str]] = {
    "LOC": {},
    "OFF": {"act": "E"},
    "FAR": {"act": "E", "plan": "E"},
    "SINK": {"control": "E"},
    "TWIN": {},
}
# 4 threads on 16 cores beside 20: 1.5 times as long.
DISTURBED = (
    LinkDisturbance("R", "E", add_delay_ms=Constant(7.0)),
    NodeDisturbance("E", stress_threads=20),
)


def cell(
    *,
    estimator: str = "shadow",
    candidates: Sequence[str] = tuple(MOVES),
    scenario: Sequence[Disturbance] = DISTURBED,
    window_cycles: int = 50,
    shadow_fraction: float = 0.1,
    half_life_windows: float = 2.0,
    deadline_ms: float = 22.0,
    scheduler: Scheduler = "fair",
    threads: Mapping[str, int] | None = None,
) -> Problem:
    """A chain on nodes of 16 cores, in which nothing waits; tasks have 4 threads if not told."""
    return make_problem(
        [Node("R", "robot", 16, scheduler), Node("E", "edge", 16, scheduler)],
        [
            Task(
                name,
                {
                    node: Execution(Constant(ms), (threads or {}).get(name, 4), workers=9)
                    for node, ms in on.items()
                },
            )
            for name, on in TASKS.items()
        ],
        [Flow(a, b) for a, b in itertools.pairwise(TASKS)],
        links=[Link("R", "E", Constant(1.0)), Link("E", "R", Constant(1.0))],
        candidates={name: MOVES[name] for name in candidates},
        scenario=scenario,
        period_ms=40.0,
        deadline_ms=deadline_ms,
        window_cycles=window_cycles,
        controller=ControllerSettings(
            estimator=estimator,
            shadow_fraction=shadow_fraction,
            half_life_windows=half_life_windows,
        ),
    )


def truth(problem: Problem, name: str) -> tuple[float, float]:
    """L95 and V_D that a candidate shows in each of its windows, without any shadows."""
    shown = dwell.simulate(
        problem, scenario="disturbed", policy=name, estimator="profile", seed=1, windows=3
    ).windows
    (l95_ms,), (missed,) = set(shown["seen_l95_ms"]), set(shown["seen_violation_rate"])
    return l95_ms, missed
