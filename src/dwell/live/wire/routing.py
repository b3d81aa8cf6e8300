"""Destinations of a task's output, by the stamp of the cycle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from dwell.errors import LiveError
from dwell.live.wire.keys import MAIN, SHADOW
from dwell.live.wire.messages import Stamp
from dwell.model import Flow, Problem
from dwell.model.due_tasks import DueTasks
from dwell.model.placement import Copy, Placement, Replicas, nodes_of

#: Largest number of cached routes.
MAX_KNOWN = 1_024
#: Sender of the input of a source task.
STAMPER = "stamper"


class Destination(NamedTuple):
    """A task's worker on a node; its shadow worker if `kind` is `SHADOW`.

    `after_ns` is the time since the release until which the sender holds the message.
    """

    task: str
    node: str
    kind: str
    after_ns: int = 0


class Routes:
    """Destinations of every task's output; they depend only on the stamp.

    A task gets messages in cycles in which it is due.

    A shadow shares the tasks that both placements run on the same nodes with the same inputs. From
    the first task on different nodes it has separate messages, down to the sinks' nodes.

    A cycle under a candidate with replicas has two copies. The node of a task with two nodes shows
    which copy its job and its messages belong to; all other tasks send to both copies.
    """

    def __init__(self, problem: Problem) -> None:
        self._candidates = problem.candidates
        self._pipeline = problem.pipeline
        #: Tasks that run in each cycle.
        self.due = DueTasks(problem.pipeline)
        self._outputs = {name: problem.pipeline.outputs(name) for name in problem.pipeline.tasks}
        self._outputs[STAMPER] = tuple(Flow(STAMPER, name) for name in self.due.sources)
        self._apart: dict[tuple[str, str], frozenset[str]] = {}
        self._known: dict[tuple[object, ...], tuple[Destination, ...]] = {}

    def runs(self, task: str, node: str, stamp: Stamp) -> bool:
        """Whether a task of a cycle runs on a node."""
        placement = self._candidates.get(stamp.placement)
        return placement is not None and node in nodes_of(placement[task])

    def begins_ns(self, task: str, node: str, stamp: Stamp) -> int:
        """Return the time from the release until a source of a second copy may begin."""
        placed = self._candidates.get(stamp.placement)
        is_second = isinstance(placed, Replicas) and placed.first[task] != node
        return _after_ns(placed) if is_second else 0

    def apart(self, placement: str, shadow: str) -> frozenset[str]:
        """Return the tasks that a cycle does not share with its shadow; none without a shadow."""
        pair = placement, shadow
        if pair not in self._apart:
            active, other = (self._candidates.get(name) for name in pair)
            if active is None or other is None:
                return frozenset()
            self._apart[pair] = self._pipeline.diverging(active, other.first)
        return self._apart[pair]

    def shadow_ends(self, stamp: Stamp) -> frozenset[str]:
        """Return the tasks that report the end of a cycle's shadow; none without a shadow."""
        return self.due.shadow_ends(self.apart(stamp.placement, stamp.shadow), stamp.cycle)

    def destinations(
        self, task: str, stamp: Stamp, node: str = "", *, shadow: bool = False
    ) -> tuple[Destination, ...]:
        """Return the destinations of a task's output; none for a sink task.

        `task` is the sender, `STAMPER` for the stamp itself; `node` counts if the task has two
        nodes. `shadow` is set for the output of a shadow. Raises a LiveError if the stamp's
        placement or shadow is not a candidate.
        """
        of_stamp = stamp.placement, stamp.shadow, stamp.forks, stamp.term == 0
        key = (task, node, *of_stamp, shadow, self.due.pattern(stamp.cycle))
        known = self._known.get(key)
        if known is None:
            self._check(stamp)
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            known = self._known[key] = tuple(dict.fromkeys(self._routed(task, stamp, node, shadow)))
        return known

    def _check(self, stamp: Stamp) -> None:
        for name in (stamp.placement, stamp.shadow):
            if name and name not in self._candidates:
                raise LiveError(
                    f"cycle {stamp.cycle} is stamped {name!r}, which is no candidate here "
                    f"({', '.join(self._candidates)}); the nodes' cell files differ"
                )

    def _routed(self, task: str, stamp: Stamp, node: str, shadow: bool) -> Iterable[Destination]:
        sent = [flow for flow in self._outputs[task] if self.due.sends(flow, stamp.cycle)]
        if not stamp.term:
            # The stamp is a guess, so all workers that may run the target get the output.
            for flow in sent:
                for anywhere in self._pipeline.tasks[flow.target].on:
                    yield Destination(flow.target, anywhere, MAIN)
            return
        placement = self._candidates[stamp.placement]
        other = self._candidates[stamp.shadow].first if stamp.shadow else None
        apart = self.apart(stamp.placement, stamp.shadow)
        # The cycle's tasks also send to the shadow, except for tasks that run twice.
        shares = shadow or task not in apart
        copies = () if shadow else _copies_at(placement, task, node)
        # A fork gets what the first copy sends.
        forks = stamp.forks if placement.first in copies else ()
        for flow in sent:
            target = flow.target
            for copy in copies[:1]:
                yield Destination(target, copy[target], MAIN)
            for forked, there in forks:
                if forked == target and there in self._pipeline.tasks[target].on:
                    yield Destination(target, there, MAIN)
            # The shadow of a target that does not wait uses no message of a shared task.
            to_shadow = shadow if flow.sampled else shares and target in apart
            if other is not None and to_shadow:
                yield Destination(target, other[target], SHADOW)
        for copy in copies[1:]:
            for target in (flow.target for flow in sent):
                if copy[target] != placement.first[target]:
                    yield Destination(target, copy[target], MAIN, _after_ns(placement))


def _copies_at(placement: Placement, task: str, node: str) -> tuple[Copy, ...]:
    """Return the copies of a cycle to which a task's job on a node belongs."""
    copies = placement.copies
    if len(copies) > 1:
        copies = tuple(copy for copy in copies if copy.get(task, node) == node)
    return copies


def _after_ns(placement: Placement | None) -> int:
    """Return the time from a release until messages go to its second copy alone."""
    return round(placement.after_ms * 1e6) if isinstance(placement, Replicas) else 0
