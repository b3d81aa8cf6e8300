"""Source cycles: a source task begins a cycle at the instant that its stamp names."""

from __future__ import annotations

from collections.abc import Callable

from dwell.live.roles.joins import MAX_JOINS, Job
from dwell.live.roles.offsets import Offsets
from dwell.live.roles.role import RolePlace
from dwell.live.wire.messages import Header, Stamp
from dwell.live.wire.routing import STAMPER
from dwell.model.instants import NEVER_NS


class SourceCycles:
    """Stamps of a source task; each waits for the instant at which its cycle begins here.

    If the source's node is not the stamper's, stamps arrive one cycle early. If a stamp is missing
    and cycles are released by a timer, the source guesses stamps for up to g cycles, at least one.
    `offset_ns` returns the time from the release of a cycle to its begin here. Cycles of a `shadow`
    worker are shadows, which are never guessed.
    """

    def __init__(
        self,
        place: RolePlace,
        offsets: Offsets,
        rate: int,
        offset_ns: Callable[[Stamp], int],
        *,
        shadow: bool,
    ) -> None:
        self._place, self._offsets, self._offset_ns = place, offsets, offset_ns
        self._rate, self._shadow = rate, shadow
        self._guesses = max(place.problem.controller.guard_cycles // rate, 1)
        timed = place.problem.live.release == "timer"
        self._alone = place.node != place.stamper[0] and timed and not shadow
        self._waiting: dict[tuple[int, int], tuple[Header, int]] = {}
        self._last: Header | None = None
        self._guessed = 0

    def stamped(self, header: Header, now_ns: int) -> None:
        """Store a stamp; of several stamps of one cycle, the highest term counts."""
        cycle = header.stamp.key
        if self._last is not None and cycle <= self._last.stamp.key:
            return
        known = self._waiting.get(cycle)
        if known is None or known[0].stamp.term < header.stamp.term:
            self._waiting[cycle] = header, now_ns
            if len(self._waiting) > MAX_JOINS:
                del self._waiting[min(self._waiting)]

    def cancel(self, cycle: tuple[int, int]) -> None:
        """Forget the stamp of a cycle that is done."""
        header, _ = self._waiting.pop(cycle, (None, 0))
        self._last = header or self._last

    def leave(self) -> None:
        """Guess no stamp before the next one, because the task runs on another node."""
        self._guessed = self._guesses

    def _begins_ns(self, header: Header) -> int:
        return self._offsets.from_reference(self._place.node, header.stamp.released_ns)[0]

    @property
    def due_ns(self) -> int:
        """Instant at which the next cycle begins, or its stamp is guessed."""
        if self._waiting:
            header, _ = self._waiting[min(self._waiting)]
            return self._begins_ns(header) + self._offset_ns(header.stamp)
        if self._last is None or not self._alone or self._guessed >= self._guesses:
            return NEVER_NS
        period_ns = self._place.period_ns
        begins_ns = self._begins_ns(self._last) + self._rate * period_ns
        return begins_ns + self._offset_ns(self._last.stamp) + period_ns // 4

    def due(self, now_ns: int) -> Job | None:
        """Return the job of the cycle that begins now; None if no cycle does."""
        if now_ns < self.due_ns:
            return None
        if self._waiting:
            header, at_ns = self._waiting.pop(min(self._waiting))
            self._guessed = 0
        elif self._last is not None:
            before, at_ns = self._last.stamp, now_ns
            released_ns = before.released_ns + self._rate * self._place.period_ns
            cycle = before.cycle + self._rate
            guess = Stamp(before.run, cycle, 0, before.placement, released_ns)
            seal = self._place.stamped(guess)
            header = Header(guess, STAMPER, self._place.node, "none", seal=seal)
            self._guessed += 1
        else:
            return None
        self._last = header
        return Job(header, {STAMPER: (header, b"", at_ns)}, self._shadow)
