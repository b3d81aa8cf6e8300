"""Cycles with two copies at a worker: which of them are done, and messages held for the second."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from dwell.live.roles.joins import MAX_JOINS
from dwell.live.wire.messages import Completion, Stamp
from dwell.model import Problem
from dwell.model.instants import NEVER_NS


@dataclass(frozen=True, slots=True)
class _Held:
    """A message of a cycle, held until an instant of this node's clock."""

    cycle: tuple[int, int]
    due_ns: int
    send: Callable[[], None]


@dataclass(slots=True)
class ReplicatedCycles:
    """See the module.

    A cycle is done here when the completions of all sinks have arrived here. No cycle with forked
    inputs is done: the node that gets the state needs all of them.
    """

    problem: Problem
    _held: list[_Held] = field(default_factory=list)
    # Sinks that have completed each of the last cycles.
    _completed: dict[tuple[int, int], set[str]] = field(default_factory=dict)

    def has_copies(self, stamp: Stamp) -> bool:
        """Whether a cycle has two copies."""
        return bool(stamp.term) and stamp.placement in self.problem.replicas

    def is_done(self, stamp: Stamp) -> bool:
        """Whether a cycle with two copies is done."""
        sinks = self._completed.get(stamp.key)
        return sinks is not None and sinks >= {*self.problem.pipeline.sinks}

    def completed(self, done: Completion) -> bool:
        """Record a completion; return whether its cycle is done, and forget what it holds."""
        stamp = done.stamp
        if not self.has_copies(stamp) or stamp.forks:
            return False
        self._completed.setdefault(stamp.key, set()).add(done.sink)
        if len(self._completed) > MAX_JOINS:
            del self._completed[min(self._completed)]
        is_done = self.is_done(stamp)
        if is_done:
            self._held = [one for one in self._held if one.cycle != stamp.key]
        return is_done

    def hold(self, stamp: Stamp, due_ns: int, send: Callable[[], None]) -> None:
        """Hold a message until an instant; drop it if its cycle is done before."""
        self._held.append(_Held(stamp.key, due_ns, send))

    @property
    def due_ns(self) -> int:
        """Instant at which the next held message is due; `NEVER_NS` without one."""
        return min((one.due_ns for one in self._held), default=NEVER_NS)

    def send_due(self, now_ns: int) -> None:
        """Send the held messages that are due."""
        due = [one for one in self._held if one.due_ns <= now_ns]
        self._held = [one for one in self._held if one.due_ns > now_ns]
        for one in due:
            one.send()
