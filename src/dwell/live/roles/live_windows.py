"""LiveWindows: turns the stamps, completions and loads of a running cell into closed windows.

All instants are on the stamper's clock (see `offsets`), from the first release of the run. A window
is W consecutive cycles. It ends `close_grace_ms` after the release of the next cycle, or D after
its last release if that is later. If the term or the placement changes within a window, or an order
is under way, the window starts again with the first cycle of the new term. The cycles before it are
lead and belong to no window.

If `decide_cycles` is below W, this rule applies to the cycles between two decisions. Windows then
continue over ordered moves. They start again with a move of the guard and after an outage of the
stamper, and the next decision records them. Overdue decisions are missed.

Messages may be lost, late or doubled. A stamp or a completion makes a cycle known. An unknown cycle
between two known cycles counts as released between them. Completions of this cycle and of the cycle
before it may be lost; without a report neither counts, and the window is unproven. Numbers that a
restarted stamper has skipped were never cycles: too little time has passed for them. Cycles in
which no sink is due count in windows, but not in their metrics.
"""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from dwell.control import ClosedWindow, Controller, LookedAt
from dwell.errors import LiveError
from dwell.live.roles.core_times import CoreTimes
from dwell.live.roles.cycle_ledger import Ledger, LiveCycle, told, violation_rate
from dwell.live.roles.data_ages import KnownOrigins
from dwell.live.roles.live_evidence import LiveEvidence
from dwell.live.roles.loads import ProcessLoads
from dwell.live.roles.offsets import UNBOUNDED_NS, Offsets
from dwell.live.roles.run_rows import LiveWindow, Resume, RunRows, sends_shadows
from dwell.live.roles.stage_counts import StageTable
from dwell.live.roles.symptoms import Symptoms
from dwell.live.wire.messages import Completion, Load, Stamp, Stamped
from dwell.model import Problem
from dwell.model.instants import NEVER_NS
from dwell.model.window_close import window_close_ns

#: Largest error bound of latencies in a proven window, as a share of D.
PROVEN_SHARE = 0.2
#: Time per number, in periods, at which unknown numbers between two cycles count as cycles.
NEAR_PERIOD = (0.75, 1.25)
#: Disagreement of the stamper's clock with the controller's about the time since the last stamp,
#: from which on one of them must have restarted.
CLOCK_BREAK_NS = 60_000_000_000
#: Number of cycles kept in addition to some windows.
KEPT_CYCLES = 1_000


@dataclass(slots=True)
class _Stretch:
    """Consecutive cycles of the line: the next window, or the evidence of the next decision.

    `at` is the place in the line of the first cycle after the previous stretch. `begun` caches the
    place at which the stretch starts, and whether it waits for an order.
    """

    size: int
    at: int = 0
    begun: tuple[int, bool] | None = None


