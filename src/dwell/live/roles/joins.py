"""Joins: the inputs of one cycle become a job when the last of them has arrived."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TypeAlias

from dwell.live.wire.messages import Header, Hop
from dwell.model.pipeline import LONGEST_DEADLINE

#: Largest number of cycles that wait for the rest of their inputs, by the longest deadline.
MAX_JOINS = LONGEST_DEADLINE
#: Header, payload and time of arrival by source task.
Inputs: TypeAlias = dict[str, tuple[Header, bytes, int]]


@dataclass(slots=True)
class Job:
    """A complete set of inputs of one cycle; `header` is the header of one of them.

    `values` are the inputs that the task samples, once a worker has taken the job.
    """

    header: Header
    inputs: Inputs
    shadow: bool
    values: Inputs = field(default_factory=dict)

    @property
    def arrived_ns(self) -> int:
        """Arrival of the last input."""
        return max(at_ns for _, _, at_ns in self.inputs.values())

    @property
    def order(self) -> tuple[int, int]:
        """Run and cycle; they grow with every job."""
        return self.header.stamp.key

    @property
    def headers(self) -> Iterable[Header]:
        """Headers of the inputs."""
        return (header for header, _, _ in self.inputs.values())

    def hops(self) -> tuple[Hop, ...]:
        """Return all jobs upstream in this cycle, each once."""
        hops = (hop for header, _, _ in self.inputs.values() for hop in header.hops)
        return tuple({(hop.task, hop.node): hop for hop in hops}.values())


@dataclass(slots=True)
class Joins:
    """Inputs of incomplete cycles.

    A complete cycle evicts cycles `open_cycles` or more before it: their deadlines have passed.
    `drop` gets the headers of inputs that are too late or evicted.
    """

    sources: frozenset[str]
    drop: Callable[[Iterable[Header]], None]
    open_cycles: int = 1
    waiting: dict[tuple[int, int], Inputs] = field(default_factory=dict)
    newest: tuple[int, int] = (-1, -1)
    # Nodes that the inputs of complete cycles came from, among the newest `open_cycles`.
    done: dict[tuple[int, int], dict[str, str]] = field(default_factory=dict)

    @property
    def _last_over(self) -> tuple[int, int]:
        """The last cycle whose inputs are too late."""
        run, number = self.newest
        return run, number - self.open_cycles

    def add(self, header: Header, payload: bytes, at_ns: int) -> Inputs | None:
        """Add an input; return the set of its cycle's inputs if it is now complete."""
        cycle = header.stamp.key
        late = cycle <= self._last_over or cycle in self.done
        if late or header.source not in self.sources:
            self.drop([header])
            return None
        inputs = self.waiting.setdefault(cycle, {})
        inputs.setdefault(header.source, (header, payload, at_ns))
        if len(inputs) < len(self.sources):
            if len(self.waiting) > MAX_JOINS:
                self._evict(min(self.waiting))
            return None
        self.newest = max(self.newest, cycle)
        del self.waiting[cycle]
        last = self._last_over
        self.done[cycle] = {source: one.node for source, (one, _, _) in inputs.items()}
        self.done = {other: nodes for other, nodes in self.done.items() if other > last}
        for other in [other for other in self.waiting if other <= last]:
            self._evict(other)
        return inputs

    def is_late(self, header: Header) -> bool:
        """Whether the other copy's message of this flow came first, or the cycle is too old."""
        cycle = header.stamp.key
        waiting = self.waiting.get(cycle, {}).get(header.source)
        nodes = self.done.get(cycle, {}) if waiting is None else {header.source: waiting[0].node}
        return cycle <= self._last_over or nodes.get(header.source, header.node) != header.node

    def cancel(self, cycle: tuple[int, int]) -> Inputs:
        """Return the inputs that wait in a cycle, and forget them."""
        return self.waiting.pop(cycle, {})

    def _evict(self, cycle: tuple[int, int]) -> None:
        self.drop(header for header, _, _ in self.waiting.pop(cycle).values())
