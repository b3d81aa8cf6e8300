"""Problems with several rates and sampled flows, made at random from problems without."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random

from dwell.model import Chain, Flow, Problem
from dwell.model.chain import behind
from tests.cells.once import with_windows

#: Rates of sources, of which several are multiples of another.
RATES = 1, 1, 2, 3, 4, 6
#: Share of the flows that are sampled.
SAMPLED = 0.35


def with_rates(problem: Problem, rng: Random) -> Problem:
    """Let sources run in every n-th cycle, and sample some flows; windows have all sinks."""
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
