"""Lower bounds of J of all placements that share the nodes of their first tasks.

The bounds use the samples of the simulation and leave out what can only make a cycle later or a
node busier: queues between cycles, foreign threads, lost messages, added delays, and contention on
links. The latency of a cycle is bounded by its paths and by the work of each resource in the cycle.

A cycle that its window's end finds unfinished counts as missed and may leave its work undone. The
bound therefore charges each cycle with the smaller of two costs: a miss, or its work and the miss
that its latency implies.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from dwell.cost import tier_nodes
from dwell.estimators.any_placement import AnyPlacement
from dwell.model.fabric import Resource
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import order_statistic
from dwell.model.window_close import window_close_ns


@dataclass(frozen=True, slots=True)
class ResourceWork:
    """The work of one cycle on one resource, by cycle, nanoseconds."""

    earliest_ns: Ints
    work_ns: Ints
    tail_ns: Ints

    def latency_ns(self, capacity: float) -> Ints:
        """Return the earliest end of the cycle if the resource does all this work."""
        span_ns: Ints = np.floor(self.work_ns / capacity).astype(np.int64)
        span_ns += self.earliest_ns
        span_ns += self.tail_ns
        return span_ns


@dataclass(frozen=True, slots=True)
class Partial:
    """Nodes of the first tasks, and what follows for each cycle."""

    nodes: Mapping[str, str]
    finish_ns: Mapping[str, Ints]
    latency_ns: Ints
    loads: Mapping[str, ResourceWork]


class CostBounds:
    """Lower bounds of J on one sample.

    Parameters
    ----------
    sample : AnyPlacement
        The sample on which placements are simulated.
    """

    def __init__(self, sample: AnyPlacement) -> None:
        problem, real = sample.problem, sample.realisation
        self._problem, self._width = problem, problem.window_cycles
        self.order = problem.pipeline.topological()
        # What a window's end knows of a cycle is at most its age then.
        last_ns = real.release_ns[self._width - 1 : -1 : self._width]
        beyond_ns = real.release_ns[self._width :: self._width]
        close_ns = window_close_ns(problem, last_ns, beyond_ns)
        self._age_ns = np.repeat(close_ns, self._width) - real.release_ns[:-1]
        self._due_ns = np.minimum(self._age_ns, problem.pipeline.deadline_ns)
        self._longest_ms = round(problem.censor_ms * 1e6) / 1e6
        # Times beyond the age count as the age, so sums stay within 64 bits.
        most_ns = int(self._age_ns.max()) + 1
        self._exec_ns = dict(zip(real.sites, np.minimum(real.exec_ns, most_ns), strict=True))
        delay_ns = zip(real.hops, np.minimum(real.delay_ns, most_ns), strict=True)
        self._hop_ns = {
            hop: row + min(self._transmission_ns(hop), most_ns) for hop, row in delay_ns
        }
        self._span_ns = int((close_ns - real.release_ns[: -1 : self._width]).max())
        self._never_dropped = self._undropped()
        self._means_ns = {site: self._mean_work(*site) for site in real.sites}
        self._tail_ns = self._tails()
        self._costs = self._work_costs()
        self._left = self._costs_left()

    @property
    def root(self) -> Partial:
        """No task is placed."""
        return Partial({}, {}, np.zeros(len(self._age_ns), np.int64), {})

    def placed(self, partial: Partial, node: str) -> Partial:
        """Return a partial placement with its next task on a node."""
        name = self.order[len(partial.nodes)]
        task = self._problem.pipeline.tasks[name]
        start_ns = np.full(len(self._age_ns), round(task.offset_ms * 1e6))
        for flow in self._problem.pipeline.inputs(name):
            sent_ns, source = partial.finish_ns[flow.source], partial.nodes[flow.source]
            if source != node:
                sent_ns = sent_ns + self._hop_ns[flow.source, name, f"{source}->{node}"]
            np.maximum(start_ns, sent_ns, out=start_ns)
        finish_ns = start_ns + self._exec_ns[name, node]
        tail_ns = self._tail_ns[name, node]
        latency_ns = np.maximum(partial.latency_ns, finish_ns + tail_ns)
        resource, work_ns = self._work(name, node)
        load = ResourceWork(start_ns, work_ns, tail_ns)
        if resource.name in partial.loads:
            before = partial.loads[resource.name]
            load = ResourceWork(
                np.minimum(before.earliest_ns, start_ns),
                before.work_ns + work_ns,
                np.minimum(before.tail_ns, tail_ns),
            )
            np.maximum(latency_ns, load.latency_ns(resource.capacity), out=latency_ns)
        return Partial(
            {**partial.nodes, name: node},
            {**partial.finish_ns, name: finish_ns},
            latency_ns,
            {**partial.loads, resource.name: load},
        )

    def cost(self, partial: Partial) -> float:
        """Return a lower bound of J, without the switching term."""
        objective = self._problem.objective
        weights, targets = objective.weights, objective.targets
        seen_ns = np.minimum(partial.latency_ns, self._age_ns).reshape(-1, self._width)
        l95_ms = order_statistic(seen_ns, 95) / 1e6
        latency = weights.latency * np.minimum(l95_ms, self._longest_ms).mean()
        most = weights.violations / len(self._age_ns)
        missed = np.where(partial.latency_ns > self._due_ns, most, 0.0)
        work = max(float(np.minimum(missed + cost, most).sum()) for cost in self._by_cycle(partial))
        return float(latency) / targets.latency_ms + work

    def overloaded(self, partial: Partial) -> str | None:
        """Return a resource with more work than it can do if no message is lost.

        Work that full queues may drop does not count.
        """
        period_ns = self._problem.pipeline.period_ms * 1e6
        work_ns: defaultdict[str, float] = defaultdict(float)
        for name, node in partial.nodes.items():
            if name in self._never_dropped:
                resource, mean_ns = self._means_ns[name, node]
                work_ns[resource.name] += mean_ns
                if work_ns[resource.name] > resource.capacity * period_ns:
                    return resource.name
        return None

    def _undropped(self) -> frozenset[str]:
        """Return the tasks whose jobs no full queue drops, theirs or one before them."""
        pipeline = self._problem.pipeline
        found: set[str] = set()
        for name in self.order:
            before = (flow.source in found for flow in pipeline.inputs(name))
            if pipeline.tasks[name].depth == 0 and all(before):
                found.add(name)
        return frozenset(found)

    def _transmission_ns(self, hop: tuple[str, str, str]) -> int:
        """Return the least time that a message takes at the rate of a link."""
        (payload,) = {
            flow.payload_bytes
            for flow in self._problem.pipeline.flows
            if (flow.source, flow.target) == hop[:2]
        }
        return int(payload * 8000.0 / self._problem.fabric.links[hop[2]].rate_mbps)

    def _work(self, name: str, node: str) -> tuple[Resource, Ints]:
        """Return the resource of a task on a node, and the work of its jobs."""
        execution = self._problem.pipeline.tasks[name].on[node]
        resource = self._problem.fabric.resources[execution.resource(node)]
        threads = execution.threads if execution.accelerator is None else 1
        return resource, self._exec_ns[name, node] * threads

    def _mean_work(self, name: str, node: str) -> tuple[Resource, float]:
        resource, work_ns = self._work(name, node)
        return resource, float(work_ns.mean())

    def _tails(self) -> dict[tuple[str, str], Ints]:
        """Return the least time from a task's end to the cycle's, by task and node."""
        pipeline = self._problem.pipeline
        tails: dict[tuple[str, str], Ints] = {}
        for name in reversed(self.order):
            for node in pipeline.tasks[name].on:
                longest = np.zeros(len(self._age_ns), np.int64)
                for flow in pipeline.outputs(name):
                    ways = [
                        self._exec_ns[flow.target, other] + tails[flow.target, other] + hop_ns
                        for other in pipeline.tasks[flow.target].on
                        if (hop_ns := self._between(flow.source, flow.target, node, other))
                        is not None
                    ]
                    if ways:
                        np.maximum(longest, np.minimum.reduce(ways), out=longest)
                tails[name, node] = longest
        return tails

    def _between(self, source: str, target: str, one: str, other: str) -> Ints | int | None:
        return 0 if one == other else self._hop_ns.get((source, target, f"{one}->{other}"))

    def _work_costs(self) -> dict[str, tuple[str, float, float]]:
        """Return each counted resource's tier, and J of a nanosecond of its work.

        The second cost is of the mean over the resources of the tier, which bounds their maximum.
        """
        objective, resources = self._problem.objective, self._problem.fabric.resources
        weights, targets, nodes = objective.weights, objective.targets, self._problem.fabric.nodes
        windows = len(self._age_ns) // self._width
        found: dict[str, tuple[str, float, float]] = {}
        for tier, names in tier_nodes(objective)._asdict().items():
            weight, target = getattr(weights, tier), getattr(targets, tier)
            # A window may hold more of a quota than its share.
            counted = [
                resources[name] for name in names if nodes[resources[name].node].quota is None
            ]
            if not weight or not counted:
                continue
            by_core = weight / (target * self._span_ns * windows)
            cores = sum(one.capacity for one in counted)
            found |= {one.name: (tier, by_core / one.capacity, by_core / cores) for one in counted}
        return found

    def _costs_left(self) -> list[Floats]:
        """Return the least cost of the tasks left, by cycle, for each number of placed tasks."""
        left = [np.zeros(len(self._age_ns))]
        for name in reversed(self.order):
            ways = []
            for node in self._problem.pipeline.tasks[name].on:
                resource, work_ns = self._work(name, node)
                ways.append(work_ns * self._costs.get(resource.name, ("", 0.0, 0.0))[2])
            left.append(left[-1] + np.minimum.reduce(ways))
        return left[::-1]

    def _by_cycle(self, partial: Partial) -> Iterator[Floats]:
        """Yield lower bounds of J's terms of utilisation, by cycle."""
        mean = self._left[len(partial.nodes)]
        largest: dict[str, tuple[float, Floats]] = {}
        for name, load in partial.loads.items():
            if name not in self._costs:
                continue
            tier, alone, share = self._costs[name]
            mean = mean + load.work_ns * share
            cost: Floats = np.multiply(load.work_ns, alone, dtype=np.float64)
            if tier not in largest or cost.sum() > largest[tier][0]:
                largest[tier] = float(cost.sum()), cost
        yield mean
        if largest:
            yield sum((cost for _, cost in largest.values()), np.zeros(len(self._age_ns)))
