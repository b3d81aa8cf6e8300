"""Random cells: DAGs of tasks on two robots and an edge, with steady faults as scenarios."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from dwell.cellfile import from_document
from dwell.model import Problem

Document = dict[str, Any]


def random_cell(number: int) -> Problem:
    """Return the cell of a number: 4 to 8 tasks, 2 to 4 candidates, four scenarios."""
    return from_document(_document(number))


def rated_cell(number: int) -> Problem:
    """Return the cell with several rates: sources skip cycles, and some flows are sampled."""
    document = _document(number)
    rng, rates = random.Random(60_000 + number), dict[str, int]()
    for name, task in document["tasks"].items():
        waited = [flow for flow in document["flows"] if flow["to"] == name]
        kept: list[int] = []
        for flow in waited:
            rate = rates[flow["from"]]
            if rng.random() < SAMPLED or any(rate % one and one % rate for one in kept):
                flow["sampled"] = True
            else:
                kept.append(rate)
        rates[name] = max(kept, default=0) or rng.choice(RATES)
        if not kept or min(kept) < max(kept):
            task["every"] = rates[name]
    return from_document(document)


#: Cycles from one run of a source to its next; share of the flows that are sampled.
RATES, SAMPLED = (1, 1, 2, 5, 10), 0.3


def passing_faults(number: int) -> Problem:
    """Return the cell with the default settings; each fault holds once, for 30 of 120 s."""
    document = _document(number)
    del document["controller"]
    steady = document["scenarios"].values()
    document["scenarios"] = {
        "passing": [
            {**fault, "at_s": 60 + 120 * place, "for_s": 30}
            for place, faults in enumerate(steady)
            for fault in faults
        ]
    }
    return from_document(document)


def _document(number: int) -> Document:
    rng = random.Random(50_000 + number)
    period_ms = rng.choice([33.3, 50, 100])
    has_gpu = rng.random() < 0.5
    nodes = _nodes(rng, has_gpu)
    links = _links(rng)
    tasks, flows, movable, scales = _pipeline(rng, period_ms, has_gpu, nodes)
    return {
        "dwell": 1,
        "name": f"random-{number}",
        "period_ms": period_ms,
        "nodes": nodes,
        "links": links,
        "tasks": tasks,
        "flows": flows,
        "scales": scales,
        "candidates": _candidates(rng, tasks, movable),
        "deadline_ms": round(period_ms * rng.choice([0.7, 1, 1]), 3),
        "window_cycles": rng.choice([30, 50, 100]),
        "warmup_windows": 5,
        "scenarios": _scenarios(rng),
        "controller": {"policy": "dtp", "estimator": "corrected", "shadow_fraction": 0.05},
    }


def _nodes(rng: random.Random, has_gpu: bool) -> Document:
    nodes: Document = {
        "R1": {
            "tier": "robot",
            "cores": rng.choice([1, 2, 2, 4]),
            "scheduler": rng.choice(["fair", "fair", "fifo", "priority"]),
        },
        "R2": {"tier": "robot", "cores": rng.choice([1, 2, 4])},
        "E": {
            "tier": "edge",
            "cores": rng.choice([4, 8]),
            "scheduler": rng.choice(["fair", "fair", "fifo"]),
        },
    }
    if has_gpu:
        nodes["E"]["accelerators"] = {"gpu": 1}
    if rng.random() < 0.3:
        nodes["E"]["bursts"] = {
            "every_ms": {"exponential": {"mean": 150}},
            "for_ms": {"exponential": {"mean": 15}},
            "threads": rng.randint(2, 8),
        }
    if rng.random() < 0.25:
        nodes["R1"]["accelerators"] = {"gpu": 1}
    return nodes


def _links(rng: random.Random) -> list[Document]:
    delays: list[Mapping[str, object]] = [
        {"lognormal": {"mean": 1, "cv": 0.5}},
        {"exponential": {"mean": 2}},
        {"uniform": {"low": 0.3, "high": 4}},
    ]
    links = []
    for source, target in (("R1", "E"), ("R2", "E"), ("R1", "R2")):
        link: Document = {"from": source, "to": target, "both_ways": True}
        link["delay_ms"] = rng.choice(delays)
        if rng.random() < 0.6:
            link["rate_mbps"] = rng.choice([100, 300, 940])
        if rng.random() < 0.3:
            link["loss"] = rng.choice([0.001, 0.01])
        if rng.random() < 0.5:
            link["on_loss"] = {"retransmit_ms": rng.choice([5, 20])}
        links.append(link)
    return links


def _pipeline(
    rng: random.Random, period_ms: float, has_gpu: bool, nodes: Document
) -> tuple[Document, list[Document], list[str], Document]:
    """Return tasks, flows, the tasks that have several nodes, and scales."""
    count, sources = rng.randint(4, 8), rng.choice([1, 1, 2, 3])
    names = [f"t{k}" for k in range(count)]
    # Core time of all tasks if all run on the robot, of which the middle ones take a share each.
    work_ms = rng.choice([0.45, 0.6, 0.8, 0.95]) * period_ms * min(nodes["R1"]["cores"], 2)
    middle = names[sources:-1] if count - 1 > sources else names[sources - 1 : -1]
    share = [rng.random() + 0.3 for _ in middle]
    cv, rho = rng.choice([0.1, 0.25]), rng.choice([0.5, 0.9])
    tasks: Document = {}
    for place, name in enumerate(names):
        if name in middle:
            mean_ms = work_ms * share[middle.index(name)] / sum(share)
            tasks[name] = _movable(rng, mean_ms, has_gpu, nodes)
        else:
            is_last = place == count - 1
            node = "R2" if is_last or (place and rng.random() >= 0.7) else "R1"
            tasks[name] = {"on": {node: {"exec_ms": round(rng.uniform(0.1, 1.5), 2)}}}
        if rng.random() < 0.5:
            tasks[name]["input"] = "latest"
    flows = []
    for place in range(sources, count):
        fan_in = min(place, rng.choice([1, 1, 2, 2]))
        for source in rng.sample(range(max(0, place - 4), place), fan_in):
            size = rng.choice([500, 5000, 60_000, 200_000])
            flows.append({"from": names[source], "to": names[place], "bytes": size})
    used = {flow["from"] for flow in flows}
    flows += [
        {"from": name, "to": names[-1], "bytes": 500} for name in names[:-1] if name not in used
    ]
    movable = [name for name in middle if len(tasks[name]["on"]) > 1]
    return tasks, flows, movable, {"scene": {"ar1": {"mean": 1, "cv": cv, "rho": rho}}}


def _movable(rng: random.Random, mean_ms: float, has_gpu: bool, nodes: Document) -> Document:
    """Return a task that may run on the robot, on the edge and perhaps on the other robot."""
    cv = rng.choice([0.1, 0.2, 0.4])
    on: Document = {"R1": {"exec_ms": _lognormal(mean_ms, cv)}}
    if rng.random() < 0.3 and nodes["R1"]["cores"] > 1:
        on["R1"] = {"exec_ms": _lognormal(mean_ms / 2, cv), "threads": 2}
    if "accelerators" in nodes["R1"] and rng.random() < 0.5:
        on["R1"]["accelerator"] = "gpu"
        on["R1"].pop("threads", None)
    factor = rng.choice([0.4, 0.7, 1.0])
    on["E"] = {"exec_ms": _lognormal(mean_ms * factor, 0.2)}
    if has_gpu and rng.random() < 0.6:
        on["E"] = {"exec_ms": _lognormal(mean_ms * factor * 0.6, 0.2), "accelerator": "gpu"}
    if rng.random() < 0.6:
        on["R2"] = {"exec_ms": _lognormal(mean_ms * rng.choice([0.8, 1, 1.5]), 0.2)}
    task: Document = {"on": on}
    if rng.random() < 0.5:
        task["scale"] = "scene"
    if rng.random() < 0.3:
        task["priority"] = rng.randint(0, 2)
    return task


def _lognormal(mean_ms: float, cv: float) -> Document:
    return {"lognormal": {"mean": round(mean_ms, 3), "cv": cv}}


def _candidates(rng: random.Random, tasks: Document, movable: list[str]) -> Document:
    candidates: Document = {name: dict.fromkeys(movable, node) for name, node in ENDS.items()}
    for number in range(4):
        placed = {name: rng.choice(list(tasks[name]["on"])) for name in movable}
        if placed not in candidates.values() and len(candidates) < 4:
            candidates[f"C{number}"] = placed
    return candidates


#: All movable tasks on the robot, or on the edge.
ENDS = {"LOC": "R1", "SO": "E"}


def _scenarios(rng: random.Random) -> Document:
    def slower(mean_ms: float) -> Document:
        return {"normal": {"mean": mean_ms, "std": 2}}

    return {
        "robot": [{"node": "R1", "stress_threads": rng.choice([1, 2, 4])}],
        "edge": [{"node": "E", "stress_threads": rng.choice([4, 8, 16])}],
        "network": [
            {
                "link": "R1->E",
                "both_ways": True,
                "add_delay_ms": slower(rng.choice([4, 8, 15])),
                "loss": rng.choice([0, 0.005, 0.02]),
            },
            {"link": "E->R2", "both_ways": True, "add_delay_ms": slower(4)},
        ],
        "rate": [{"link": "R1->E", "rate_mbps": rng.choice([20, 50]), "both_ways": True}],
    }
