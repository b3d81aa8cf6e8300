"""Which tasks are due and needed in a cycle, by the section "Several rates" of the page.

Shares no code with `dwell.model` beyond the keys of tasks and flows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from dwell.model import Flow, Pipeline, Problem
from dwell.model.placement import Copy, Placement


class Rates:
    """The rates of a pipeline's tasks and flows."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self.sources = [name for name in pipeline.tasks if not self.waited_inputs(name)]
        self.sinks = [name for name in pipeline.tasks if not pipeline.outputs(name)]
        self.of = {name: self.rate(name) for name in pipeline.tasks}
        self.sinks_of = {name: self.behind(name) for name in pipeline.tasks}

    def waited_inputs(self, task: str) -> list[Flow]:
        return [flow for flow in self.pipeline.inputs(task) if not flow.sampled]

    def sampled_inputs(self, task: str) -> list[Flow]:
        return [flow for flow in self.pipeline.inputs(task) if flow.sampled]

    def rate(self, task: str) -> int:
        """Cycles from one run of a task to the next."""
        waited = self.waited_inputs(task)
        if waited:
            return max(self.rate(flow.source) for flow in waited)
        return self.pipeline.tasks[task].every or 1

    def behind(self, task: str) -> set[str]:
        """Return the sinks that a task leads to by waited flows."""
        outputs = self.pipeline.outputs(task)
        if not outputs:
            return {task}
        return {sink for f in outputs if not f.sampled for sink in self.behind(f.target)}

    def is_due(self, task: str, cycle: int) -> bool:
        return cycle % self.of[task] == 0

    def due_sinks(self, cycle: int) -> list[str]:
        return [sink for sink in self.sinks if self.is_due(sink, cycle)]

    def is_needed(self, task: str, cycle: int) -> bool:
        return any(self.is_due(sink, cycle) for sink in self.sinks_of[task])

    def of_flow(self, flow: Flow) -> int:
        return self.of[flow.source if flow.sampled else flow.target]

    def carries(self, flow: Flow, cycle: int) -> bool:
        """Whether a flow has a message of a cycle."""
        return cycle % self.of_flow(flow) == 0

    def descent(
        self, taken: Callable[[int, str], Mapping[str, int]], start: str, task: str, cycle: int
    ) -> set[int]:
        """Return the cycles of `start` from which a job descends.

        `taken` returns the cycles of the values that a job got, by their sources.
        """
        if task == start:
            return {cycle}
        found = set[int]()
        for flow in self.waited_inputs(task):
            found |= self.descent(taken, start, flow.source, cycle)
        for source, value in taken(cycle, task).items():
            found |= self.descent(taken, start, source, value)
        return found

    def on_ways(self, start: str, end: str) -> list[str]:
        """Return the tasks on the ways by flows of either kind from one task to another."""
        if start == end:
            return [end]
        behind = [self.on_ways(flow.target, end) for flow in self.pipeline.outputs(start)]
        found = [task for tasks in behind for task in tasks]
        return [start, *found] if found else []

    def apart(self, active: Placement, other: Copy) -> set[str]:
        """Return the tasks on other nodes, or on two, under `active`, and all behind them."""

        def is_apart(task: str) -> bool:
            before = [flow.source for flow in self.waited_inputs(task)]
            return active[task] != other[task] or any(is_apart(source) for source in before)

        return {task for task in self.pipeline.tasks if is_apart(task)}


def earlier_cycles(problem: Problem) -> int:
    """Cycles before a decision's own that its evidence has: only if a task skips cycles."""
    pipeline, slowest = problem.pipeline, max(Rates(problem.pipeline).of.values())
    if slowest == 1:
        return 0
    settings = problem.controller
    order_ms = 2 * pipeline.deadline_ms + settings.order_delay_ms
    order = settings.order_lead_cycles + math.ceil(order_ms / pipeline.period_ms)
    return min(2 * slowest, problem.window_cycles - 1) + order
