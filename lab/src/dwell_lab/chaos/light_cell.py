"""The default cell of a chaos campaign: three nodes, light enough for two cores."""

from __future__ import annotations

from typing import Any

from dwell_lab.chaos.stages import FRAME_BYTES, NODES

PERIOD_MS = 40
GUARD_CYCLES = 3
MAX_AGE_MS = 120
MIN_DWELL = 2
WINDOW_CYCLES = 3
#: Execution times by home (the candidate that the controller prefers), task and node. The stages
#: are light enough for one CPU, and for a quota of half a CPU; the delays of the links, which
#: need no CPU, separate the placements.
EXEC_MS = {
    "SO": {"perception": {"R1": 4.0, "E": 2.0}, "planning": {"R2": 8.0, "E": 2.0}},
    "LOC": {"perception": {"R1": 2.0, "E": 6.0}, "planning": {"R2": 2.0, "E": 5.0}},
}
DELAY_MS = {
    "SO": {"R1-E": 1, "E-R2": 1, "R1-R2": 8},
    "LOC": {"R1-E": 10, "E-R2": 10, "R1-R2": 1},
}
#: Factor on the execution times in the cell file on nodes away from home: the controller returns
#: home and stays there, even if the machine disturbs the latencies of three cycles.
WARY = 3
#: Period in a campaign: long enough for nodes with 0.4 of a CPU, and for a shared machine.
PATIENT_MS = 80
CANDIDATES = {
    "LOC": {"perception": "R1", "planning": "R2"},
    "SO": {"perception": "E", "planning": "E"},
    "HYB": {"perception": "E", "planning": "R2"},
}


def exec_ms(home: str) -> dict[str, dict[str, float]]:
    """Return the execution time of each task on each node, in ms."""
    return {"sensing": {"R1": 1.0}, **EXEC_MS[home], "control": {"R2": 0.5}}


def _node(node: str, *, quotas: bool) -> dict[str, Any]:
    tier = "edge" if node == "E" else "robot"
    if not quotas:
        return {"tier": tier, "cores": 2}
    cpu = 0.8 if tier == "edge" else 0.4
    return {"tier": tier, "cores": 1, "quota": {"cpu": cpu, "period_ms": 4}}


def document(
    home: str, *, period_ms: int = PERIOD_MS, standby: bool = True, quotas: bool = False
) -> dict[str, Any]:
    """Return the cell file of a cell whose controller prefers the candidate `home`.

    Parameters
    ----------
    standby : bool
        Whether tasks with a single node (sensing and control) have a standby.
    quotas : bool
        Whether nodes have a share of a CPU; the nodes of a network testbed need one.
    """
    # With `close_grace_ms` a window with lost cycles ends only after the guard's check. If the
    # guard moves the cell, an order from that window, perhaps to a dead process, has an old term.
    tasks: dict[str, Any] = {}
    for task, nodes in exec_ms(home).items():
        spare = {"standby": 1} if standby and len(nodes) == 1 else {}
        at_home = CANDIDATES[home].get(task)
        on = {
            node: {"exec_ms": ms * (1 if at_home in (None, node) else WARY), **spare}
            for node, ms in nodes.items()
        }
        tasks[task] = {"run": f"dwell_lab.chaos.stages:{task.capitalize()}", "on": on}
    links = [
        {"from": a, "to": b, "both_ways": True, "delay_ms": ms, "rate_mbps": 1000}
        for pair, ms in DELAY_MS[home].items()
        for a, b in [pair.split("-")]
    ]
    return {
        "dwell": 1,
        "name": f"chaos-{home}",
        "period_ms": period_ms,
        "deadline_ms": period_ms,
        "window_cycles": WINDOW_CYCLES,
        "warmup_windows": 0,
        "nodes": {node: _node(node, quotas=quotas) for node in NODES},
        "links": links,
        "tasks": tasks,
        "flows": [
            {"from": "sensing", "to": "perception", "bytes": FRAME_BYTES},
            {"from": "perception", "to": "planning", "bytes": 18},
            {"from": "planning", "to": "control", "bytes": 18},
        ],
        "candidates": CANDIDATES,
        "objective": {
            "weights": {
                "latency": 1.0, "violations": 0.5, "robot": 0.0, "edge": 0.0, "switching": 0.05,
            },
            "targets": {"latency_ms": PERIOD_MS / 2, "robot": 0.9, "edge": 0.9},
            "caps": {"latency_ms": 3 * period_ms},
        },
        "controller": {
            "on": "E", "policy": "dtp", "initial": home, "min_dwell": MIN_DWELL,
            "min_improvement": 0.35, "estimator": "profile", "guard_cycles": GUARD_CYCLES,
            "fallbacks": ["LOC", "HYB", "SO"], "close_grace_ms": GUARD_CYCLES * period_ms,
        },
        "live": {
            "max_age_ms": period_ms * MAX_AGE_MS // PERIOD_MS, "silence": "hold",
            "actuators": {"control": "dwell_lab.chaos.stages:Witness"},
        },
    }  # fmt: skip
