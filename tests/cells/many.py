"""A cell of many candidates: three tasks, each on the robot or on one of four edge nodes."""

from __future__ import annotations

import itertools
from typing import Any

from dwell.cellfile import from_document
from dwell.model import Problem

NODES = ("R", "E1", "E2", "E3", "E4")
MOVABLE = ("see", "plan", "act")


def document_of(candidates: int, **controller: Any) -> dict[str, Any]:
    """Return the document of a cell with so many candidates, at most 125.

    Its windows have a cycle for each candidate.
    """
    placed = itertools.islice(itertools.product(NODES, repeat=len(MOVABLE)), candidates)
    on = {node: {"exec_ms": 6.0 if node == "R" else 4.0} for node in NODES}
    anchored = {"on": {"R": {"exec_ms": 1.0}}}
    tasks = ("sense", *MOVABLE, "drive")
    return {
        "dwell": 1,
        "name": "many",
        "period_ms": 40.0,
        "window_cycles": candidates,
        "nodes": {node: {"tier": "robot" if node == "R" else "edge"} for node in NODES},
        "links": [
            {"from": one, "to": other, "both_ways": True, "delay_ms": 0.5}
            for one, other in itertools.combinations(NODES, 2)
        ],
        "tasks": {name: {"on": on} if name in MOVABLE else anchored for name in tasks},
        "flows": [{"from": one, "to": other} for one, other in itertools.pairwise(tasks)],
        "candidates": {"-".join(nodes): dict(zip(MOVABLE, nodes, strict=True)) for nodes in placed},
        "controller": {
            "estimator": "corrected",
            "decide_cycles": candidates,
            "min_dwell": 3,
            **controller,
        },
    }


def many(candidates: int, **controller: Any) -> Problem:
    """Return the cell with so many candidates."""
    return from_document(document_of(candidates, **controller))
