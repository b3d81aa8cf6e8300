"""A cell whose stages take next to nothing, so that what is left is the testbed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import yaml

from tests.cells import light_stages

QUOTAS = {"R1": 0.4, "E": 0.8, "R2": 0.4}
TASKS = {
    "sensing": ["R1"],
    "perception": ["R1", "E"],
    "planning": ["R2", "E"],
    "control": ["R2"],
}
FLOWS = (("sensing", "perception"), ("perception", "planning"), ("planning", "control"))


def document(**more: Any) -> dict[str, Any]:
    """Return a cell of three nodes; nothing moves by itself."""
    found: dict[str, Any] = {
        "dwell": 1,
        "name": "light",
        "period_ms": 50,
        "deadline_ms": 50,
        "window_cycles": 20,
        "warmup_windows": 1,
        "nodes": {
            node: {
                "tier": "edge" if node == "E" else "robot",
                "cores": 1,
                "quota": {"cpu": cpu, "period_ms": 4},
            }
            for node, cpu in QUOTAS.items()
        },
        "links": [
            {"from": a, "to": b, "both_ways": True, "delay_ms": 1, "rate_mbps": 1000}
            for a, b in (("R1", "E"), ("E", "R2"), ("R1", "R2"))
        ],
        "tasks": {
            task: {
                "run": "light_stages:Passing",
                "on": {node: {"exec_ms": 0.1} for node in nodes},
            }
            for task, nodes in TASKS.items()
        },
        "flows": [{"from": a, "to": b, "bytes": 8} for a, b in FLOWS],
        "candidates": {
            "LOC": {"perception": "R1", "planning": "R2"},
            "SO": {"perception": "E", "planning": "E"},
        },
        "scenarios": {
            "impaired": [
                {"link": "R1->E", "both_ways": True, "at_s": 1, "for_s": 2, "add_delay_ms": 5}
                | {"loss": 0.02},
                {"node": "E", "at_s": 1, "for_s": 2, "stress_threads": 1},
            ]
        },
        "objective": {
            "weights": {
                "latency": 1.0,
                "violations": 1.0,
                "robot": 0.0,
                "edge": 0.0,
                "switching": 0.0,
            },
            "targets": {"latency_ms": 50, "robot": 0.9, "edge": 0.9},
            "caps": {"latency_ms": 150},
        },
        "controller": {
            "on": "E",
            "policy": "SO",
            "initial": "SO",
            "estimator": "profile",
            "close_grace_ms": 50,
        },
        "live": {"max_age_ms": 1_000, "actuators": {"control": "light_stages:Actuator"}},
    }
    return {**found, **more}


def write_cell(folder: Path, **more: Any) -> Path:
    """Write the cell with its stages beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(Path(light_stages.__file__), folder / "light_stages.py")
    path = folder / "light.yaml"
    path.write_text(yaml.safe_dump(document(**more), sort_keys=False))
    return path
