"""Lower bounds of J of all placements that share the nodes of their first tasks.

The bounds use the samples of the simulation and leave out what can only make a cycle later or a
node busier: queues between cycles, foreign threads, lost messages, added delays, and contention on
links. The latency of a cycle is bounded by its paths and by the work of each resource in the cycle.

A cycle that its window's end finds unfinished counts as missed and may leave its work undone. The
bound therefore charges each cycle with the smaller of two costs: a miss, or its work and the miss
that its latency implies.

With several rates only the tasks that are needed in a cycle count: those from which waited flows
lead to a sink that is due. All other work may be left undone without a miss. Idle cycles have no
latency and miss nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from dwell.cost import tier_nodes
from dwell.estimators.any_placement import AnyPlacement
from dwell.estimators.needed_cycles import Mask, NeededCycles
from dwell.model.fabric import Resource
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import order_statistic, order_statistic_of_smallest
from dwell.model.window_close import window_close_ns

#: An instant later than all others; the sum of two stays within 64 bits.
FAR_NS = 1 << 61


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

    def joined(self, other: ResourceWork) -> ResourceWork:
        """Return this work and more."""
        return ResourceWork(
            np.minimum(self.earliest_ns, other.earliest_ns),
            self.work_ns + other.work_ns,
            np.minimum(self.tail_ns, other.tail_ns),
        )

    def only(self, needed: Mask) -> ResourceWork:
        """Return the work of some cycles; the others have none."""
        return ResourceWork(
            np.where(needed, self.earliest_ns, FAR_NS),
            np.where(needed, self.work_ns, 0),
            np.where(needed, self.tail_ns, FAR_NS),
        )


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
        pipeline = problem.pipeline
        self._problem, self._width = problem, problem.window_cycles
        self.order = pipeline.topological()
        self._waited = {name: pipeline.waited(name) for name in self.order}
        self._needed = NeededCycles(pipeline, real.cycles)
        self._never = {name for name in self.order if self._needed.is_never(name)}
        self._has_rates = pipeline.has_rates
        # At a window's end the latency of a cycle counts for at most its age.
        last_ns = real.release_ns[self._width - 1 : -1 : self._width]
        beyond_ns = real.release_ns[self._width :: self._width]
        close_ns = window_close_ns(problem, last_ns, beyond_ns)
        self._age_ns = np.repeat(close_ns, self._width) - real.release_ns[:-1]
        self._deadline_ns = np.minimum(self._age_ns, pipeline.deadline_ns)
        self._miss_cost = self._cost_of_a_miss()
        self._longest_ms = problem.censor_ms
        # Times beyond the age count as the age, so sums stay within 64 bits.
        most_ns = int(self._age_ns.max()) + 1
        self._exec_ns = dict(zip(real.sites, np.minimum(real.exec_ns, most_ns), strict=True))
        # The rows of forwards follow; without moves nothing is forwarded.
        delay_ns = zip(real.hops, np.minimum(real.delay_ns, most_ns), strict=False)
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
        task, needed = self._problem.pipeline.tasks[name], self._needed.of[name]
        nodes = {**partial.nodes, name: node}
        if name in self._never:
            return replace(partial, nodes=nodes)
        start_ns = np.full(len(self._age_ns), round(task.offset_ms * 1e6))
        for flow in self._waited[name]:
            sent_ns, source = partial.finish_ns[flow.source], partial.nodes[flow.source]
            if source != node:
                sent_ns = sent_ns + self._hop_ns[flow.source, name, f"{source}->{node}"]
            np.maximum(start_ns, sent_ns, out=start_ns)
        finish_ns = start_ns + self._exec_ns[name, node]
        tail_ns = self._tail_ns[name, node]
        reached_ns = finish_ns + tail_ns
        resource, work_ns = self._work(name, node)
        load = ResourceWork(start_ns, work_ns, tail_ns)
        if needed is not None:
            reached_ns, load = np.where(needed, reached_ns, 0), load.only(needed)
        latency_ns = np.maximum(partial.latency_ns, reached_ns)
        if resource.name in partial.loads:
            load = partial.loads[resource.name].joined(load)
            span_ns = load.latency_ns(resource.capacity)
            if self._has_rates:
                # Cycles without work on the resource; paths bound the others without work.
                span_ns[load.work_ns == 0] = 0
            np.maximum(latency_ns, span_ns, out=latency_ns)
        return Partial(
            nodes,
            {**partial.finish_ns, name: finish_ns},
            latency_ns,
            {**partial.loads, resource.name: load},
        )

    def cost(self, partial: Partial) -> float:
        """Return a lower bound of J, without the switching term."""
        objective = self._problem.objective
        weights, targets = objective.weights, objective.targets
        l95_ms = self._l95_ns(np.minimum(partial.latency_ns, self._age_ns)) / 1e6
        latency = weights.latency * np.minimum(l95_ms, self._longest_ms).mean()
        most = self._miss_cost
        missed = np.where(partial.latency_ns > self._deadline_ns, most, 0.0)
        work = max(float(np.minimum(missed + cost, most).sum()) for cost in self._by_cycle(partial))
        return float(latency) / targets.latency_ms + work

    def _l95_ns(self, seen_ns: Ints) -> Ints:
        """Return L95 of every window."""
        if self._needed.due is None:
            return order_statistic(seen_ns.reshape(-1, self._width), 95)
        windows = np.where(self._needed.due, seen_ns, FAR_NS).reshape(-1, self._width)
        counts = self._needed.due.reshape(-1, self._width).sum(axis=1)
        return order_statistic_of_smallest(windows, 95, counts)

    def _cost_of_a_miss(self) -> Floats:
        """Return J of a miss in each cycle; 0 for idle cycles."""
        weight, cycles = self._problem.objective.weights.violations, len(self._age_ns)
        if self._needed.due is None:
            return np.full(cycles, weight / cycles)
        windows = self._needed.due.reshape(-1, self._width)
        counted = len(windows) * windows.sum(axis=1, keepdims=True)
        return np.where(windows, weight / counted, 0.0).ravel()

    def _needed_work(self, name: str, node: str) -> tuple[Resource, Ints]:
        """Return the resource of a task on a node, and the work of the jobs that are needed."""
        resource, work_ns = self._work(name, node)
        needed = self._needed.of[name]
        return resource, work_ns if needed is None else np.where(needed, work_ns, 0)

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
            before = (flow.source in found for flow in self._waited[name])
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
                    if flow.sampled:
                        continue
                    ways = [
                        self._exec_ns[flow.target, other] + tails[flow.target, other] + hop_ns
                        for other in pipeline.tasks[flow.target].on
                        if (hop_ns := self._between(flow.source, flow.target, node, other))
                        is not None
                    ]
                    if ways:
                        least = np.minimum.reduce(ways)
                        if (needed := self._needed.of[flow.target]) is not None:
                            least = np.where(needed, least, 0)
                        np.maximum(longest, least, out=longest)
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
                resource, work_ns = self._needed_work(name, node)
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
