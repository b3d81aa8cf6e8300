"""Destinations of a task's output, by the stamp of the cycle."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from dwell.errors import LiveError
from dwell.live.wire.keys import MAIN, SHADOW
from dwell.live.wire.messages import Stamp
from dwell.model import Problem

#: Largest number of cached routes.
MAX_KNOWN = 1_024
#: Sender of the input of a source task.
STAMPER = "stamper"


class Destination(NamedTuple):
    """A task's worker on a node; its shadow worker if `kind` is `SHADOW`."""

    task: str
    node: str
    kind: str


class Routes:
    """Destinations of every task's output; they depend only on the stamp.

    A shadow shares the tasks that both placements run on the same nodes with the same inputs. From
    the first task on different nodes it has separate messages, down to the sinks' nodes.
    """

    def __init__(self, problem: Problem) -> None:
        self._candidates = problem.candidates
        self._pipeline = problem.pipeline
        self._targets = {
            name: tuple(flow.target for flow in problem.pipeline.outputs(name))
            for name in problem.pipeline.tasks
        }
        sources = [name for name in problem.pipeline.tasks if not problem.pipeline.inputs(name)]
        self._targets[STAMPER] = tuple(sources)
        self._known: dict[tuple[object, ...], tuple[Destination, ...]] = {}

    def runs(self, task: str, node: str, stamp: Stamp) -> bool:
        """Whether a task of a cycle runs on a node."""
        placement = self._candidates.get(stamp.placement)
        return placement is not None and placement[task] == node

    def destinations(
        self, task: str, stamp: Stamp, *, shadow: bool = False
    ) -> tuple[Destination, ...]:
        """Return the destinations of a task's output; none for a sink task.

        `task` is the sender, `STAMPER` for the stamp itself. `shadow` is set for the output of a
        shadow. Raises a LiveError if the stamp's placement or shadow is not a candidate.
        """
        key = (task, stamp.placement, stamp.shadow, stamp.forks, shadow, stamp.term == 0)
        known = self._known.get(key)
        if known is None:
            self._check(stamp)
            if len(self._known) >= MAX_KNOWN:
                self._known.clear()
            known = self._known[key] = tuple(dict.fromkeys(self._routed(task, stamp, shadow)))
        return known

    def _check(self, stamp: Stamp) -> None:
        for name in (stamp.placement, stamp.shadow):
            if name and name not in self._candidates:
                raise LiveError(
                    f"cycle {stamp.cycle} is stamped {name!r}, which is no candidate here "
                    f"({', '.join(self._candidates)}); the nodes' cell files differ"
                )

    def _routed(self, task: str, stamp: Stamp, shadow: bool) -> Iterable[Destination]:
        if not stamp.term:
            # The stamp is a guess, so all workers that may run the target get the output.
            for target in self._targets[task]:
                for node in self._pipeline.tasks[target].on:
                    yield Destination(target, node, MAIN)
            return
        active = self._candidates[stamp.placement]
        other = self._candidates.get(stamp.shadow) if stamp.shadow else None
        apart = self._pipeline.diverging(active, other) if other is not None else frozenset()
        # The cycle's tasks also send to the shadow, except for tasks that run twice.
        shares = shadow or task not in apart
        for target in self._targets[task]:
            if not shadow:
                yield Destination(target, active[target], MAIN)
                for forked, node in stamp.forks:
                    if forked == target and node in self._pipeline.tasks[target].on:
                        yield Destination(target, node, MAIN)
            if other is not None and shares and target in apart:
                yield Destination(target, other[target], SHADOW)
