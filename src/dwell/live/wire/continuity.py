"""Continuity: numbers that one message alone does not move.

Cycles, terms, lives and instants only grow: a single number that is far too high, damaged or made
up, would make all that come later old ones.

`Continuity`: a cycle's number may be `RESERVED` ahead, which a stamper leaves out when it starts
again, and as many more as can have been released since. One that is further ahead, or of a later
run, leaps: it is believed once `CONFIRMATIONS` in a row, over some periods, have gone on from one
another, and none between them went on from what was believed.

`OvershootDetector`: a life or an instant may be any time ahead, as a computer may have slept. But
where `CONFIRMATIONS` in a row grow behind the one that is believed, that one was false.

`RunClaims`: a stamper without the book of its last run learns that run from others.

`SetbackDetector`: what was due on a clock that has been set back would be due too late.
"""

from __future__ import annotations

from typing import TypeAlias

from dwell.model.instants import NEVER_NS

#: Cycle numbers that the stamper reserves at a time; after a restart the rest of them stays unused.
RESERVED = 1_024
#: Messages in a row that are believed, though they do not go on from what was believed before.
CONFIRMATIONS = 5
#: How much sooner than the message before it a message may have been heard, for all its delay.
LATENESS_NS = 2_000_000_000
#: Cycles that may be released in a period (`release: frames`).
MOST_A_PERIOD = 2

#: Equal claims in a row that are believed of a sender that signs nothing.
CLAIMS = 3
#: No claimed run is believed from here on: the last quarter of the range stays free.
CLAIMED_RUN_LIMIT = 3 << 60

#: Run and number.
Cycle: TypeAlias = tuple[int, int]


class Continuity:
    """Tells cycles that go on from those believed before from those that leap.

    Attributes
    ----------
    newest : (int, int) or None
        Highest run and cycle believed; None before the first.
    leaps : int
        Messages that were not believed.
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
        """Go on from a cycle, whatever was believed before."""
        self.newest, self._heard_ns = cycle, now_ns
        self._forget()

    def ahead(self, now_ns: int) -> int:
        """Numbers that a cycle heard now may be ahead of the newest."""
        return self._ahead(self._heard_ns, now_ns)

    def _ahead(self, heard_ns: int, now_ns: int) -> int:
        passed_ns = max(now_ns - heard_ns, 0) + LATENESS_NS
        return RESERVED + MOST_A_PERIOD * passed_ns // self._period_ns

    def takes(self, cycle: Cycle, now_ns: int, *, alone: bool = False) -> bool:
        """Whether a cycle is believed; a later one than the newest becomes that.

        Parameters
        ----------
        cycle : (int, int)
            Run and number.
        now_ns : int
            When it was heard, on this node's clock.
        alone : bool
            Whether it never counts as company for others.
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
    """Runs that other processes name, each with its number of equal claims in a row.

    Parameters
    ----------
    needed : int
        Number of claims that are believed: 1 where they are signed.
    """

    def __init__(self, needed: int) -> None:
        self._needed = needed
        self._claims: dict[str, tuple[int, int]] = {}

    def believed(self, who: str, run: int) -> bool:
        """Note a claim; whether it is believed now."""
        known, count = self._claims.get(who, (run, 0))
        self._claims[who] = run, count + 1 if known == run else 1
        return self._claims[who][1] >= self._needed and run < CLAIMED_RUN_LIMIT

    def below(self, run: int, who: str) -> bool:
        """Whether a process has named a run, and none beyond this one."""
        return self._claims.get(who, (NEVER_NS, 0))[0] <= run


class SetbackDetector:
    """Notices that the clock of its own node has been set back."""

    def __init__(self) -> None:
        self._seen_ns = -NEVER_NS

    def back_ns(self, now_ns: int) -> int:
        """Return by how much the clock has gone back since the last call; 0 where it has not."""
        seen_ns, self._seen_ns = self._seen_ns, now_ns
        return max(seen_ns - now_ns, 0)


class OvershootDetector:
    """Notices that an instant that was believed had been too high.

    Late messages and copies are behind what is believed, too: but they do not go on.
    """

    def __init__(self) -> None:
        self.advanced()

    def advanced(self) -> None:
        """Something went on from what is believed."""
        self._behind: tuple[int, ...] | None = None
        self._confirmations = 0

    def behind(self, *order: int) -> bool:
        """Whether so many in a row go on behind what is believed that this was wrong.

        Parameters
        ----------
        *order : int
            Instant that grows, or life and instant.
        """
        if self._behind is None or order > self._behind:
            self._behind = order
            self._confirmations += 1
        if self._confirmations < CONFIRMATIONS:
            return False
        self.advanced()
        return True
