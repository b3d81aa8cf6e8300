"""Problems as documents: plain values with the structure of a cell file."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import lru_cache
from typing import Any, TypeAlias, get_args

from dwell.errors import Fault, ProblemError
from dwell.model.controller_settings import ControllerSettings
from dwell.model.declaration import Digested, declared_fields
from dwell.model.fabric import Link, Node
from dwell.model.live import LiveSettings
from dwell.model.objective import Objective
from dwell.model.pipeline import Task
from dwell.model.placement import Placement, Replicas
from dwell.model.problem import Problem
from dwell.model.process import DRAWN, Constant, Process, Trace, UnreadTrace
from dwell.model.scenario import Disturbance, LinkDisturbance

# Version of the cell file.
VERSION = 1

Document: TypeAlias = dict[str, Any]

NAMES: dict[type, str] = {kind: name for name, kind in DRAWN.items()}

PLAIN = (float, int, str, bool)
#: Keys of every disturbance, which come last.
INTERVAL = ("at_s", "for_s", "down", "episodes", "ramp_s")


def to_document(problem: Problem) -> Document:
    """Return the document of a problem.

    `dwell.cellfile.from_document` makes an equal problem from it. A trace is named, not copied; its
    declaration includes a digest, which detects other data.

    Returns
    -------
    dict
        Dicts, lists, strings, finite numbers and truth values: ready for JSON or YAML.

    Raises
    ------
    ProblemError
        If it contains a process that a cell file cannot express.
    """
    pipeline, fabric = problem.pipeline, problem.fabric
    return _filled(
        {
            "dwell": VERSION,
            "name": problem.name,
            **_part("", pipeline, "tasks", "flows", "scales", "chains"),
            "window_cycles": problem.window_cycles,
            "warmup_windows": problem.warmup_windows,
            "nodes": {name: _node(node) for name, node in fabric.nodes.items()},
            "links": [_link(i, link) for i, link in enumerate(fabric.links.values())],
            "tasks": {name: _task(task) for name, task in pipeline.tasks.items()},
            "flows": [_part(f"flows[{i}]", flow) for i, flow in enumerate(pipeline.flows)],
            "scales": {
                name: _process(f"scales.{name}", scale) for name, scale in pipeline.scales.items()
            },
            "chains": {
                name: _part(f"chains.{name}", chain) for name, chain in pipeline.chains.items()
            }
            or None,
            "candidates": _candidates(problem),
            "scenarios": {
                name: [_disturbance(f"scenarios.{name}[{i}]", item) for i, item in enumerate(items)]
                for name, items in problem.scenarios.items()
            },
            "objective": _objective(problem),
            "controller": _part("controller", problem.controller),
            "servo": _part("servo", problem.servo) if problem.servo else None,
            "live": _part("live", problem.live) if problem.live != LiveSettings() else None,
        }
    )


def digest(trace: Trace) -> str:
    """Return the SHA-256 of a trace's values, groups and instants, in hexadecimal.

    Equal numbers have equal digests on every machine and in every file format.
    """
    import numpy as np

    table = trace.table
    state = hashlib.sha256(np.ascontiguousarray(trace.values, "<f8").tobytes())
    state.update(np.ascontiguousarray(table.starts, "<i8").tobytes())
    if table.time_ms is not None:
        state.update(np.ascontiguousarray(table.time_ms, "<f8").tobytes())
    return state.hexdigest()


def _filled(values: Document) -> Document:
    """Leave out missing values and infinite limits, as a cell file does."""
    return {key: value for key, value in values.items() if value not in (None, math.inf)}


def _part(path: str, part: Any, *but: str, **more: object) -> Document:
    """Return a dataclass as a document without the fields in `but`; `more` is appended."""
    document: Document = {}
    kind: Any = type(part)
    for name, key, usual in _fields(kind):
        value = getattr(part, name)
        if name not in but and name not in more and value != usual:
            document[key] = (
                value if type(value) in PLAIN else _value(f"{path}.{key}" if path else key, value)
            )
    return _filled({**document, **more})


@lru_cache(maxsize=64)
def _fields(kind: type) -> tuple[tuple[str, str, object], ...]:
    """Return name, key and, if a document omits it, default of every field."""
    return tuple(
        (one.name, one.named, one.default if one.key.is_rare else None)
        for one in declared_fields(kind)
    )


def _value(path: str, value: Any) -> Any:
    if hasattr(type(value), "marginal"):
        return _process(path, value)
    if is_dataclass(value):
        return _part(path, value)
    if isinstance(value, dict):
        return {name: _value(f"{path}.{name}", item) for name, item in value.items()}
    return list(value) if isinstance(value, tuple) else value


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
    return {name: _part(path, process)}


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


def relocated(placement: Placement, tasks: Mapping[str, Task]) -> dict[str, str]:
    """Return the placement of the first copy without anchored tasks, as in a document."""
    return {name: node for name, node in placement.first.items() if not tasks[name].anchored}


def _candidate(placement: Placement, tasks: Mapping[str, Task]) -> Document:
    if not isinstance(placement, Replicas):
        return {**relocated(placement, tasks)}
    after = {"after_ms": placement.after_ms} if placement.after_ms else {}
    return {"replicas": list(placement.members), **after}


def _candidates(problem: Problem) -> Document:
    every, tasks = problem.every_placement, problem.pipeline.tasks
    placements = {name: _candidate(one, tasks) for name, one in problem.candidates.items()}
    if every is None:
        return placements
    return {"all": "found" if every.is_found else True, "keep": every.keep, **placements}


def _node(node: Node) -> Document:
    path, bursts = f"nodes.{node.name}", node.bursts
    foreign = _part(f"{path}.bursts", bursts, "add_delay_ms") if bursts else None
    return _part(path, node, "name", bursts=foreign)


def _link(index: int, link: Link) -> Document:
    path, bursts, retransmit_ms = f"links[{index}]", link.bursts, link.retransmit_ms
    delayed = _part(f"{path}.bursts", bursts, "threads") if bursts else None
    return _part(
        path,
        link,
        "retransmit_ms",
        "in_order",
        on_loss="drop" if retransmit_ms is None else {"retransmit_ms": retransmit_ms},
        in_order=link.in_order,
        bursts=delayed,
    )


def _task(task: Task) -> Document:
    words: dict[int, str | Document] = {0: "queue", 1: "latest"}
    document = _part(f"tasks.{task.name}", task, "name")
    return {**document, "input": words.get(task.depth, {"queue": task.depth})}


def disturbance_document(item: Disturbance) -> Document:
    """Return an item of a scenario as in a cell file, for one direction of a link."""
    return _disturbance("", item)


def _disturbance(path: str, item: Disturbance) -> Document:
    link = {"link": item.link} if isinstance(item, LinkDisturbance) else {}
    document = {**link, **_part(path, item, "source", "target")}
    last = {key: document.pop(key) for key in INTERVAL if key in document}
    return {**document, **last}


def objective_document(objective: Objective) -> Document:
    """Return an objective as in a cell file's ``objective``, with every tier."""
    document = _part("objective", objective)
    # The tiers determine which accelerators count.
    if not document.pop("accelerators", None):
        return document
    return {**document, "accelerators": True}


