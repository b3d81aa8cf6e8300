"""Cycles with two copies, by the section "Replicas" of the page."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator

from dwell.model import Flow, Problem, Replicas
from dwell.model.placement import Copy


def second(task: str) -> str:
    """Return the name of the second copy of a task."""
    return f"{task}/2"


class Copies:
    """The copies of cycles, and what nodes hold and have heard."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.pipeline = problem, problem.pipeline
        self.names = {second(task): task for task in problem.pipeline.tasks}
        self.cycles: dict[int, Replicas] = {}
        self.done: set[int] = set()
        #: When nodes heard of cycles.
        self.heard: dict[tuple[int, str], int] = {}
        #: Node of the sender of each message that is held, by cycle and flow.
        self.held: dict[tuple[int, int], str] = {}
        #: Flows to a common task of which a message counts.
        self.met: set[tuple[int, str, str]] = set()
        self.late: Counter[int] = Counter()
        self.least_ms = self.paths()

    def paths(self) -> dict[tuple[str, str], float]:
        """Return the least sum of mean delays between all nodes."""
        nodes, links = list(self.problem.fabric.nodes), self.problem.fabric.links
        ms = {(a, b): 0.0 if a == b else math.inf for a in nodes for b in nodes}
        for link in links.values():
            ms[link.source, link.target] = link.delay_ms.expectation
        for via, a, b in itertools.product(nodes, nodes, nodes):
            ms[a, b] = min(ms[a, b], ms[a, via] + ms[via, b])
        return ms

    def placements(self, name: str) -> tuple[Copy, ...]:
        """Return the placement of each copy of a candidate."""
        return self.problem.candidates[name].copies

    def plain(self, active: str) -> list[str]:
        """Return `active`, and the candidates that shadows go through under it, in their order."""
        known = self.problem.candidates
        placed = known[active]
        left_out = placed.members if isinstance(placed, Replicas) else ()
        return [
            name
            for name, one in known.items()
            if name == active or not (isinstance(one, Replicas) or name in left_out)
        ]

    def probed(self, wanted: str, fallback: str) -> str:
        """Return the candidate of the probes: a member of replicas that is not in force."""
        placed = self.problem.candidates[wanted]
        if not isinstance(placed, Replicas):
            return wanted
        first, other = placed.members
        return other if first == fallback else first

    def release(self, cycle: int, candidate: str) -> None:
        """Note the copies of a cycle."""
        placed = self.problem.candidates[candidate]
        if isinstance(placed, Replicas):
            self.cycles[cycle] = placed

    def is_replicated(self, cycle: int) -> bool:
        return cycle in self.cycles

    def is_doubled(self, cycle: int, task: str) -> bool:
        """Whether a task runs once per copy."""
        if cycle not in self.cycles:
            return False
        one, other = self.cycles[cycle].copies
        return one[task] != other[task]

    def is_common(self, cycle: int, task: str) -> bool:
        """Whether a task of a cycle with two copies runs once."""
        return cycle in self.cycles and task not in self.names and not self.is_doubled(cycle, task)

    def node_of_second(self, cycle: int, row: str) -> str:
        return self.cycles[cycle].copies[1][self.names[row]]

    def after_ns(self, cycle: int) -> int:
        return round(self.cycles[cycle].after_ms * 1e6)

    def has_heard(self, cycle: int, node: str) -> bool:
        return (cycle, node) in self.heard

    def is_late(self, cycle: int, flow: Flow, row: str, node: str) -> bool:
        """Whether a message that arrives now is dropped; it counts if it is."""
        late = self.has_heard(cycle, node)
        if self.is_common(cycle, row) and self.is_doubled(cycle, flow.source):
            key = cycle, flow.source, flow.target
            late = late or key in self.met
            self.met.add(key)
        self.late[cycle] += late
        return late

    def await_again(self, cycle: int, task: str) -> None:
        """Forget the messages that a node has lost."""
        self.met = {key for key in self.met if (key[0], key[2]) != (cycle, task)}

    def ways(self, cycle: int) -> Iterator[tuple[int, str, int]]:
        """Yield the nodes that hear of a cycle: number of the first task there, name, time."""
        copies = self.cycles[cycle].copies
        tasks = list(self.pipeline.tasks)
        sinks = {copies[0][task] for task in tasks if not self.pipeline.outputs(task)}
        on = [copy[task] for copy in copies for task in tasks]
        for node in dict.fromkeys(on):
            ms = max(self.least_ms[sink, node] for sink in sinks)
            if ms < math.inf:
                yield on.index(node), node, round(ms * 1e6)
