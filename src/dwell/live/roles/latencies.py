"""Intervals: how long cycles took, by the clock of the stamper's node alone.

A cycle begins with its stamp, here, and ends with the arrival of its last completion, here, less
what the completion's way back took. For that way half of the best round trip to the sink's node is
taken, of those of the last minute or two: a beat says which beat of the stamper's its sender has
heard last and how long ago, so that what is left of the time since is the way there and back.

It needs no clock but one. It assumes that the best way back takes half of the best round trip, and
that the completion had such a way: what it was late is part of the interval.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from dwell.live.wire.messages import Beat, Completion

#: Time after one to two of which a round trip is forgotten.
SPAN_NS = 60_000_000_000
#: Cycles that are waited for at a time, and intervals that wait to be told.
MOST_WAITING = 256
MOST_REPORTED = 16


@dataclass(slots=True)
class _Best:
    """Best round trip to a node: of this span, and of the one before."""

    begun_ns: int
    now_ns: int | None = None
    before_ns: int | None = None

    def take(self, round_trip_ns: int, at_ns: int) -> None:
        if at_ns - self.begun_ns >= SPAN_NS:
            self.begun_ns, self.before_ns, self.now_ns = at_ns, self.now_ns, None
        if self.now_ns is None or round_trip_ns < self.now_ns:
            self.now_ns = round_trip_ns

    @property
    def value_ns(self) -> int | None:
        known = [value for value in (self.now_ns, self.before_ns) if value is not None]
        return min(known, default=None)


@dataclass(slots=True)
class _Waiting:
    said: set[str] = field(default_factory=set)
    end_ns: int = 0
    known: bool = True


class Intervals:
    """See the module.

    Parameters
    ----------
    who : str
        The stamper.
    """

    def __init__(self, who: str, sinks: Collection[str]) -> None:
        self._who, self._sinks = who, frozenset(sinks)
        self._best: dict[str, _Best] = {}
        self._waiting: dict[int, _Waiting] = {}
        self._unreported: list[tuple[int, int]] = []

    def hear(self, beat: Beat, now_ns: int) -> None:
        """Learn from a beat that came directly how far its node is."""
        for heard in beat.heard:
            if heard.who == self._who:
                held_ns = beat.sent_ns - heard.at_ns
                best = self._best.setdefault(beat.node, _Best(now_ns))
                best.take(max(now_ns - heard.beat_ns - held_ns, 0), now_ns)

    def return_ns(self, node: str) -> int | None:
        """Return the best time, ns, of a message from a node to here; None if it is not known."""
        best = self._best.get(node)
        round_trip_ns = None if best is None else best.value_ns
        return None if round_trip_ns is None else round_trip_ns // 2

    def completed(self, done: Completion, now_ns: int, *, newest: int, direct: bool) -> None:
        """Take in a sink's completion, or its second copy.

        A cycle that was first heard of over the detour has no interval, as its way back is not
        known; nor has a cycle beyond the last `MOST_WAITING` up to `newest`, the last that may
        have been sent: such a number is old or false.
        """
        cycle = done.stamp.cycle
        waiting = self._waiting.get(cycle)
        if waiting is None:
            if not newest - MOST_WAITING < cycle <= newest:
                return
            waiting = self._waiting[cycle] = _Waiting()
            if len(self._waiting) > MOST_WAITING:
                del self._waiting[min(self._waiting)]
        if done.sink in waiting.said or done.sink not in self._sinks:
            return
        waiting.said.add(done.sink)
        back_ns = self.return_ns(done.node) if direct else None
        if back_ns is None:
            waiting.known = False
        else:
            waiting.end_ns = max(waiting.end_ns, now_ns - back_ns)
        if waiting.known and waiting.said == self._sinks:
            self._unreported.append((cycle, max(waiting.end_ns - done.stamp.released_ns, 0)))
            del self._unreported[:-MOST_REPORTED]

    def take_unreported(self) -> tuple[tuple[int, int], ...]:
        """Return cycles and their intervals, ns, that have not been returned before."""
        reported, self._unreported = tuple(self._unreported), []
        return reported
