"""LiveWindows: stamps, completions and loads of a running cell in, closed windows out.

Everything is put on the stamper's clock (see `offsets`), counted from the first release of the run.
A window is W consecutive cycles by release and closes `close_grace_ms` after the release of the
first cycle beyond them, or D after that of the last of them where this is later. Where the term or
the placement changes before W cycles are there, or while an order is under way, the next window
starts at the first cycle stamped anew; the cycles before it are lead, and belong to no window.

Messages are lost, late, and come twice. A cycle is known by its stamp or by its completion; one of
which neither was heard, between two that are known, is taken to have been released between them.
Nobody knows whether it has completed, nor the one before it: it counts for neither, and its window
is unproven. Numbers that a restarted stamper has left out were never cycles: there,
fewer periods have passed than numbers.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from functools import partial
from itertools import pairwise

import numpy as np

from dwell.control import ClosedWindow, Controller, LookedAt
from dwell.errors import LiveError
from dwell.live.cycle_ledger import Ledger, LiveCycle, told, violation_rate
from dwell.live.loads import ProcessLoads
from dwell.live.messages import Completion, Load, Stamp, Stamped
from dwell.live.offsets import UNBOUNDED_NS, Offsets
from dwell.live.run_rows import LiveWindow, Resume, RunRows, sends_shadows
from dwell.live.symptoms import Symptoms
from dwell.model import Problem
from dwell.model.window_close import window_close_ns

#: A window whose latencies may be off by more than this share of D is marked unproven.
PROVEN_SHARE = 0.2
#: Numbers between two cycles were cycles if they had this share of a period each.
NEAR_PERIOD = (0.75, 1.25)
#: Where the stamper's clock and the controller's disagree by this much on the time since the last
#: stamp, one of them has begun anew.
CLOCK_BREAK_NS = 60_000_000_000
#: Cycles remembered beyond some windows.
KEPT_CYCLES = 1_000


class LiveWindows:
    """Closes the windows of one cell.

    Every window that `close` returns goes to the controller's `propose` or `miss`, one for one;
    what it saw is kept beside the window.

    Parameters
    ----------
    offsets : Offsets
        Its reference is the stamper's node, its node the controller's.

    Attributes
    ----------
    origin_ns : int or None
        First release of the run, on the stamper's clock; None before a stamp was heard.
    ignored : int
        Messages about unknown placements, sinks or nodes, or cycles of long ago.
    """

    def __init__(
        self,
        problem: Problem,
        offsets: Offsets,
        controller: Controller,
        *,
        resume: Resume | None = None,
    ) -> None:
        resume = resume or Resume()
        self.problem, self.offsets, self._controller = problem, offsets, controller
        self.origin_ns = resume.origin_ns
        self.last: LiveWindow | None = None
        self.ignored = 0
        self._ledger = Ledger(problem, offsets)
        self._symptoms = Symptoms(problem, self._ledger)
        self._processes = ProcessLoads()
        self._keeps_jobs = resume.jobs
        self._size = problem.window_cycles
        self._period_ns = problem.pipeline.period_ns
        self._deadline_ns = problem.pipeline.deadline_ns
        self._proven_ns = int(PROVEN_SHARE * self._deadline_ns)
        self._longest = 8 * self._size + KEPT_CYCLES
        #: What is recorded.
        self.record = RunRows(
            *(controller, self._ledger, self._processes),
            resume=resume,
            kept=4 * self._size + KEPT_CYCLES,
        )
        # Cycles that are in no closed window yet, by release; and all that are remembered.
        self._line: list[LiveCycle] = []
        self._by_key: dict[tuple[int, int], LiveCycle] = {}
        self._newest: tuple[LiveCycle, int | None] | None = None
        # The term that a migration leaves, while it is under way.
        self._left: tuple[int, int] | None = None
        # What `_begin` found, as long as nothing has changed that.
        self._beginning: tuple[int, bool] | None = None
        self._lead = 0
        self._next_window = resume.window

    # ------------------------------------------------------------------ what is heard

    def stamped(self, stamp: Stamp, at_ns: int | None = None) -> None:
        """A cycle was released.

        Parameters
        ----------
        at_ns : int, optional
            When this was heard, on the controller's clock.
        """
        cycle = self._note(stamp, at_ns)
        if cycle is not None and cycle.stamped_ns is None:
            cycle.stamped_ns = at_ns
            if isinstance(stamp, Stamped):
                cycle.group_ns = stamp.group_ns

    def completed(self, completion: Completion, at_ns: int | None = None) -> None:
        """A sink has had a cycle's command, or a cycle or its shadow has ended before that.

        Parameters
        ----------
        completion : Completion
            With the outcome ``replaced`` it is a worker's: a newer cycle has taken its place. Its
            `sink` is the task, and its last hop says when that was ready, and nothing more.
        at_ns : int, optional
            When this was heard, on the controller's clock.
        """
        stamp = completion.stamp
        # Of term 0 is a source's own guess: it counts where the stamper has released such a cycle.
        guessed = not stamp.term and stamp.key not in self._by_key
        if guessed or not self._ledger.tells(completion):
            self.ignored += 1
            return
        cycle = self._note(completion.stamp, at_ns)
        if cycle is None or not cycle.take(completion, at_ns):
            return
        if at_ns is not None and completion.sink in cycle.heard_ns:
            self._symptoms.completed(completion, at_ns)
        if self._ledger.complete(cycle):
            self.record.newest_done = max(self.record.newest_done, cycle.key)
        # Before its window closes, rather than all at once then, where the clocks' bound allows.
        self._ledger.settle(cycle, most_ns=None if cycle.row >= 0 else self._proven_ns)
        self.record.touch(cycle)

    def measured(self, run: int, intervals: Iterable[tuple[int, int]]) -> None:
        """The stamper has measured how long cycles took, ns."""
        for number, interval_ns in intervals:
            cycle = self._by_key.get((run, number))
            if cycle is not None:
                cycle.stamper_interval_ns = interval_ns
                self.record.newest_done = max(self.record.newest_done, cycle.key)
                if cycle.row >= 0:
                    self._ledger.settle(cycle)
                    self.record.touch(cycle)

    def loaded(self, load: Load) -> None:
        """A node's agent has read its counters."""
        if load.node in self._ledger.loads:
            self._ledger.loads[load.node].report(load)
            if self._keeps_jobs:
                self._processes.report(load.node, load.at_ns, load.processes)
        else:
            self.ignored += 1

    def spent(self, node: str, at_ns: int, who: str, cpu_ns: int) -> None:
        """Take note of what a process has taken of its node's CPU since it was started."""
        if self._keeps_jobs:
            self._processes.report(node, at_ns, [(who, cpu_ns)])

    def ordered(self, run: int, term: int) -> None:
        """A migration is under way: the next window begins with it, or goes on when `refused`.

        Parameters
        ----------
        run, term : int
            The term that it leaves.
        """
        self._left, self._beginning = (run, term), None

    def refused(self) -> None:
        """The migration will not come about: windows go on where they were."""
        self._left = self._beginning = None

    def forget(self, run: int, cycle: int) -> None:
        """Take a cycle, and those after it, for never released: what told of them was wrong."""
        key = run, cycle
        self._line = [known for known in self._line if known.key < key]
        for known in [known for known in self._by_key if known >= key]:
            del self._by_key[known]
        last = max(self._by_key.values(), key=lambda known: known.key, default=None)
        self._newest = None if last is None else (last, last.stamped_ns)
        self.record.newest_done = min(self.record.newest_done, (run, cycle - 1))
        self._beginning = None

    def set_back(self, back_ns: int) -> None:
        """The controller's clock has been set back: what was heard by it was heard before that."""
        for cycle in self._line:
            cycle.heard_before(back_ns)
        self._symptoms.set_back(back_ns)
        if self._newest is not None:
            newest, heard_ns = self._newest
            self._newest = newest, None if heard_ns is None else heard_ns - back_ns

    def _note(self, stamp: Stamp, at_ns: int | None) -> LiveCycle | None:
        key = stamp.key
        known = self._by_key.get(key)
        if stamp.placement not in self.problem.candidates:
            self.ignored += 1
        elif known is not None:
            if not known.heard:
                self._identify(known, stamp)
        elif self._newest is None or key > self._newest[0].key:
            return self._append(stamp, at_ns)
        elif self._line and key > self._line[0].key:
            return self._insert(stamp)
        else:
            # Before the first one heard, or of long ago.
            self.ignored += 1
        return known

    def _identify(self, cycle: LiveCycle, stamp: Stamp) -> None:
        cycle.identify(stamp)
        if cycle.row < 0:
            self._beginning = None
        self.record.touch(cycle)

    def _append(self, stamp: Stamp, at_ns: int | None) -> LiveCycle:
        if at_ns is not None:
            self._symptoms.begun(at_ns)
        if self.origin_ns is None or (self._newest is None and stamp.released_ns < self.origin_ns):
            # A clock that is behind the run's beginning has begun anew since.
            self.origin_ns = stamp.released_ns
        if self._newest is not None:
            self._follow(*self._newest, stamp, at_ns)
        cycle = LiveCycle.of(stamp, self.origin_ns)
        line = self._line
        if line:
            for other in self._between(line[-1], cycle):
                self._add(other)
        self._add(cycle)
        self._newest = cycle, at_ns
        if len(line) > self._longest:
            # Nobody has said what became of an order.
            self._drop(len(line) - self._size)
        return cycle

    def _add(self, cycle: LiveCycle) -> None:
        if not self._line or cycle.segment != self._line[-1].segment:
            self._beginning = None
        self._line.append(cycle)
        self._by_key[cycle.key] = cycle

    def _follow(
        self, newest: LiveCycle, heard_ns: int | None, stamp: Stamp, at_ns: int | None
    ) -> None:
        """Begin a window anew where the stamper's clock has begun anew, with its node."""
        passed_ns = stamp.released_ns - newest.origin_ns - newest.at_ns
        own_ns = passed_ns if heard_ns is None or at_ns is None else at_ns - heard_ns
        if passed_ns >= 0 and abs(passed_ns - own_ns) < CLOCK_BREAK_NS:
            return
        own_ns = max(own_ns, self._period_ns)
        self.origin_ns = stamp.released_ns - newest.at_ns - own_ns
        self._drop(len(self._line))

    def _between(self, last: LiveCycle, following: LiveCycle) -> Iterable[LiveCycle]:
        """Cycles nobody heard of between two that are known."""
        steps, span_ns = following.number - last.number, following.at_ns - last.at_ns
        least, most = (steps * self._period_ns * share for share in NEAR_PERIOD)
        if last.run != following.run or not 1 < steps <= self._longest:
            return
        if least <= span_ns <= most:
            for step in range(1, steps):
                who = last.run, last.number + step, last.term, last.placement, ""
                at_ns = last.at_ns + span_ns * step // steps
                yield LiveCycle(*who, at_ns, last.origin_ns, heard=False)

    def _insert(self, stamp: Stamp) -> LiveCycle | None:
        """Put a cycle where it belongs, among numbers that seemed to have been left out."""
        line = self._line
        cycle = LiveCycle.of(stamp, line[0].origin_ns)
        place = bisect.bisect(line, cycle.key, key=lambda other: other.key)
        if not line[place - 1].at_ns <= cycle.at_ns <= line[place].at_ns:
            self.ignored += 1
            return None
        line.insert(place, cycle)
        self._by_key[cycle.key] = cycle
        self._beginning = None
        return cycle

    # -------------------------------------------------------------- when a window closes

    def _begin(self) -> tuple[int, bool]:
        """Place in the line where the open window starts, and whether an order is awaited."""
        if self._beginning is None:
            start, segment = 0, self._line[0].segment if self._line else None
            ordered = self._is_left(self._line[0]) if self._line else self._left is not None
            for place, cycle in enumerate(self._line):
                if not cycle.heard or cycle.segment == segment:
                    continue
                if place - start >= self._size and not ordered:
                    break
                start, segment, ordered = place, cycle.segment, self._is_left(cycle)
            self._beginning = start, ordered
        return self._beginning

    def _is_left(self, cycle: LiveCycle) -> bool:
        """Whether a cycle is of a term that a migration leaves, or of one before it."""
        return self._left is not None and (cycle.run, cycle.term) <= self._left

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the next window closes, on the controller's clock; None if that is not known.

        Parameters
        ----------
        now_ns : int
            The clock's time: a cycle that has been heard of has been released.
        """
        start, ordered = self._begin()
        if ordered or len(self._line) <= start + self._size:
            return None
        beyond = self._line[start + self._size]
        if beyond.stamped_ns is None:
            beyond.stamped_ns = now_ns
        released_ns, bound_ns = self.offsets.from_reference(
            self.offsets.node, beyond.at_ns + beyond.origin_ns
        )
        if bound_ns >= UNBOUNDED_NS:
            released_ns = beyond.stamped_ns
        return min(released_ns, beyond.stamped_ns) + self._close_ns(start) - beyond.at_ns

    def _close_ns(self, start: int) -> int:
        """Close of the window that starts at a place in the line, since the origin."""
        last, beyond = self._line[start + self._size - 1 : start + self._size + 1]
        return int(window_close_ns(self.problem, last.at_ns, beyond.at_ns))

    def close(self, *, unix_ns: int | None = None) -> ClosedWindow:
        """Close the window that is due.

        Returns
        -------
        ClosedWindow
            Its instants count from the first release of the run; more is in `last`.

        Raises
        ------
        LiveError
            If none is due: fewer than W + 1 cycles are known, or a migration is under way.
        """
        start, ordered = self._begin()
        if ordered or len(self._line) <= start + self._size:
            raise LiveError("no window is due")
        self._drop(start)
        self._left = None
        cycles = self._line[: self._size]
        close_ns, span_ns = self._close_ns(0), self._line[self._size].at_ns - cycles[0].at_ns
        for cycle, following in pairwise(self._line[: self._size + 1]):
            self._ledger.settle(cycle)
            cycle.window, cycle.close_ns = self._next_window, close_ns
            cycle.deaf = not (cycle.heard and following.heard)
        self._take_off(self._size)
        release_ns = np.array([cycle.at_ns for cycle in cycles], np.int64)
        shadows = sends_shadows(self._controller)
        known = told(cycles)
        closed = ClosedWindow(
            latency_ns=np.array([cycle.latency_ns for cycle in known], np.int64),
            release_ns=np.array([cycle.at_ns for cycle in known], np.int64),
            close_ns=close_ns,
            open_ns=int(release_ns[0]),
            core_ns=self._ledger.core_ns(cycles, close_ns),
            looked=LookedAt(self._next_window, cycles[-1].row, self._size),
            evidence=partial(self._ledger.evidence, cycles, release_ns, close_ns, shadows=shadows),
        )
        bound_ns = max(cycle.bound_ns for cycle in cycles)
        self.last = LiveWindow(
            number=self._next_window,
            cycles=cycles,
            span_ns=span_ns,
            close_ns=close_ns,
            lead=self._lead,
            heard=sum(cycle.heard for cycle in cycles),
            bound_ns=bound_ns,
            unproven=bound_ns > self._proven_ns or any(cycle.untold for cycle in cycles),
            rate_at_close=violation_rate(known, self._deadline_ns),
            used=self._controller.utilisation(closed),
            closed_unix_ns=unix_ns,
        )
        self.record.close(self.last)
        self._symptoms.closed(self.last)
        self._next_window += 1
        self._lead = 0
        return closed

    @property
    def between(self) -> LookedAt:
        """What a move of the guard's looks at: nothing, and the next window begins with it."""
        return LookedAt(self._next_window, self.record.next_row - 1, 0)

    def _drop(self, count: int) -> None:
        """Leave cycles at the line's beginning to no window."""
        for cycle in self._line[:count]:
            self._ledger.settle(cycle)
        self._symptoms.led(self._line[:count])
        self._lead += count
        self._take_off(count)

    def _take_off(self, count: int) -> None:
        """Move cycles from the line to the record, and forget those of long ago."""
        for old in self.record.add(self._line[:count]):
            if self._by_key.get(old.key) is old:
                del self._by_key[old.key]
        del self._line[:count]
        self._beginning = None

    def symptoms(self, now_ns: int) -> dict[str, object]:
        """Return what the cycles say of the cell's health, as plain values (see `Symptoms`)."""
        return self._symptoms.status(list(reversed(self._by_key.values())), now_ns)

    def status(self) -> dict[str, object]:
        """Return how the windows are, as plain values."""
        last = self.last
        status: dict[str, object] = {
            "windows": self._next_window,
            "origin_ns": self.origin_ns,
            "cycles": self.record.next_row + len(self._line),
            "ignored_messages": self.ignored,
            "clock_breaks": self.offsets.breaks,
        }
        if last is not None:
            known = last.bound_ns < UNBOUNDED_NS
            status["bound_ms"] = last.bound_ns / 1e6 if known else None
            status["unproven"] = last.unproven
            status["heard_cycles"] = last.heard
            status["done_cycles"] = sum(self._ledger.complete(c) or c.told for c in last.cycles)
        return status
