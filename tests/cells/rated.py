"""Problems with several rates and sampled flows: made by hand, or at random."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random
from typing import Any

from dwell.cellfile.cell import from_document
from dwell.model import Chain, Flow, Problem
from dwell.model.chain import behind
from tests.cells.once import with_windows

#: Rates of sources, of which several are multiples of another.
RATES = 1, 1, 2, 3, 4, 6
#: Share of the flows that are sampled.
SAMPLED = 0.35


def with_rates(problem: Problem, rng: Random, *, idle: bool = True) -> Problem:
    """Let sources run in every n-th cycle, and sample some flows; windows have all sinks.

    Without `idle` a sink runs in every cycle.
    """
    made = _with_rates(problem, rng)
    while made.pipeline.has_idle_cycles and not idle:
        made = _with_rates(problem, rng)
    return made


def _with_rates(problem: Problem, rng: Random) -> Problem:
    pipeline = problem.pipeline
    flows = [replace(flow, sampled=rng.random() < SAMPLED) for flow in pipeline.flows]
    rates: dict[str, int] = {}
    tasks = dict(pipeline.tasks)
    for name in pipeline.topological():
        task = tasks[name]
        flows = waitable(name, flows, rates)
        inputs = [rates[flow.source] for flow in flows if flow.target == name and not flow.sampled]
        if not inputs:
            rates[name] = rng.choice(RATES)
            offset_ms = task.offset_ms or rng.choice([0.0, round(pipeline.period_ms / 2)])
            tasks[name] = replace(task, every=rates[name], offset_ms=offset_ms)
            continue
        rates[name] = max(inputs)
        stated = rates[name] if min(inputs) < max(inputs) or rng.random() < 0.2 else None
        tasks[name] = replace(task, every=stated)
    slowest = max(rate for name, rate in rates.items() if not pipeline.outputs(name))
    width = max(problem.window_cycles, rng.choice([slowest, slowest, 2 * slowest]))
    rated = replace(pipeline, tasks=tasks, flows=tuple(flows))
    return replace(with_windows(problem, width), pipeline=rated)


def waitable(name: str, flows: list[Flow], rates: dict[str, int]) -> list[Flow]:
    """Sample those inputs of a task whose rate is no divisor or multiple of the others' rates."""
    kept: set[int] = set()
    result = []
    for flow in flows:
        if flow.target == name and not flow.sampled:
            rate = rates[flow.source]
            if all(rate % other == 0 or other % rate == 0 for other in kept):
                kept.add(rate)
            else:
                flow = replace(flow, sampled=True)
        result.append(flow)
    return result


def drawn(mean_ms: float) -> dict[str, Any]:
    """Return a log-normal process."""
    return {"lognormal": {"mean": mean_ms, "cv": 0.3}}


def inner_loop(**changes: Any) -> dict[str, Any]:
    """Return a control loop at 100 Hz that samples the detections of a camera at 10 Hz."""
    on = {"R": {"exec_ms": drawn(2)}}
    return {
        "dwell": 1,
        "name": "inner-loop",
        "period_ms": 10,
        "deadline_ms": 7,
        "window_cycles": 40,
        "nodes": {"R": {"tier": "robot", "cores": 2}, "E": {"tier": "edge", "cores": 4}},
        "links": [{"from": "R", "to": "E", "both_ways": True, "delay_ms": drawn(2)}],
        "tasks": {
            "camera": {"on": on, "every": 10, "offset_ms": 1},
            "imu": {"on": on},
            "detect": {"on": {"R": {"exec_ms": drawn(60)}, "E": {"exec_ms": drawn(30)}}},
            "control": {"on": {"R": {"exec_ms": drawn(3)}, "E": {"exec_ms": drawn(1)}}},
        },
        "flows": [
            {"from": "camera", "to": "detect", "bytes": 1000},
            {"from": "imu", "to": "control"},
            {"from": "detect", "to": "control", "sampled": True},
        ],
        "candidates": {
            "LOC": {"detect": "R", "control": "R"},
            "SO": {"detect": "E", "control": "R"},
            "ALL": {"detect": "E", "control": "E"},
        },
        "objective": {
            "weights": {"latency": 1, "violations": 1, "robot": 1, "edge": 1, "switching": 1},
            "targets": {"latency_ms": 5, "robot": 0.5, "edge": 0.5},
        },
    } | changes


def idle_cell() -> Problem:
    """Return the same loop, whose control waits for the detections: nine cycles in ten are idle."""
    cell = inner_loop(deadline_ms=10, period_ms=20, window_cycles=60)
    cell["flows"][2]["sampled"] = False
    cell["tasks"]["control"]["every"] = 10
    for name in ("detect", "camera"):
        for on in cell["tasks"][name]["on"].values():
            on["exec_ms"] = drawn(1)
    return from_document(cell)


def with_chains(problem: Problem, rng: Random) -> Problem:
    """Let one cell in two have chains between connected tasks, most with a bound on their age."""
    pipeline = problem.pipeline
    pairs = [
        (source, target)
        for source in pipeline.tasks
        for target in sorted(behind(source, pipeline.flows))
    ]
    if not pairs or rng.random() < 0.5:
        return problem
    chains = {}
    for number in range(rng.choice([1, 1, 2])):
        source, target = rng.choice(pairs)
        age_ms = round(pipeline.period_ms * rng.uniform(0.5, 12), 1)
        bound_ms = rng.choice([age_ms, age_ms, age_ms, math.inf])
        chains[f"chain{number}"] = Chain(source, target, bound_ms)
    return replace(problem, pipeline=replace(pipeline, chains=chains))