def _objective(problem: Problem) -> Document:
    document = objective_document(problem.objective)
    usual = {name: node.tier for name, node in problem.fabric.nodes.items()}
    if problem.objective.tiers == usual:
        document.pop("tiers", None)
    return document


def digests(problem: Problem) -> dict[Digested, str]:
    """Return short digests of a live cell, one for each group of readers (see `Digested`).

    Processes communicate only if their `wiring` is equal. The digests exclude the data of traces,
    which a node may lack. They depend on the order of nodes and tasks, which assigns the ports.
    """
    document = to_document(problem)
    document["live"] = document.get("live", {})
    sections: list[tuple[str, type, Document]] = [
        ("objective", Objective, document["objective"]),
        ("controller", ControllerSettings, document["controller"]),
        ("live", LiveSettings, document["live"]),
        *((f"tasks.{name}", Task, task) for name, task in document["tasks"].items()),
    ]
    parts: dict[Digested, Document] = {part: {} for part in get_args(Digested)}
    for path, kind, values in sections:
        for field in declared_fields(kind):
            if field.key.digested != "wiring" and field.named in values:
                parts[field.key.digested][f"{path}.{field.named}"] = values.pop(field.named)
    # The estimator determines whether processes for shadow jobs exist.
    parts["wiring"] = {**document, "shadow workers": problem.controller.shadow_workers}
    texts = {part: json.dumps(_without_data(values)) for part, values in parts.items()}
    return {part: hashlib.sha256(text.encode()).hexdigest()[:16] for part, text in texts.items()}


def _without_data(part: Any) -> Any:
    """Return a document with only file and column of each trace."""
    if isinstance(part, dict):
        trace = part.get("trace")
        if isinstance(trace, dict):
            return {"trace": {"file": trace["file"], "column": trace["column"]}}
        return {key: _without_data(value) for key, value in part.items()}
    return [_without_data(one) for one in part] if isinstance(part, list | tuple) else part
