"""Intervals: durations of cycles, measured with the clock of the stamper's node alone.

A cycle begins with its release by the stamper. It ends when the stamper receives its last
completion, minus the transmission time of the completion. This time is estimated as half of the
best round trip to the sink's node in the last one or two minutes. A beat gives the round trip: it
states which beat of the stamper's node its sender received last, and how long before. The rest of
the time since that beat is the round trip. On the stamper's own node the time is taken as 0.

Other clocks are not needed. The estimate assumes that the best way back takes half of the best
round trip, and that the completion took the best way; any extra delay becomes part of the interval.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from dwell.live.wire.messages import Beat, Completion

#: Length of a span; a best round trip counts in its own span and in the next one.
SPAN_NS = 60_000_000_000
#: Largest numbers of incomplete cycles, and of intervals to report.
MOST_WAITING = 256
MOST_REPORTED = 16


@dataclass(slots=True)
class _Best:
    """Best round trip to a node, in this span and in the previous span."""

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
    silences: int = 0


class Intervals:
    """See the module; `node` is the stamper's, and `sinks` returns the sinks due in a cycle."""

    def __init__(self, node: str, sinks: Callable[[int], frozenset[str]]) -> None:
        self._node, self._sinks = node, sinks
        self._best = {node: _Best(0, 0)}
        self._waiting: dict[int, _Waiting] = {}
        self._unreported: list[tuple[int, int, int]] = []

    def hear(self, beat: Beat, now_ns: int) -> None:
        """Measure the round trip to a node by a direct beat."""
        for heard in beat.heard:
            if heard.node == self._node:
                held_ns = beat.sent_ns - heard.at_ns
                best = self._best.setdefault(beat.node, _Best(now_ns))
                best.take(max(now_ns - heard.beat_ns - held_ns, 0), now_ns)

    def return_ns(self, node: str) -> int | None:
        """Return the estimated best transmission time from a node to here, ns; None if unknown."""
        best = self._best.get(node)
        round_trip_ns = None if best is None else best.value_ns
        return None if round_trip_ns is None else round_trip_ns // 2

    def completed(self, done: Completion, now_ns: int, *, newest: int, direct: bool) -> None:
        """Process a sink's completion, or its second copy.

        If a sink's completion arrives first over the detour, the cycle has no interval, because the
        transmission time is unknown. Only the last `MOST_WAITING` cycles up to `newest`, the last
        cycle that may have been sent, count; other numbers are old or false.
        """
        cycle = done.stamp.cycle
        waiting = self._waiting.get(cycle)
        if waiting is None:
            if not newest - MOST_WAITING < cycle <= newest:
                return
            waiting = self._waiting[cycle] = _Waiting()
            if len(self._waiting) > MOST_WAITING:
                del self._waiting[min(self._waiting)]
        sinks = self._sinks(cycle)
        if done.sink in waiting.said or done.sink not in sinks:
            return
        waiting.said.add(done.sink)
        waiting.silences += done.rested
        back_ns = self.return_ns(done.node) if direct else None
        if back_ns is None:
            waiting.known = False
        else:
            waiting.end_ns = max(waiting.end_ns, now_ns - back_ns)
        if waiting.known and waiting.said == sinks:
            interval_ns = max(waiting.end_ns - done.stamp.released_ns, 0)
            self._unreported.append((cycle, interval_ns, waiting.silences))
            del self._unreported[:-MOST_REPORTED]

    def take_unreported(self) -> tuple[tuple[int, int, int], ...]:
        """Return cycles, intervals, ns, and silences that are new since the last call.

        The silences are the commands of the cycle that found their actuator at rest.
        """
        reported, self._unreported = tuple(self._unreported), []
        return reported
