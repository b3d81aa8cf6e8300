"""Fleets whose latencies can be worked out by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from dwell.model import (
    Constant,
    Execution,
    Fabric,
    Flow,
    Link,
    Node,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Targets,
    Task,
    Weights,
)
from dwell.model.fabric import Scheduler
from dwell.model.fleet import Fleet, FleetEntry, Phases

#: Sensing before a job on the edge, and acting after it, on the robot.
BESIDE_MS = 0.001


def one_job(
    work_ms: float = 2.0,
    *,
    name: str = "one",
    period_ms: float = 10.0,
    deadline_ms: float = 10.0,
    cores: int = 1,
    scheduler: Scheduler = "fifo",
    priority: int = 0,
) -> Problem:
    """Return a cell that senses and acts on its robot, with a job on the edge in between."""
    tasks = {
        "sense": Task("sense", {"R": Execution(Constant(BESIDE_MS))}),
        "work": Task(
            "work",
            {"R": Execution(Constant(3 * work_ms)), "E": Execution(Constant(work_ms))},
            priority=priority,
        ),
        "act": Task("act", {"R": Execution(Constant(BESIDE_MS))}),
    }
    ends = (("R", "E"), ("E", "R"))
    return Problem(
        name=name,
        pipeline=Pipeline(
            tasks, (Flow("sense", "work", 100), Flow("work", "act", 100)), period_ms, deadline_ms
        ),
        fabric=Fabric(
            {"R": Node("R", "robot", 1), "E": Node("E", "edge", cores, scheduler)},
            {f"{a}->{b}": Link(a, b, Constant(0.0)) for a, b in ends},
        ),
        candidates={
            "LOC": Placement({"sense": "R", "work": "R", "act": "R"}),
            "OFF": Placement({"sense": "R", "work": "E", "act": "R"}),
        },
        objective=Objective(Weights(), Targets(deadline_ms)),
        window_cycles=20,
    )


def fleet_of(
    *cells: tuple[Problem, int], phases: Phases = "sync", shared: Sequence[str] = ("E",)
) -> Fleet:
    """Return so many of each cell, which share the edge and are not coordinated."""
    entries = tuple(FleetEntry(cell, count) for cell, count in cells)
    return Fleet("hand", entries, tuple(shared), phases=phases, coordination="none")


def within(problem: Problem, deadline_ms: float) -> Problem:
    """Return a cell with another deadline."""
    return replace(problem, pipeline=replace(problem.pipeline, deadline_ms=deadline_ms))
