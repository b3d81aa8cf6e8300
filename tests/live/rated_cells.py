"""Cells with several rates for live tests."""

from __future__ import annotations

from typing import Any

from dwell.cellfile.cell import from_document
from dwell.model import Problem
from tests.live.small_world import World

#: Cycles from one run of the lidar to its next.
SLOW = 5
P_MS = 10


def _on(*nodes: str, exec_ms: float = 1.0) -> dict[str, Any]:
    return {node: {"exec_ms": exec_ms} for node in nodes}


def document(
    *, idle: bool = False, lidar: str = "R", state_bytes: int = 0, **changes: Any
) -> dict[str, Any]:
    """A lidar and a faster IMU that are fused for an arm; wheels that wait for the IMU alone.

    Without the wheels (`idle`) no sink is due in four of five cycles.
    """
    tasks = {
        "imu": {"on": _on("R")},
        "lidar": {"every": SLOW, "on": _on(lidar)},
        "fuse": {"every": SLOW, "on": _on("R", "E"), "state_bytes": state_bytes},
        "arm": {"on": _on("R")},
    }
    flows = [
        {"from": "imu", "to": "fuse"},
        {"from": "lidar", "to": "fuse"},
        {"from": "fuse", "to": "arm"},
    ]
    if not idle:
        tasks["wheels"] = {"on": _on("R")}
        flows.append({"from": "imu", "to": "wheels"})
    return {
        "dwell": 1,
        "period_ms": P_MS,
        "window_cycles": 20,
        "warmup_windows": 0,
        "nodes": {"R": {"tier": "robot", "cores": 4}, "E": {"tier": "edge", "cores": 4}},
        "links": [{"from": "R", "to": "E", "both_ways": True, "delay_ms": 0.2}],
        "tasks": tasks,
        "flows": flows,
        "candidates": {"LOC": {"fuse": "R"}, "EDGE": {"fuse": "E"}},
        "controller": {"on": "E", "initial": "EDGE"},
    } | changes


def rated(**changes: Any) -> Problem:
    """Return the cell of `document`."""
    return from_document(document(**changes))


def world_of(problem: Problem, **more: Any) -> World:
    """Return a cell in memory whose jobs take 1 ms."""
    return World(problem, exec_ms=dict.fromkeys(problem.pipeline.tasks, 1.0), **more)


def sampling(*, waited: bool = True, linked_back: bool = True, **changes: Any) -> Problem:
    """Return a cell in which a controller samples what a slower detector finds.

    Both can run on two nodes. Without `waited` the controller has no other input; without
    `linked_back` no link leads from the edge to the robot, and the controller is the sink.
    """
    tasks = {
        "camera": {"every": SLOW, "on": _on("R")},
        "imu": {"on": _on("R")},
        "detect": {"on": _on("R", "E")},
        "control": {"on": _on("R", "E")},
    }
    flows: list[dict[str, Any]] = [
        {"from": "camera", "to": "detect"},
        {"from": "detect", "to": "control", "bytes": 100, "sampled": True},
    ]
    if waited:
        flows.append({"from": "imu", "to": "control"})
    else:
        del tasks["imu"]
    if linked_back:
        tasks["act"] = {"on": _on("R")}
        flows.append({"from": "control", "to": "act"})
    given = {
        "tasks": tasks,
        "flows": flows,
        "links": [{"from": "R", "to": "E", "both_ways": linked_back, "delay_ms": 0.2}],
        "candidates": {
            "LOC": {"detect": "R", "control": "R"},
            "AWAY": {"detect": "R", "control": "E"},
            **({"SPLIT": {"detect": "E", "control": "R"}} if linked_back else {}),
        },
        "controller": {"on": "E", "initial": "LOC"},
    }
    return from_document(document(**(given | changes)))
