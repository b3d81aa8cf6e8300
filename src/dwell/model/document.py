"""A problem as a document: plain values that a cell file could hold, from which it can be read."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeAlias

from dwell.errors import Fault, ProblemError
from dwell.model.fabric import Bursts, Link, Node, Quota
from dwell.model.live import LiveSettings
from dwell.model.objective import Objective
from dwell.model.pipeline import Execution, Task
from dwell.model.placement import Placement
from dwell.model.problem import ControllerSettings, Problem
from dwell.model.process import DRAWN, Constant, Process, Trace, UnreadTrace
from dwell.model.scenario import Disturbance, Episodes, NodeDisturbance
from dwell.model.servo import Servo

# Version of the cell file.
VERSION = 1

Document: TypeAlias = dict[str, Any]

NAMES: dict[type, str] = {kind: name for name, kind in DRAWN.items()}


def to_document(problem: Problem) -> Document:
    """Return the document of a problem.

    `dwell.cellfile.from_document` makes an equal problem of it. A trace is named, not copied: its
    declaration carries a digest of the data, so that other data are not taken for it.

    Returns
    -------
    dict
        Dicts, lists, strings, finite numbers and truth values: ready for JSON or YAML.

    Raises
    ------
    ProblemError
        If it holds a process that a cell file has no word for.
    """
    pipeline, fabric = problem.pipeline, problem.fabric
    return _filled(
        {
            "dwell": VERSION,
            "name": problem.name,
            "period_ms": pipeline.period_ms,
            "deadline_ms": pipeline.deadline_ms,
            "release_jitter_ms": _process("release_jitter_ms", pipeline.release_jitter_ms),
            "window_cycles": problem.window_cycles,
            "warmup_windows": problem.warmup_windows,
            "nodes": {name: _node(node) for name, node in fabric.nodes.items()},
            "links": [_link(i, link) for i, link in enumerate(fabric.links.values())],
            "tasks": {name: _task(task) for name, task in pipeline.tasks.items()},
            "flows": [
                {"from": flow.source, "to": flow.target, "bytes": flow.payload_bytes}
                for flow in pipeline.flows
            ],
            "scales": {
                name: _process(f"scales.{name}", scale) for name, scale in pipeline.scales.items()
            },
            "candidates": {
                name: relocated(placement, pipeline.tasks)
                for name, placement in problem.candidates.items()
            },
            "scenarios": {
                name: [_disturbance(f"scenarios.{name}[{i}]", item) for i, item in enumerate(items)]
                for name, items in problem.scenarios.items()
            },
            "objective": _objective(problem),
            "controller": _controller(problem.controller),
            "servo": _servo(problem.servo),
            "live": _live(problem.live),
        }
    )


def digest(trace: Trace) -> str:
    """Return the SHA-256 of what a trace replays: values, groups and instants, in hexadecimal.

    Returns
    -------
    str
        The same for the same numbers on any machine, whatever the file's format.
    """
    import numpy as np

    table = trace.table
    state = hashlib.sha256(np.ascontiguousarray(trace.values, "<f8").tobytes())
    state.update(np.ascontiguousarray(table.starts, "<i8").tobytes())
    if table.time_ms is not None:
        state.update(np.ascontiguousarray(table.time_ms, "<f8").tobytes())
    return state.hexdigest()


def _filled(values: Document) -> Document:
    """Leave out what a cell file would: what is not there, and infinite limits."""
    return {key: value for key, value in values.items() if value not in (None, math.inf)}


def _process(path: str, process: Process) -> float | Document:
    if isinstance(process, Constant):
        return process.value
    if isinstance(process, Trace):
        return {"trace": _trace(process)}
    if isinstance(process, UnreadTrace):
        return {"trace": dict(process.declaration)}
    name = NAMES.get(type(process))
    if name is None:
        known = ", ".join(("constant", *NAMES.values(), "trace"))
        message = f"a cell file has no word for {type(process).__name__}; it knows {known}"
        raise ProblemError([Fault(path, message)])
    return {name: _dataclass(process)}


def _trace(trace: Trace) -> Document:
    table = trace.table
    group = list(table.group) if isinstance(table.group, tuple) else table.group
    return _filled(
        {
            "file": table.file,
            "column": trace.column,
            "by": table.by,
            "time": table.time,
            "group": group,
            "on_negative": table.on_negative,
            "wrap": table.wrap,
            "sha256": digest(trace),
        }
    )


def _bursts(path: str, bursts: Bursts | None, **more: object) -> Document | None:
    if bursts is None:
        return None
    every_ms = _process(f"{path}.every_ms", bursts.every_ms)
    return {"every_ms": every_ms, "for_ms": _process(f"{path}.for_ms", bursts.for_ms), **more}


def _quota(quota: Quota) -> Document:
    more = {"slack_ms": quota.slack_ms or None, "tick_ms": quota.tick_ms or None}
    return _filled({"cpu": quota.cpu, "period_ms": quota.period_ms, **more})


def relocated(placement: Placement, tasks: Mapping[str, Task]) -> dict[str, str]:
    """Return the part of a placement that a document has: anchored tasks are left out."""
    return {name: node for name, node in placement.items() if not tasks[name].anchored}


def _node(node: Node) -> Document:
    quota, bursts = node.quota, node.bursts
    return _filled(
        {
            "tier": node.tier,
            "cores": node.cores,
            "scheduler": node.scheduler,
            "accelerators": dict(node.accelerators),
            "quota": _quota(quota) if quota else None,
            "background": node.background or None,
            "background_beside": node.background_beside,
            "background_hz": node.background_hz or None,
            "interference": node.interference if node.interference > 1.0 else None,
            "contention": node.contention or None,
            "contention_stressed": dict(node.contention_stressed) or None,
            "bursts": _bursts(
                f"nodes.{node.name}.bursts", bursts, threads=bursts.threads if bursts else 0
            ),
        }
    )


def _link(index: int, link: Link) -> Document:
    path, bursts = f"links[{index}]", link.bursts
    extra = _process(f"{path}.bursts.add_delay_ms", bursts.add_delay_ms) if bursts else 0
    retransmit_ms = link.retransmit_ms
    return _filled(
        {
            "from": link.source,
            "to": link.target,
            "delay_ms": _process(f"{path}.delay_ms", link.delay_ms),
            "rate_mbps": link.rate_mbps,
            "loss": link.loss,
            "on_loss": "drop" if retransmit_ms is None else {"retransmit_ms": retransmit_ms},
            "in_order": link.in_order,
            "bursts": _bursts(f"{path}.bursts", bursts, add_delay_ms=extra),
        }
    )


def _task(task: Task) -> Document:
    words: dict[int, str | Document] = {0: "queue", 1: "latest"}
    return _filled(
        {
            "on": {node: _execution(task, node, execution) for node, execution in task.on.items()},
            "input": words.get(task.depth, {"queue": task.depth}),
            "priority": task.priority,
            "scale": task.scale,
            "offset_ms": task.offset_ms,
            "start_ms": task.start_ms,
            "state_bytes": task.state_bytes,
            "run": task.run,
        }
    )


def _execution(task: Task, node: str, execution: Execution) -> Document:
    return _filled(
        {
            "exec_ms": _process(f"tasks.{task.name}.on.{node}.exec_ms", execution.exec_ms),
            "threads": execution.threads,
            "workers": execution.workers,
            "accelerator": execution.accelerator,
            "standby": execution.standby or None,
            "before_ms": execution.before_ms or None,
            "after_ms": execution.after_ms or None,
        }
    )


def disturbance_document(item: Disturbance) -> Document:
    """Return an item of a scenario as a cell file has it, the ways of a link apart."""
    return _disturbance("", item)


def _disturbance(path: str, item: Disturbance) -> Document:
    interval = {
        "at_s": item.at_s,
        "for_s": item.for_s,
        "down": item.down,
        "episodes": _episodes(f"{path}.episodes", item.episodes),
        "ramp_s": item.ramp_s,
    }
    if isinstance(item, NodeDisturbance):
        return _filled({"node": item.node, "stress_threads": item.stress_threads, **interval})
    extra = item.add_delay_ms
    return _filled(
        {
            "link": item.link,
            "add_delay_ms": None if extra is None else _process(f"{path}.add_delay_ms", extra),
            "loss": item.loss,
            "rate_mbps": item.rate_mbps,
            **interval,
        }
    )


def _episodes(path: str, episodes: Episodes | None) -> Document | None:
    if episodes is None:
        return None
    every_s = _process(f"{path}.every_s", episodes.every_s)
    for_s = _process(f"{path}.for_s", episodes.for_s)
    return {"name": episodes.name, "every_s": every_s, "for_s": for_s}


def objective_document(objective: Objective) -> Document:
    """Return an objective as a cell file's ``objective`` says it, every tier named."""
    return _filled(
        {
            "weights": _dataclass(objective.weights),
            "targets": _dataclass(objective.targets),
            "caps": _dataclass(objective.caps),
            "tiers": dict(objective.tiers),
        }
    )