class LiveWindows:
    """Closes the windows of one cell.

    After each `close`, the controller's `propose` or `miss` must be called once.

    Parameters
    ----------
    offsets : Offsets
        Its reference is the stamper's node, its node the controller's.

    Attributes
    ----------
    origin_ns : int or None
        First release of the run, on the stamper's clock; None before the first stamp.
    last, looked : LiveWindow or None
        The last window, and the cycles that the last decision looked at. They are the same if
        the cell decides once per window.
    heard : int
        Number of known cycles since the previous decision.
    ignored : int
        Number of messages about unknown placements, sinks or nodes, or about old cycles.
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
        self.looked: LiveWindow | None = None
        self.heard = self.ignored = 0
        self._ledger = Ledger(problem, offsets)
        self._evidence = LiveEvidence(problem, self._ledger)
        self._cores = CoreTimes(problem, self._ledger)
        self._symptoms = Symptoms(problem, self._ledger)
        self._processes = ProcessLoads()
        self._stages = StageTable(problem)
        self._keeps_jobs = resume.jobs
        self._size = problem.window_cycles
        self._period_ns = problem.pipeline.period_ns
        self._deadline_ns = problem.pipeline.deadline_ns
        self._proven_ns = int(PROVEN_SHARE * self._deadline_ns)
        self._longest = 8 * self._size + KEPT_CYCLES
        self._by_key: dict[tuple[int, int], LiveCycle] = {}
        #: Rows to record.
        self.record = RunRows(
            *(controller, self._ledger, self._processes),
            resume=resume,
            kept=4 * self._size + KEPT_CYCLES,
            known=self._by_key,
        )
        #: Whether decisions are more frequent than windows.
        self.often = problem.decides_within_windows
        self._window = _Stretch(self._size)
        self._stretch = _Stretch(problem.decide_cycles) if self.often else self._window
        # In order of release: decided cycles that the next decision may look at, then cycles that
        # no closed window contains. `_by_key` has all cycles that are kept.
        self._line: list[LiveCycle] = []
        self._newest: tuple[LiveCycle, int | None] | None = None
        # Run and term that the migration under way will end.
        self._left: tuple[int, int] | None = None
        # The term of the guard's last move, and the term that the controller knows.
        self._fell = self._entered = (0, 0)
        self._lead, self._led = 0, deque[LiveCycle](maxlen=KEPT_CYCLES)
        self._next_window = resume.window

    # ------------------------------------------------------------------------ messages

    def stamped(self, stamp: Stamp, at_ns: int | None = None) -> None:
        """Add a released cycle; its stamp arrived at `at_ns` on the controller's clock."""
        cycle = self._note(stamp, at_ns)
        if cycle is not None and cycle.stamped_ns is None:
            cycle.stamped_ns = at_ns
            if isinstance(stamp, Stamped):
                cycle.group_ns = stamp.group_ns

    def completed(self, completion: Completion, at_ns: int | None = None) -> None:
        """Add a report: a cycle's command reached a sink, or a job ended before a sink.

        With the outcome ``replaced`` the report is from a worker: a newer cycle has replaced its
        job. `sink` is then the worker's task, and the last hop has only its time of arrival. The
        report arrived at `at_ns` on the controller's clock.
        """
        stamp = completion.stamp
        # Term 0 is a source's guess; it counts if the stamper has released such a cycle.
        guessed = not stamp.term and stamp.key not in self._by_key
        if guessed or not self._ledger.tells(completion):
            self.ignored += 1
            return
        cycle = self._note(completion.stamp, at_ns)
        silences = 0 if cycle is None else cycle.silences
        if cycle is None or not cycle.take(completion, at_ns):
            return
        if at_ns is not None and cycle.reports.get(completion.sink) is completion:
            self._symptoms.completed(completion, at_ns)
        self._symptoms.silenced(cycle.silences - silences)
        if self._ledger.complete(cycle):
            self.record.newest_done = max(self.record.newest_done, cycle.key)
        # Settle cycles one by one, not all at the end of the window, if the error bound permits.
        settled = cycle.row >= 0 or cycle.told
        self._ledger.settle(cycle, most_ns=None if settled else self._proven_ns)
        self.record.touch(cycle)

    def measured(self, run: int, intervals: Iterable[tuple[int, int, int]]) -> None:
        """Add the intervals, ns, and silences of cycles that the stamper has measured."""
        for number, interval_ns, silences in intervals:
            cycle = self._by_key.get((run, number))
            if cycle is not None:
                known = cycle.silences
                cycle.stamper_interval_ns, cycle.stamper_silences = interval_ns, silences
                self._symptoms.silenced(cycle.silences - known)
                self.record.newest_done = max(self.record.newest_done, cycle.key)
                if cycle.row >= 0:
                    self._ledger.settle(cycle)
                    self.record.touch(cycle)

    def loaded(self, load: Load, at_ns: int = 0) -> None:
        """Add an agent's report of its node, which arrived at `at_ns` on the controller's clock."""
        if load.node in self._cores.loads:
            if self._newest is not None:
                self._stages.take(load, self._newest[0].key, at_ns)
            self._cores.loads[load.node].report(load)
            if self._keeps_jobs:
                self._processes.report(load.node, load.at_ns, load.processes)
        else:
            self.ignored += 1

    def spent(self, node: str, at_ns: int, who: str, cpu_ns: int) -> None:
        """Record the CPU time that a process has used since its start."""
        if self._keeps_jobs:
            self._processes.report(node, at_ns, [(who, cpu_ns)])

    def ordered(self, run: int, term: int) -> None:
        """Record a migration that will end a term; the next window begins with the new term.

        If `refused` is called, the window continues.
        """
        self._left = run, term
        self._begin_again()

    def refused(self) -> None:
        """Continue the window, because the migration was refused or given up."""
        self._left = None
        self._begin_again()

    def fell(self, run: int, term: int) -> LookedAt:
        """Begin the next window with a move of the guard, which began a term; see `before`."""
        self._fell = run, term
        self._begin_again()
        return self.before(run, term)

    def before(self, run: int, term: int) -> LookedAt:
        """Return the window that follows a move, and the last cycle before it, in the record."""
        line = self._line[self._window.at :]
        count = sum((one.run, one.term) < (run, term) for one in line)
        return LookedAt(self._next_window, self.record.next_row + count - 1, 0)

    def forget(self, run: int, cycle: int) -> None:
        """Remove a cycle and all later cycles: a wrong message reported their release."""
        key = run, cycle
        self._line = [known for known in self._line if known.key < key]
        for known in [known for known in self._by_key if known >= key]:
            del self._by_key[known]
        last = max(self._by_key.values(), key=lambda known: known.key, default=None)
        # The wrong stamp may have moved the origin; only later stamps show this.
        heard_ns = (one.stamped_ns for one in self._by_key.values() if one.stamped_ns is not None)
        self._newest = None if last is None else (last, max(heard_ns, default=None))
        if last is not None:
            self.origin_ns = last.origin_ns
        self.record.newest_done = min(self.record.newest_done, (run, cycle - 1))
        for one in (self._window, self._stretch):
            one.at = min(one.at, len(self._line))
        self._begin_again()

    def set_back(self, back_ns: int) -> None:
        """Shift the times of arrival after the controller's clock was set back."""
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
        elif (line := self._line[max(self._window.at, self._stretch.at) :]) and key > line[0].key:
            return self._insert(stamp)
        else:
            # The cycle is before the first known cycle, or too old.
            self.ignored += 1
        return known

    def _identify(self, cycle: LiveCycle, stamp: Stamp) -> None:
        cycle.identify(stamp)
        if cycle.row < 0:
            line = self._line
            place = bisect.bisect_left(line, cycle.key, key=lambda other: other.key)
            # Releases increase with the cycles' numbers; keep a damaged stamp between them.
            around = [other.at_ns for other in line[max(place - 1, 0) : place + 2]]
            cycle.at_ns = sorted((around[0], cycle.at_ns, around[-1]))[1]
            self._begin_again()
        self.record.touch(cycle)

    def _append(self, stamp: Stamp, at_ns: int | None) -> LiveCycle:
        if at_ns is not None:
            self._symptoms.begun(at_ns)
        if self.origin_ns is None or (self._newest is None and stamp.released_ns < self.origin_ns):
            # The stamper's clock is behind the origin of the run, so it has restarted.
            self.origin_ns = stamp.released_ns
        if self._newest is not None:
            self._follow(*self._newest, stamp, at_ns)
        cycle = self._ledger.cycle_of(stamp, self.origin_ns)
        line = self._line
        if line:
            for other in self._between(line[-1], cycle):
                self._add(other)
        self._add(cycle)
        self._newest = cycle, at_ns
        if len(line) > self._longest:
            # An order has remained without an answer for too long.
            self._leave(len(line) - self._size)
        return cycle

    def _add(self, cycle: LiveCycle) -> None:
        line = self._line
        if not line or cycle.segment != line[-1].segment or cycle.number > line[-1].number + 1:
            self._begin_again()
        line.append(cycle)
        self._by_key[cycle.key] = cycle

    def _follow(
        self, newest: LiveCycle, heard_ns: int | None, stamp: Stamp, at_ns: int | None
    ) -> None:
        """Shift the origin and begin a new window if the stamper's clock has restarted."""
        passed_ns = stamp.released_ns - newest.origin_ns - newest.at_ns
        own_ns = passed_ns if heard_ns is None or at_ns is None else at_ns - heard_ns
        if passed_ns >= 0 and abs(passed_ns - own_ns) < CLOCK_BREAK_NS:
            return
        own_ns = max(own_ns, self._period_ns)
        self.origin_ns = stamp.released_ns - newest.at_ns - own_ns
        self._leave(len(self._line))

    def _between(self, last: LiveCycle, following: LiveCycle) -> Iterable[LiveCycle]:
        """Yield the unknown cycles between two known cycles."""
        steps, span_ns = following.number - last.number, following.at_ns - last.at_ns
        least, most = (steps * self._period_ns * share for share in NEAR_PERIOD)
        if last.run != following.run or not 1 < steps <= self._longest:
            return
        if least <= span_ns <= most:
            for step in range(1, steps):
                released_ns = last.origin_ns + last.at_ns + span_ns * step // steps
                stamp = Stamp(last.run, last.number + step, last.term, last.placement, released_ns)
                yield self._ledger.cycle_of(stamp, last.origin_ns, heard=False)

    def _insert(self, stamp: Stamp) -> LiveCycle | None:
        """Insert a cycle whose number seemed to have been skipped, if its release fits."""
        line = self._line
        cycle = self._ledger.cycle_of(stamp, line[-1].origin_ns)
        place = bisect.bisect(line, cycle.key, key=lambda other: other.key)
        if not line[place - 1].at_ns <= cycle.at_ns <= line[place].at_ns:
            self.ignored += 1
            return None
        line.insert(place, cycle)
        self._by_key[cycle.key] = cycle
        self._begin_again()
        return cycle

    # --------------------------------------------------------------- ends of windows

    def _begin_again(self) -> None:
        """Clear the cached starts of window and stretch."""
        self._window.begun = self._stretch.begun = None

    def _begin(self, one: _Stretch) -> tuple[int, bool]:
        """Return the place in the line at which a stretch starts, and whether an order is open."""
        course = self._controller.course
        if self._entered != (course.run, course.term):
            self._entered = course.run, course.term
            self._begin_again()
        line, start = self._line, one.at
        if one.begun is None and start < len(line):
            ordered = self._waits(one, line[start])
            for place in range(start + 1, len(line)):
                if not line[place].heard or not self._is_begun(one, line[start], place):
                    continue
                if place - start >= one.size and not ordered:
                    break
                start, ordered = place, self._waits(one, line[place])
            one.begun = start, ordered
        return one.begun or (start, True)

    def _is_begun(self, one: _Stretch, first: LiveCycle, place: int) -> bool:
        """Whether a stretch that began with `first` must begin again at a place in the line."""
        before, cycle = self._line[place - 1 : place + 1]
        if self.often and (cycle.run != before.run or cycle.number > before.number + 1):
            # The stamper was down.
            return True
        if self.often and one is self._window:
            return (first.run, first.term) < self._fell <= (cycle.run, cycle.term)
        return cycle.segment != first.segment

    def _waits(self, one: _Stretch, cycle: LiveCycle) -> bool:
        """Whether a cycle is in a term that a migration will end, or in an earlier term.

        If decisions are more frequent than windows, cycles in a term that the controller does not
        know wait too.
        """
        term = cycle.run, cycle.term
        if self.often and (one is self._window or term != self._entered):
            return one is not self._window
        return self._left is not None and term <= self._left

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the next decision is due, on the controller's clock; None if unknown."""
        end = self._end()
        if end is None:
            return None
        beyond = self._line[end]
        if beyond.stamped_ns is None:
            beyond.stamped_ns = now_ns
        released_ns, bound_ns = self.offsets.from_reference(
            self.offsets.node, beyond.at_ns + beyond.origin_ns
        )
        if bound_ns >= UNBOUNDED_NS:
            released_ns = beyond.stamped_ns
        return min(released_ns, beyond.stamped_ns) + self._close_ns(end) - beyond.at_ns

    def _end(self) -> int | None:
        """Place in the line of the first cycle after the next decision's cycles."""
        start, ordered = self._begin(self._stretch)
        end = start + self._stretch.size
        return None if ordered or len(self._line) <= end else end

    def _close_ns(self, end: int) -> int:
        """Return the end, since the origin, of the window before a place in the line."""
        last, beyond = self._line[end - 1 : end + 1]
        return int(window_close_ns(self.problem, last.at_ns, beyond.at_ns))

    def close(self, *, unix_ns: int | None = None) -> ClosedWindow:
        """Close the windows that have ended, and return the cycles of the decision.

        Instants count from the first release of the run; `looked` has more about the cycles.
        Raises a LiveError if no decision is due: fewer than `decide_cycles` + 1 cycles are known,
        or a migration is under way.
        """
        end = self._end()
        if end is None:
            raise LiveError("no window is due")
        self._left = None
        begin, oldest = end - self._stretch.size, self._line[0]
        self.heard = sum(cycle.heard for cycle in self._line[begin:end])
        while (first := self._begin(self._window)[0]) + self._size <= end:
            self.looked, closed = self._close_window(first, unix_ns)
        if self.often:
            self.looked, closed = self._look(begin, end)
        self._cores.forget(oldest)
        self._stretch.at = end
        self._forget_line(min(self._window.at, max(end - (self._size if self.often else 0), 0)))
        return closed

    def _close_window(self, start: int, unix_ns: int | None) -> tuple[LiveWindow, ClosedWindow]:
        """Close the window that starts at a place in the line, and record it."""
        self._drop(start)
        end = start + self._size
        closed, cycles = self._closed(start, end), self._line[start:end]
        for cycle in cycles:
            cycle.window, cycle.close_ns = self._next_window, closed.close_ns
        self.last = last = self._seen(cycles, closed, self._line[end].at_ns, unix_ns)
        if self.often and 2 * last.heard >= self._size:
            # The cycle before the window shows whether a move takes effect with its first cycle.
            names = [cycle.placement for cycle in self._line[max(start - 1, 0) : end]]
            last.seen = self._controller.seen(closed, names)
        self._take_off(end)
        self.record.close(last)
        self._symptoms.closed(last)
        self._next_window += 1
        self._lead = 0
        self._led.clear()
        return last, closed

    def _look(self, begin: int, end: int) -> tuple[LiveWindow, ClosedWindow]:
        """Return the last W cycles under the placement in force, with the stretch in them."""
        first, line = begin, self._line
        while first > max(end - self._size, 0) and not self._is_begun(
            self._stretch, line[first - 1], first
        ):
            first -= 1
        closed = self._closed(first, end)
        closed.recent = self._closed(begin, end)
        looked = self._seen(line[first:end], closed, line[end].at_ns)
        looked.known_origins = self._known_before(first)
        return looked, closed

    def _known_before(self, place: int) -> Mapping[str, KnownOrigins]:
        """Return the origins of the actuations before a place in the line."""
        record, window = self.record, self.record.window_of(self._line[place])
        if window is None:
            return record.ages.after(self._line[self._window.at : place], record.ages.known)
        earlier = window.cycles[: window.cycles.index(self._line[place])]
        return record.ages.after(earlier, window.known_origins)

    def _closed(self, begin: int, end: int) -> ClosedWindow:
        """Return the cycles between two places in the line as input of policies and estimators."""
        cycles, close_ns = self._line[begin:end], self._close_ns(end)
        for cycle, following in pairwise(self._line[max(begin, self._window.at) : end + 1]):
            self._ledger.settle(cycle)
            cycle.deaf = not (cycle.heard and following.heard)
        window = self._next_window if cycles[-1].window is None else cycles[-1].window
        row = self.record.next_row + end - 1 - self._window.at
        release_ns = np.array([cycle.at_ns for cycle in cycles], np.int64)
        shadows, earlier = sends_shadows(self._controller), self._earlier(cycles[0])
        of_cycles = partial(self._evidence.known, cycles, release_ns, close_ns)
        known, ages = told(cycles), self.record.ages
        # Cycles of closed windows are judged by the end of their window.
        ages.judge(self._line[self._window.at : end], close_ns, ages.known)
        ages_ns, age_ms = ages.seen(self._recent(cycles), cycles, close_ns)
        return ClosedWindow(
            latency_ns=np.array([cycle.latency_ns for cycle in known], np.int64),
            release_ns=np.array([cycle.at_ns for cycle in known], np.int64),
            close_ns=close_ns,
            open_ns=int(release_ns[0]),
            core_ns=self._cores.core_ns(cycles, close_ns),
            looked=LookedAt(window, row, end - begin),
            evidence=partial(of_cycles, shadows=shadows, earlier=earlier),
            over_age=np.array([cycle.over_age for cycle in known], np.bool_),
            ages_ns=ages_ns,
            age_ms=age_ms,
        )

    def _earlier(self, first: LiveCycle) -> list[LiveCycle]:
        """Return the known cycles before a stretch that its evidence has (see `Evidence`)."""
        count = self.problem.earlier_cycles
        numbers = range(first.number - count, first.number + 1) if count else ()
        known = [self._by_key.get((first.run, number)) for number in numbers]
        cycles = [cycle for cycle in known if cycle is not None]
        for cycle, following in pairwise(cycles):
            if cycle.row < 0:
                cycle.deaf = not cycle.heard or not following.heard
        return cycles[:-1]

    def _recent(self, cycles: list[LiveCycle]) -> list[LiveCycle]:
        """Return the cycles whose commands may count in the ages of some cycles, by number."""
        reach_ns = self.record.ages.reach_ns
        if not reach_ns:
            return cycles
        since_ns = cycles[0].at_ns - reach_ns
        recent = (cycle for cycle in self._by_key.values() if cycle.at_ns >= since_ns)
        return sorted(recent, key=lambda cycle: cycle.key)

    def _seen(
        self,
        cycles: list[LiveCycle],
        closed: ClosedWindow,
        beyond_ns: int,
        unix_ns: int | None = None,
    ) -> LiveWindow:
        """Return cycles in the form of the record and the status."""
        bound_ns = max(cycle.bound_ns for cycle in cycles)
        return LiveWindow(
            number=closed.looked.window,
            cycles=cycles,
            span_ns=beyond_ns - cycles[0].at_ns,
            close_ns=closed.close_ns,
            lead=self._lead,
            led=tuple(self._led),
            heard=sum(cycle.heard for cycle in cycles),
            bound_ns=bound_ns,
            unproven=bound_ns > self._proven_ns or any(cycle.untold for cycle in cycles),
            rate_at_close=violation_rate(told(cycles), self._deadline_ns),
            used=self._controller.utilisation(closed),
            closed_unix_ns=unix_ns,
            age_ms=closed.age_ms,
        )

    def finish(self) -> None:
        """Record the decided cycles that belong to no window."""
        self._drop(self._stretch.at)

    def _leave(self, end: int) -> None:
        """Exclude the cycles before a place in the line from windows and decisions."""
        self._drop(end)
        self._stretch.at = max(self._stretch.at, end)
        self._forget_line(end)

    def _drop(self, end: int) -> None:
        """Record the cycles before a place in the line as lead."""
        lead = self._line[self._window.at : end]
        for cycle in lead:
            self._ledger.settle(cycle)
        self._symptoms.led(lead)
        if lead:
            ages = self.record.ages
            ages.judge(lead, NEVER_NS, ages.known)
            ages.closed(lead)
        self._lead += len(lead)
        self._led += lead
        self._take_off(end)

    def _take_off(self, end: int) -> None:
        """Record the cycles before a place in the line, and forget the oldest cycles."""
        cycles = self._line[self._window.at : end]
        for old in self.record.add(cycles):
            if self._by_key.get(old.key) is old:
                del self._by_key[old.key]
        self._window.at = max(end, self._window.at)
        self._begin_again()

    def _forget_line(self, count: int) -> None:
        """Drop the first cycles of the line; no decision needs them."""
        del self._line[:count]
        self._window.at -= count
        if self.often:
            self._stretch.at -= count
        self._begin_again()

    def symptoms(self, now_ns: int) -> dict[str, object]:
        """Return symptoms of the cell's cycles and counts of its stages, as plain values."""
        found = self._symptoms.status(list(reversed(self._by_key.values())), now_ns)
        if self._newest is None:
            return {**found, "stages": {}, "flows": {}, "slow": [], "counted_cycles": None}
        newest = self._newest[0]
        slow = self._stages.slow(self.problem.candidates[newest.placement], newest.key)
        recent = found["recent"]
        if (ways := recent["unreached"]) is not None:
            source, target = ways[0], ways[1].partition("@")[0]
            if self._stages.withholds(source, target, newest.key):
                recent["unreached"] = None
        stages = self._stages.status(newest.key, now_ns, partial(self._span_ns, newest.run))
        return {**found, **stages, "slow": list(slow)}

    def _span_ns(self, run: int, begin: int, end: int) -> int:
        """Time between the releases of two cycles; a multiple of P if a cycle is not known."""
        first, last = (self._by_key.get((run, number)) for number in (begin, end))
        if first is None or last is None or last.at_ns <= first.at_ns:
            return (end - begin) * self._period_ns
        return last.at_ns - first.at_ns

    def status(self) -> dict[str, object]:
        """Return the counts and the last window for the status, as plain values."""
        last = self.last
        status: dict[str, object] = {
            "windows": self._next_window,
            "origin_ns": self.origin_ns,
            "cycles": self.record.next_row + len(self._line) - self._window.at,
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
