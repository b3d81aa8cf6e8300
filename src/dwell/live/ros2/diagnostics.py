"""A cell's status as ROS diagnostics: one entry for the cell, each node and each stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from dwell.model import Problem

TOPIC, TYPE = "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = range(4)
#: Level of a cell by its health.
LEVELS = {"ok": OK, "degraded": WARN, "stalled": ERROR, "silent": ERROR, "absent": STALE}
#: Keys of a window that the entry of the cell shows.
WINDOW = ("l95_ms", "violation_rate", "cost")


def diagnostics(problem: Problem, status: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
    """Return the fields of a `DiagnosticArray`; `status` is the answer of an operator's client."""
    seconds, rest_ns = divmod(now_ns, 1_000_000_000)
    entries = [_cell(problem, status)]
    if LEVELS[status["health"]] != STALE:
        entries += [*_nodes(problem, status), *_stages(problem, status)]
    return {"header": {"stamp": {"sec": seconds, "nanosec": rest_ns}}, "status": entries}


def _entry(
    name: str, level: int, message: str, node: str, values: Mapping[str, object]
) -> dict[str, Any]:
    pairs = [
        {"key": key, "value": f"{one:.6g}" if isinstance(one, float) else str(one)}
        for key, one in values.items()
        if one is not None
    ]
    return {"name": name, "level": level, "message": message, "hardware_id": node, "values": pairs}


def _cell(problem: Problem, status: Mapping[str, Any]) -> dict[str, Any]:
    window = status.get("window") or {}
    values = {key: status.get(key) for key in ("placement", "fallback", "migrations", "pinned")}
    values |= {key: window.get(key) for key in WINDOW}
    health = status["health"]
    message = status["headline"] or health
    return _entry(f"dwell: {problem.name}", LEVELS[health], message, "", values)


def _nodes(problem: Problem, status: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for node in problem.fabric.nodes:
        of_node = {
            who: one
            for who, one in status["processes"].items()
            if who.partition("@")[2].partition(".")[0] == node
        }
        faulty = [who for who, one in of_node.items() if not one["ready"]]
        heard = any(one["heard"] for one in of_node.values())
        level = (WARN if faulty else OK) if heard else ERROR
        message = f"not ready: {', '.join(faulty)}" if faulty else "ready"
        values = {who: "ready" if one["ready"] else one["note"] for who, one in of_node.items()}
        drained = {"drained": node in status["drained"]}
        name = f"dwell: {problem.name}: node {node}"
        yield _entry(name, level, message if heard else "silent", node, {**values, **drained})


def _stages(problem: Problem, status: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    placement = problem.candidates.get(status["placement"] or "")
    for task, node in placement.sites if placement is not None else ():
        who = f"{task}@{node}"
        process = status["processes"].get(who) or {"ready": False, "note": "never heard"}
        counts = status["stages"].get(who) or {}
        topic = status["topics"].get(who) or {}
        message = process["note"] or "ready"
        level = OK if process["ready"] else ERROR
        name = f"dwell: {problem.name}: stage {task}"
        yield _entry(name, level, message, node, {**counts, **topic})
