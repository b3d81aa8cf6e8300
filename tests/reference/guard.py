"""The guard of the page docs/guard.md, a second time, and slowly.

It shares no code with `dwell.control` and the kernels. It is told of every event, keeps all of
them, and works out from them whether it fires, and where the cell goes.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from dwell.model import Problem

MOST_DOUBLINGS = 5
#: Windows' worth of cycles that have to complete between a return and a relapse.
HEALTHY_WINDOWS = 10
EVIDENCE_NS = 10 * 10**9
NEVER = 2**63


@dataclass(eq=False)
class Stay:
    """A time under one placement, from its first cycle on.

    `by_guard`: the guard moved the cell there. Cycles before `watched` are not waited for, nor
    those before `rest_end` once the placement has carried what is waited for.
    """

    placement: str
    first: int
    by_guard: bool
    watched: int
    rest_end: int = 0
    rested: bool = False


@dataclass(eq=False)
class Wait:
    """What the guard waits for: cycles, or the origins of a chain.

    `released` are those that count; `newest` is the highest that was heard of.
    """

    patience: int
    is_chain: bool = False
    every: int = 1
    released: list[int] = field(default_factory=list)
    newest: int = -1

    def oldest(self, first: int) -> int | None:
        """Return the cycle whose age counts, of those from `first` on."""
        since = max(first, self.newest if self.is_chain else self.newest + 1)
        rest = self.released[bisect_left(self.released, since) :]
        return rest[0] if rest else None


@dataclass(eq=False)
class Through:
    """The cycles and shadows that went through one candidate."""

    released: dict[int, int] = field(default_factory=dict)
    newest: int = -1


class Guard:
    """Whether the cell moves by itself, and where to.

    `waits` has its patience with cycles, max(D, P) + (g - 1) P, then those with chains; `longest`
    is the longest patience.
    """

    def __init__(self, problem: Problem, waits: Sequence[Wait]) -> None:
        settings = problem.controller
        self.cycles, *chains = waits
        self.waits, self.chains = list(waits), chains
        self.longest = max(wait.patience for wait in waits)
        self.fallbacks = settings.fallbacks
        self.probe_cycles = settings.probe_cycles
        self.in_a_row = settings.guard_cycles + 1
        self.stay = Stay(problem.initial, 0, by_guard=False, watched=0)
        self.released: list[int] = []
        # First cycle since its own node was down.
        self.restarted = 0
        self.rests = 0
        # What has been moved to, and what has failed, since the last completed cycle or order.
        self.tried: list[str] = []
        self.failed: list[str] = []
        # Everything that is heard has been tried.
        self.spent = False
        # What carried the cell before an order left it, and the first cycle since that return.
        self.carrier: str | None = None
        self.returned = 0
        self.through = {name: Through() for name in problem.candidates}

    @property
    def on_fallback(self) -> bool:
        """Whether the cell is where the guard has moved it."""
        return self.stay.by_guard

    # ------------------------------------------------------------------------- what it is told of

    def release(self, cycle: int, now: int, active: str, other: str | None, *, due: bool) -> None:
        """Note that a cycle is released; with another placement an order takes effect.

        `due` says whether a sink is due in it.
        """
        if active != self.stay.placement:
            if self.stay.by_guard:
                carried = self.carries
                self.carrier = self.stay.placement if carried else None
                self.returned = cycle
            self.stay = Stay(active, cycle, by_guard=False, watched=cycle)
            self.rests = 0
            self.begin_anew()
        self.released.append(now)
        for chain in self.chains:
            if cycle % chain.every == 0:
                chain.released.append(cycle)
        if due:
            self.cycles.released.append(cycle)
            self.through[active].released[cycle] = now
        if other is not None:
            self.through[other].released[cycle] = now

    def hear(self, cycle: int, chain: int | None = None) -> None:
        """Hear that a cycle has completed, or that a chain has actuated from it."""
        wait = self.cycles if chain is None else self.chains[chain]
        wait.newest = max(wait.newest, cycle)
        if not self.carries:
            return
        self.begin_anew()
        if self.stay.by_guard and not self.stay.rested:
            self.stay.rested = True
            self.rests += 1

    @property
    def carries(self) -> bool:
        """Whether all that is waited for has been heard of since the placement began."""
        return all(wait.newest >= self.stay.first for wait in self.waits)

    def hear_through(self, candidate: str, cycle: int) -> None:
        """Hear that a cycle, or a shadow, has completed through a candidate."""
        through = self.through[candidate]
        through.newest = max(through.newest, cycle)

    def restart(self) -> None:
        """Begin anew on its own node, which is up again."""
        self.restarted = len(self.released)

    def begin_anew(self) -> None:
        """Forget what was tried, as a cycle has completed, or an order takes effect."""
        self.tried, self.failed, self.spent = [], [], False

    @property
    def rest(self) -> int:
        """Length of the next rest."""
        length: int = self.probe_cycles * 2 ** min(self.rests, MOST_DOUBLINGS)
        return length

    # ---------------------------------------------------------------------------- whether it fires

    def fires(self, now: int) -> bool:
        """Whether a cycle or an origin that it waits for is as old as its patience."""
        for wait in self.waits:
            first = max(self.stay.watched, self.restarted)
            if wait.newest >= self.stay.first:
                first = max(first, self.stay.rest_end)
            oldest = wait.oldest(first)
            if oldest is not None and self.released[oldest] + wait.patience <= now:
                return True
        return False

    def failing(self, candidate: str, now: int) -> bool:
        """Whether the last g + 1 cycles or shadows through a candidate have failed."""
        through = self.through[candidate]
        old = [
            at
            for cycle, at in through.released.items()
            if cycle > through.newest and at + self.longest <= now
        ]
        row = old[-self.in_a_row :]
        return len(row) == self.in_a_row and row[0] >= now - EVIDENCE_NS

    def in_order(self) -> list[str]:
        """Return the fallbacks that may be tried, in their order."""
        first = []
        newest = min(wait.newest for wait in self.waits)
        if self.carrier is not None and newest < self.returned + self.probe_cycles:
            first = [self.carrier]
        others = [name for name in self.fallbacks if name not in self.failed]
        order = list(dict.fromkeys([*first, *others, *self.failed]))
        return [name for name in order if name != self.stay.placement and name not in self.tried]

    def look(self, now: int, heard: Callable[[str], bool]) -> str | None:
        """Return the fallback that the cell moves to now, if any."""
        if self.spent and self.fires(now):
            self.tried, self.spent = [], False
        if not self.spent and not self.fires(now):
            return None
        there = [name for name in self.in_order() if heard(name)]
        whole = [name for name in there if not self.failing(name, now)]
        for name in (*whole, *there):
            return name
        if self.tried and not self.spent:
            self.spent = True
            self.stay.watched = len(self.released) + self.rest
            self.stay.rested = True
            self.rests += 1
        return None

    def move(self, fallback: str) -> None:
        """Move the cell: cycles released from now on have the fallback."""
        left = self.stay.placement
        if left in self.fallbacks:
            self.failed = [*(name for name in self.failed if name != left), left]
        self.tried.append(fallback)
        self.carrier = None
        first = len(self.released)
        self.stay = Stay(fallback, first, True, watched=first, rest_end=first + self.rest)
        self.spent = False


class Proof:
    """What a placement has to show before the guard's fallback is left for it."""

    def __init__(self, problem: Problem, patience: int) -> None:
        self.patience = patience
        self.healthy = HEALTHY_WINDOWS * problem.window_cycles
        self.least = problem.controller.probe_cycles
        self.needed = self.least
        self.wanted: str | None = None
        # When probes were released, the newest that was heard of, and how many were since the wish
        # began, or since a silence.
        self.released: dict[int, int] = {}
        self.newest = -1
        self.count = 0
        # Cycles that have completed since the cell has returned; None where it has not.
        self.completed: int | None = None

    def want(self, candidate: str | None) -> None:
        """Begin to prove another candidate, or none."""
        self.wanted, self.released, self.newest, self.count = candidate, {}, -1, 0

    def silent_since(self) -> int:
        """Return when the probe after the newest that was heard of is as old as the patience."""
        later = [at for probe, at in self.released.items() if probe > self.newest]
        return later[0] + self.patience if later else NEVER

    def hear(self, probe: int, now: int) -> None:
        """Hear that a probe has completed."""
        if self.silent_since() < now:
            self.count = 0
        self.newest = max(self.newest, probe)
        self.count += 1

    def proven(self, candidate: str, now: int) -> bool:
        """Whether enough probes have completed without a silence."""
        count = 0 if self.silent_since() <= now else self.count
        return candidate == self.wanted and count >= self.needed

    def returns(self) -> None:
        """Note that the cell leaves the fallback by an order."""
        self.want(None)
        self.completed = 0

    def complete(self) -> None:
        """Hear of a cycle that was released under orders since the return."""
        if self.completed is None:
            return
        self.completed += 1
        if self.completed % self.healthy == 0:
            self.needed = max(self.needed // 2, self.least)

    def relapse(self) -> None:
        """Note that the guard has moved the cell."""
        if self.completed is not None and self.completed < self.healthy:
            self.needed = min(2 * self.needed, self.least * 2**MOST_DOUBLINGS)
        self.completed = None
        self.want(None)
