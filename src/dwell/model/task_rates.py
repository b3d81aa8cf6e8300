"""Rates of tasks: the number of cycles from one run of a task to its next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from graphlib import TopologicalSorter
from itertools import pairwise
from typing import Protocol

from dwell.errors import Fault

#: Largest common multiple of the rates of a pipeline, cycles.
MOST_COMMON_CYCLES = 100_000


class Edge(Protocol):
    """A flow: its tasks, and whether the target samples it."""

    @property
    def source(self) -> str:
        """Task that sends."""

    @property
    def target(self) -> str:
        """Task that receives."""

    @property
    def sampled(self) -> bool:
        """Whether the target does not wait for it."""


class Rated(Protocol):
    """A task, which may state its rate."""

    @property
    def every(self) -> int | None:
        """Cycles from one run to the next; None if not stated."""


def rates_of(tasks: Mapping[str, Rated], flows: Iterable[Edge]) -> dict[str, int]:
    """Return the rate of each task, cycles: it runs in the cycles 0, n, 2n, ...

    A task without waited inputs has its own `every`; each other task has the slowest rate of its
    waited inputs.
    """
    waited = [flow for flow in flows if not flow.sampled]
    if not any(task.every for task in tasks.values()):
        return dict.fromkeys(tasks, 1)
    rates: dict[str, int] = {}
    for name in _ordered(tasks, waited):
        inputs = [rates[flow.source] for flow in waited if flow.target == name]
        rates[name] = max(inputs) if inputs else tasks[name].every or 1
    return {name: rates[name] for name in tasks}


def rate_faults(tasks: Mapping[str, Rated], flows: Sequence[Edge]) -> Iterator[Fault]:
    """Yield the faults of the rates of valid tasks, whose flows have no loops."""
    rates = rates_of(tasks, flows)
    for name, task in tasks.items():
        inputs = [flow.source for flow in flows if flow.target == name and not flow.sampled]
        if inputs and (message := _bad_join(task.every, {one: rates[one] for one in inputs})):
            yield Fault(f"tasks.{name}.every", message)
    common = math.lcm(*rates.values())
    if common > MOST_COMMON_CYCLES:
        slowest = max(rates, key=lambda name: rates[name])
        yield Fault(
            f"tasks.{slowest}.every",
            f"the rates {', '.join(map(str, sorted({*rates.values()})))} coincide only every "
            f"{common} cycles; choose rates with a common multiple of at most {MOST_COMMON_CYCLES}",
        )


def _bad_join(every: int | None, inputs: Mapping[str, int]) -> str:
    """Return why a task cannot wait for inputs with these rates; empty if it can."""
    fastest = min(inputs, key=lambda name: inputs[name])
    slowest = max(inputs, key=lambda name: inputs[name])
    fast, slow = inputs[fastest], inputs[slowest]
    sampled = f"mark the flow from {slowest} with `sampled: true`"
    known = sorted({*inputs.values()})
    if any(later % first for first, later in pairwise(known)):
        names = " and ".join(f"{name} (every {rate})" for name, rate in inputs.items())
        return f"it waits for {names}, and no rate is a multiple of the other; {sampled}"
    if every is None and fast != slow:
        return (
            f"missing: it waits for {fastest} (every {fast}) and for {slowest} (every {slow}); "
            f"{sampled}, or set `every: {slow}`"
        )
    if every not in (None, slow):
        return (
            f"{every} is not allowed; it waits for {slowest} (every {slow}): remove it, "
            f"or {sampled}"
        )
    return ""


def _ordered(tasks: Iterable[str], flows: Iterable[Edge]) -> Iterable[str]:
    graph: TopologicalSorter[str] = TopologicalSorter(dict.fromkeys(tasks, ()))
    for flow in flows:
        graph.add(flow.target, flow.source)
    return graph.static_order()