def _objective(problem: Problem) -> Document:
    document = objective_document(problem.objective)
    usual = {name: node.tier for name, node in problem.fabric.nodes.items()}
    if problem.objective.tiers == usual:
        document.pop("tiers", None)
    return document


def _controller(settings: ControllerSettings) -> Document:
    return {**_dataclass(settings), "fallbacks": list(settings.fallbacks)}


def _servo(servo: Servo | None) -> Document | None:
    if servo is None:
        return None
    return {**_dataclass(servo), "target": _dataclass(servo.target)}


def _live(settings: LiveSettings) -> Document | None:
    if settings == LiveSettings():
        return None
    hosts = {
        name: {
            "address": host.address,
            "port": host.port,
            "seen_from": {node: _dataclass(seen) for node, seen in host.seen_from.items()},
        }
        for name, host in settings.hosts.items()
    }
    return {**_dataclass(settings), "hosts": hosts, "actuators": dict(settings.actuators)}


def _dataclass(part: Any) -> Document:
    return _filled({item.name: getattr(part, item.name) for item in fields(part)})


def fingerprint(problem: Problem) -> str:
    """Return a short digest of what all nodes of a live cell have to agree on.

    Left out is what each node may say for itself: the code it runs, how it reaches others, and the
    data of traces, which a node need not have. The order of nodes and tasks is not left out: ports
    are given out by it.
    """
    document = to_document(problem)
    live = {**document.get("live", {})}
    for key in ("hosts", "actuators", "mode", "observer"):
        live.pop(key, None)
    document["live"] = live
    for task in document["tasks"].values():
        task.pop("run", None)
    text = json.dumps(_without_data(document))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without_data(part: Any) -> Any:
    """Return a document whose traces say their file and column, and nothing of what is in them."""
    if isinstance(part, dict):
        trace = part.get("trace")
        if isinstance(trace, dict):
            return {"trace": {"file": trace["file"], "column": trace["column"]}}
        return {key: _without_data(value) for key, value in part.items()}
    return [_without_data(one) for one in part] if isinstance(part, list | tuple) else part
