"""The cell of the paper, with shorthand for its windows."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

from dwell.model import (
    Caps,
    Constant,
    ControllerSettings,
    Execution,
    Fabric,
    Flow,
    Link,
    Node,
    Objective,
    Pipeline,
    Placement,
    Problem,
    QoS,
    Targets,
    Task,
    Weights,
)
from tests.cells.once import once

NODES = {
    "R1": Node("R1", "robot", 4),
    "E": Node("E", "edge", 8),
    "R2": Node("R2", "robot", 4),
}


def place(perception: str, planning: str) -> Placement:
    """Place the relocatable tasks."""
    return Placement(
        {"sensing": "R1", "perception": perception, "planning": planning, "control": "R2"}
    )


CANDIDATES = {"LOC": place("R1", "R2"), "SO": place("E", "E"), "HYB": place("E", "R2")}

OBJECTIVE = Objective(
    weights=Weights(latency=1, violations=3, robot=0.5, edge=0.3, switching=0.5),
    targets=Targets(latency_ms=40, robot=0.7, edge=0.7),
    caps=Caps(latency_ms=120, utilisation=0.98),
    tiers={name: node.tier for name, node in NODES.items()},
)


def qos(
    l95_ms: float = 20.0,
    violation_rate: float = 0.0,
    robot: float = 0.0,
    edge: float = 0.0,
) -> QoS:
    """Metrics of a window in which both robots are equally busy."""
    return QoS(l95_ms, violation_rate, {"R1": robot, "E": edge, "R2": robot})


def estimates(loc: QoS, so: QoS, hyb: QoS) -> dict[str, QoS]:
    """Metrics by candidate."""
    return {"LOC": loc, "SO": so, "HYB": hyb}


def problem(
    candidates: Mapping[str, Placement] | None = None,
    *,
    controller: ControllerSettings | None = None,
    perception_ms: float = 18.0,
    planning_ms: float = 9.0,
) -> Problem:
    """Return the cell, with these candidates and settings."""
    ran = Constant(1.0)
    tasks = {
        "sensing": {"R1": 3.0},
        "perception": {"R1": perception_ms, "E": 6.0},
        "planning": {"R2": planning_ms, "E": 3.0},
        "control": {"R2": 2.0},
    }
    chain = list(tasks)
    pairs = [(a, b) for a in NODES for b in NODES if a != b]
    return Problem(
        name="visual-servoing-cell",
        pipeline=Pipeline(
            tasks={
                name: Task(name, {node: Execution(Constant(ms)) for node, ms in on.items()})
                for name, on in tasks.items()
            },
            flows=tuple(Flow(a, b, 1000) for a, b in itertools.pairwise(chain)),
            period_ms=40.0,
            deadline_ms=40.0,
        ),
        fabric=Fabric(nodes=NODES, links={f"{a}->{b}": Link(a, b, ran) for a, b in pairs}),
        candidates=candidates or CANDIDATES,
        objective=OBJECTIVE,
        controller=once(controller or ControllerSettings(), 50),
    )
