"""Continuity: protects growing numbers from a single false message.

Cycles, terms, lives and instants only grow. If a single false number, damaged or forged, were
accepted and far too high, all later messages would count as old.

`Continuity`: a cycle's number may be ahead by `RESERVED`, the numbers that a restarted stamper may
skip, plus the cycles that can have been released since the last message. A number further ahead, or
of a later run, is a leap. It is accepted after `CONFIRMATIONS` messages in a row, over some
periods, if each follows the previous one and none follows the accepted number.

`OvershootDetector`: a life or an instant may be ahead by any time, because a computer may have
slept. But if `CONFIRMATIONS` messages grow in a row below the accepted number, it was false.

`RunClaims`: a stamper without the saved state of its last run learns the run from others.

`SetbackDetector`: after a clock was set back, due times must be shifted, or they would be too late.
"""

from __future__ import annotations

from typing import TypeAlias

from dwell.model.instants import NEVER_NS

#: Cycle numbers that the stamper reserves at a time; a restart skips the rest.
RESERVED = 1_024
#: Number of messages in a row that confirm a leap.
CONFIRMATIONS = 5
#: Largest difference between the delays of two messages.
LATENESS_NS = 2_000_000_000
#: Largest number of cycles released per period (`release: frames`).
MOST_A_PERIOD = 2

#: Number of equal claims in a row that an unsigned claim needs.
CLAIMS = 3
#: Claimed runs from here on are ignored: the last quarter of the range stays free.
CLAIMED_RUN_LIMIT = 3 << 60

#: Run and number.
Cycle: TypeAlias = tuple[int, int]


class Continuity:
    """Distinguishes cycles that follow the accepted cycles from leaps.

    `newest` is the highest accepted run and cycle, None before the first; `leaps` counts the
    messages with a leap.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self.newest: Cycle | None = None
        self.leaps = 0
        self._heard_ns = 0
        self._forget()

    def _forget(self) -> None:
        self._leap: tuple[Cycle, int] | None = None
        self._since_ns = self._confirmations = 0

    def believe(self, cycle: Cycle, now_ns: int) -> None:
        """Accept a cycle as the newest, even if it is lower than the newest one before."""
        self.newest, self._heard_ns = cycle, now_ns
        self._forget()

    def ahead(self, now_ns: int) -> int:
        """Return how far a cycle that arrives now may be ahead of the newest."""
        return self._ahead(self._heard_ns, now_ns)

    def _ahead(self, heard_ns: int, now_ns: int) -> int:
        passed_ns = max(now_ns - heard_ns, 0) + LATENESS_NS
        return RESERVED + MOST_A_PERIOD * passed_ns // self._period_ns

    def takes(self, cycle: Cycle, now_ns: int, *, alone: bool = False) -> bool:
        """Whether a cycle (run and number) is accepted; it becomes the newest if it is later.

        It arrived at `now_ns` on this node's clock. With `alone` a leap never counts as a
        confirmation of other leaps.
        """
        newest = self.newest
        if newest is None or self._follows(newest, self._heard_ns, cycle, now_ns):
            self.believe(cycle, now_ns)
            return True
        if cycle <= newest:
            return True
        self.leaps += 1
        if alone:
            return False
        leap = self._leap
        if leap is None or not self._follows(*leap, cycle, now_ns):
            self._confirmations, self._since_ns = 0, now_ns
        self._leap = cycle, now_ns
        self._confirmations += 1
        if (
            self._confirmations < CONFIRMATIONS
            or now_ns - self._since_ns < (CONFIRMATIONS - 1) * self._period_ns // 2
        ):
            return False
        self.believe(cycle, now_ns)
        return True

    def _follows(self, before: Cycle, heard_ns: int, cycle: Cycle, now_ns: int) -> bool:
        step = cycle[1] - before[1]
        return cycle[0] == before[0] and 0 < step <= self._ahead(heard_ns, now_ns)


class RunClaims:
    """Runs that other processes claim; `needed` equal claims in a row are accepted."""

    def __init__(self, needed: int) -> None:
        self._needed = needed
        self._claims: dict[str, tuple[int, int]] = {}

    def believed(self, who: str, run: int) -> bool:
        """Record a claim; return whether it is now accepted."""
        known, count = self._claims.get(who, (run, 0))
        self._claims[who] = run, count + 1 if known == run else 1
        return self._claims[who][1] >= self._needed and run < CLAIMED_RUN_LIMIT

    def below(self, run: int, who: str) -> bool:
        """Whether a process has claimed a run, and its last claim is not above this run."""
        return self._claims.get(who, (NEVER_NS, 0))[0] <= run


class SetbackDetector:
    """Detects that the clock of its own node was set back."""

    def __init__(self) -> None:
        self._seen_ns = -NEVER_NS

    def back_ns(self, now_ns: int) -> int:
        """Return the time by which the clock was set back since the last call, or 0."""
        seen_ns, self._seen_ns = self._seen_ns, now_ns
        return max(seen_ns - now_ns, 0)


class OvershootDetector:
    """Detects that the accepted instant was too high.

    Late messages and copies are below the accepted instant too, but they do not grow in a row.
    """

    def __init__(self) -> None:
        self.advanced()

    def advanced(self) -> None:
        """Record a message at or above the accepted instant."""
        self._behind: tuple[int, ...] | None = None
        self._confirmations = 0

    def behind(self, *order: int) -> bool:
        """Record a lower instant (or life and instant); return whether the accepted was false."""
        if self._behind is None or order > self._behind:
            self._behind = order
            self._confirmations += 1
        if self._confirmations < CONFIRMATIONS:
            return False
        self.advanced()
        return True
