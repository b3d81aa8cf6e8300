"""Stamper: releases the cycles of a cell with their placements, and runs the guard."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from msgspec.structs import asdict

from dwell.control import CellGuard
from dwell.errors import LiveError
from dwell.live.roles.control_group import UNKNOWN
from dwell.live.roles.latencies import Intervals
from dwell.live.roles.origins import last_job, origin_of
from dwell.live.roles.role import BeatState, Pulse, RolePlace
from dwell.live.wire import channels
from dwell.live.wire.continuity import CLAIMS, RESERVED, RunClaims, SetbackDetector
from dwell.live.wire.keys import CONTROLLER
from dwell.live.wire.messages import (
    ACTUATED,
    HANDED_OVER,
    OTHER,
    Accepted,
    Beat,
    Completion,
    Count,
    Header,
    Order,
    Stamp,
    Stamped,
    encode,
)
from dwell.live.wire.routing import STAMPER, Destination, Routes
from dwell.live.wire.transport import Arrival
from dwell.model.instants import NEVER_NS
from dwell.model.shadow_plan import alternatives, shadow_stamps

#: Time without orders after which another controller may take over.
LEASE_NS = 1_000_000_000
#: Time that a new run waits for its placement; then it may start on a complete fallback.
START_NS = 10_000_000_000
#: Largest number of cycles that only some sinks have completed.
MAX_PARTIAL = 1_024


@dataclass(frozen=True, slots=True)
class StamperState:
    """State of the stamper that outlives its process.

    All stamped cycles have numbers below `reserved`. `boot` is the id of the kernel's boot in
    which the state was written: after a loss of power the disk may have an old state.
    """

    run: Count
    reserved: Count
    term: Count
    placement: str
    on_fallback: bool
    boot: str = ""


class Book(Protocol):
    """Stores the `StamperState` of a cell."""

    def read(self) -> StamperState | None:
        """Return the stored state, or None."""
        ...

    def write(self, entry: StamperState) -> None:
        """Store the state; called before any cycle uses it."""
        ...


class Stamper:
    """Owns run, term and placement of a cell.

    `run` is the time of day, the number of a new run unless a later run is known. `boot` is the id
    of the kernel's current boot.
    """

    def __init__(self, place: RolePlace, book: Book, run: int, now_ns: int, boot: str = "") -> None:
        self.place, self._book, self._boot = place, book, boot
        problem = place.problem
        entry = book.read()
        # Without a saved state from this boot, other processes may know a later run.
        self._unsure = entry is None or entry.boot != boot
        self._claims = RunClaims(CLAIMS if place.seals is None else 1)
        if entry is None or entry.placement not in problem.candidates:
            later = run if entry is None else max(run, entry.run + 1)
            entry = StamperState(later, 0, 1, problem.initial, False)
        elif self._unsure:
            placed = entry.placement, entry.on_fallback
            entry = StamperState(max(run, entry.run + 1), 0, 1, *placed)
        self.cycle = entry.reserved
        self._reserved = entry.reserved
        self.routes = Routes(problem)
        self.guard = CellGuard(problem, entry.placement)
        if entry.on_fallback:
            self.guard.adopt(entry.placement, fallback=True)
        #: Run, term and placement of the cell.
        self.course = self.guard.course
        self.course.enter(entry.run, entry.term)
        self.pulse = Pulse(place, lambda: (True, ""), self._holds, hears=[("*", "*")], nodes=["*"])
        self._agents = [f"agent@{node}" for node in problem.fabric.nodes]
        self._asked_ns = -NEVER_NS
        self.timer = problem.live.release == "timer"
        self._next_ns = now_ns + place.period_ns
        self._framed_ns = now_ns - place.period_ns
        self._setback = SetbackDetector()
        # A continued run releases cycles at once; a new run waits for the workers of its placement.
        self._begun, self._since_ns = entry.reserved > 0, now_ns
        # Sources on other nodes get their stamps one cycle early.
        self._early = any(one.node != place.node for one in self._sources())
        self._ahead: Stamp | None = None
        self._names = tuple(problem.candidates)
        self._alternatives = alternatives(problem.candidates)
        self._due = self.routes.due
        self.intervals = Intervals(place.node, self._due.sinks)
        # Tasks that have reported cycles, and shadows, of which others have not.
        self._partial: dict[int, set[str]] = {}
        self._partial_shadows: dict[int, set[str]] = {}
        self._open = problem.pipeline.open_cycles
        self.shadow_fraction = 0.0
        self.forks: tuple[tuple[str, str], ...] = ()
        self._charge = ""
        self._charged_ns = 0
        self._answered: tuple[str, int, Accepted] | None = None
        #: Highest number of an accepted order; a new controller's numbers are higher, because they
        #: begin with the time of day.
        self.newest_order = 0
        #: CPU time that this process's control group has used, if the kernel counts it.
        self.group_clock: Callable[[], int] = lambda: UNKNOWN
        self.moves: list[tuple[int, str, str]] = []
        # Placement before the first of these moves.
        self._first = entry.placement

    @property
    def run(self) -> int:
        """Current run."""
        return self.course.run

    @property
    def term(self) -> int:
        """Current term."""
        return self.course.term

    @property
    def placement(self) -> str:
        """Current candidate."""
        return self.course.placement

    # ---------------------------------------------------------------------- receiving

    def subscriptions(self) -> Iterable[str]:
        """Key expressions to subscribe to."""
        yield from self.pulse.subscriptions()
        yield from self.place.channels_to("stamper")

    def receive(self, sample: Arrival, now_ns: int) -> None:
        """Process a message."""
        channel = self.place.channel(sample)
        if channel is channels.CARRIED and self.place.keys.came_directly(sample.key):
            for arrival in self.place.around(sample):
                self.receive(arrival, now_ns)
            return
        if self.pulse.hears(sample):
            for beat in self.pulse.receive(sample, now_ns):
                self._heard(*beat)
            return
        try:
            match channel:
                case channels.ORDER:
                    self._order(self.place.read(channels.ORDER, sample), now_ns)
                case channels.FRAME:
                    self._frame(now_ns)
                case channels.DONE | channels.ENDED:
                    done = self.place.completion(sample)
                    self._completed(done, now_ns)
                    applied = channel is channels.DONE and done.outcome == ACTUATED
                    if applied and done.stamp.run == self.run:
                        direct = self.place.keys.came_directly(sample.key)
                        self.intervals.completed(done, now_ns, newest=self.cycle, direct=direct)
        except LiveError as error:
            self.place.complain(error)

    def _frame(self, now_ns: int) -> None:
        """Release a cycle, because the source has a frame; skip more than two frames per period."""
        if self.timer or not self._begun:
            return
        if now_ns - self._framed_ns < self.place.period_ns // 2:
            return
        self._framed_ns = now_ns
        self._release(now_ns, now_ns)

    def _heard(self, beat: Beat, now_ns: int, direct: bool) -> None:
        """Process a beat that arrived at `now_ns`."""
        presence = self.guard.presence
        presence.heard(beat.node, now_ns)
        if direct:
            presence.heard(f"{beat.node}->{self.place.node}", now_ns)
            self.intervals.hear(beat, now_ns)
        if beat.who.startswith("sink."):
            self._claimed(beat.who, beat.run)
        for heard in beat.heard:
            age_ns = max(beat.sent_ns - heard.at_ns, 0)
            presence.heard(f"{heard.node}->{beat.node}", now_ns - age_ns)
        worker, _, extra = beat.who.partition(".")
        if beat.moving and self.forks and beat.who in self._workers():
            # The worker is saving its state for a migration, so its cycles wait.
            self.guard.restart()
        if extra in ("", "1") and "@" in worker:
            if beat.ready:
                presence.heard(worker, now_ns)
            elif not extra:
                presence.gone(worker)

    def _claimed(self, who: str, run: int) -> None:
        """Without a saved state from this boot, begin a later run than another process claims."""
        if not self._unsure or not self._claims.believed(who, run) or run <= self.run:
            return
        self._ahead, self._answered = None, None
        self._forget_reports()
        # Cycles of the previous run never complete: processes downstream know a later run.
        self.guard.restart()
        self.guard.failures.restart()
        self.course.enter(run + 1, self.term + 1)
        self._write()

    def _completed(self, done: Completion, now_ns: int) -> None:
        stamp = done.stamp
        if stamp.run != self.run:
            return
        if done.outcome == "shadow":
            ends = self.routes.shadow_ends(stamp)
            if _reported_by_all(self._partial_shadows, done, ends):
                self.guard.shadow_arrived(stamp.cycle, now_ns, stamp.shadow)
            return
        self._acted(done)
        # A command that the actuator refused counts: the placement has delivered it.
        if done.outcome not in HANDED_OVER or stamp.cycle <= self.guard.newest - self._open:
            return
        if _reported_by_all(self._partial, done, self._due.sinks(stamp.cycle)):
            self._complete(stamp, now_ns)

    def _acted(self, done: Completion) -> None:
        """Report the actuations of guarded chains, with their origins, to the guard."""
        for name in self.guard.chains:
            chain = self.place.problem.pipeline.chains[name]
            is_sink = chain.target in self.place.problem.pipeline.sinks
            if is_sink and (done.sink != chain.target or done.outcome not in HANDED_OVER):
                continue
            origin = origin_of(last_job(done, chain.target), chain.source)
            if origin is not None:
                self.guard.acted(name, origin.cycle, self._placed(origin.cycle))

    def _placed(self, cycle: int) -> str:
        """Return the placement of a stamped cycle."""
        place = bisect.bisect(self.moves, cycle, key=lambda move: move[0])
        return self.moves[place - 1][1] if place else self._first

    def _forget_reports(self) -> None:
        """Forget the reports of cycles and shadows that have not completed."""
        self._partial.clear()
        self._partial_shadows.clear()

    def _complete(self, stamp: Stamp, now_ns: int) -> None:
        """Record a cycle whose commands have reached all sinks."""
        if stamp.placement in self._names:
            self.guard.arrived(stamp.cycle, now_ns, stamp.placement)
        if stamp.placement == self.placement:
            self.guard.probation.healthy()

    # ------------------------------------------------------------------------- orders

    def _order(self, order: Order, now_ns: int) -> None:
        """Answer an order; a copy of the last order gets the same answer."""
        self._claimed(CONTROLLER, order.run)
        answered = self._answered
        if answered is not None and answered[:2] == (order.controller, order.number):
            answer = answered[2]
        else:
            refused = self._refusal(order, now_ns)
            if not refused:
                self._accept(order)
            answer = self._answer(order, refused, now_ns)
            self._answered = order.controller, order.number, answer
        self.place.send(channels.ACCEPTED, answer)

    @property
    def _next(self) -> int:
        """The next cycle without a stamp; a stamp sent early to other nodes counts."""
        return self.cycle + (self._ahead is not None)

    def _answer(self, order: Order, refused: str, now_ns: int) -> Accepted:
        probation = self.guard.probation
        probed = (probation.wanted if self.course.by_guard else None) or ""
        return Accepted(
            order.number,
            order.controller,
            refused,
            self.run,
            self.term,
            self.placement,
            self._next,
            self.course.by_guard,
            probed if probation.proven(probed, now_ns) else "",
            self.newest_order,
            self.guard.resting,
            probed,
            probation.done(now_ns) if probed else 0,
            probation.needed,
        )

    def _refusal(self, order: Order, now_ns: int) -> str:
        """Return the reason to refuse an order; empty if it is accepted."""
        other = self._charge not in ("", order.controller)
        if other and now_ns - self._charged_ns < LEASE_NS:
            return f"{OTHER}: {self._charge} is in charge"
        self._charge, self._charged_ns = order.controller, now_ns
        if order.run == 0 and order.term == 0 and not order.placement:
            return ""
        if order.run != self.run:
            return f"stale run: {order.run}, now {self.run}"
        if order.term != self.term:
            return f"stale term: {order.term}, now {self.term}"
        if not order.placement:
            return self._fork_refusal(order)
        if order.placement not in self.place.problem.candidates:
            return f"infeasible: {order.placement!r} is no candidate ({', '.join(self._names)})"
        if order.placement == self.placement:
            return ""
        if order.number < self.newest_order:
            return f"stale order: {order.number}, after {self.newest_order}"
        missing = self.guard.presence.missing(order.placement, now_ns)
        if missing:
            return f"not ready: {', '.join(sorted(missing))} not heard"
        probation = self.guard.probation
        if self.course.by_guard and not probation.proven(order.placement, now_ns):
            probation.want(order.placement)
            done, needed = probation.done(now_ns), probation.needed
            return f"not proven: {done} of {needed} cycles through {order.placement}"
        return ""

    def _fork_refusal(self, order: Order) -> str:
        tasks = self.place.problem.pipeline.tasks
        for task, node in order.forks:
            if task not in tasks or node not in tasks[task].on:
                return f"infeasible: {task} cannot run on {node}"
        return ""

    def _accept(self, order: Order) -> None:
        if order.run == 0 and order.term == 0:
            return
        if order.number > self.newest_order:
            self.newest_order = order.number
            self.shadow_fraction, self.forks = order.shadow_fraction, order.forks
            if self.course.by_guard:
                known = order.want in self.place.problem.candidates
                self.guard.probation.want(order.want if known else None)
        if order.placement and (order.placement != self.placement or self.course.by_guard):
            self._move(order.placement, by_guard=False)

    def _move(self, placement: str, *, by_guard: bool) -> None:
        """Change the placement: begin a new term, saved before any cycle has it."""
        if by_guard:
            self._ahead = None
            self.forks = ()
            # The next order of the controller sets the shadow fraction of the fallback.
            self.shadow_fraction = 0.0
        self.moves.append((self._next, placement, "guard" if by_guard else "order"))
        for move in self.moves[:-1_000]:
            self._first = move[1]
        del self.moves[:-1_000]
        self._forget_reports()
        self.guard.adopt(placement, fallback=by_guard)
        self.course.enter(self.run, self.term + 1)
        self._write()

    def _write(self) -> None:
        course = self.course
        holds = course.term, course.placement, course.by_guard
        self._book.write(StamperState(course.run, self._reserved, *holds, self._boot))

    # -------------------------------------------------------------------------- cycles

    def wake(self, now_ns: int) -> int:
        """Release due cycles, run the guard and send due beats; return when to call again."""
        if not self._begun and not self._begin(now_ns):
            return min(self.pulse.wake(now_ns), now_ns + self.place.period_ns)
        if self._setback.back_ns(now_ns) > self.place.period_ns // 4:
            self._begin_anew(now_ns)
        fallback = self.guard.look(now_ns)
        if fallback is not None:
            self._move(fallback, by_guard=True)
            self.pulse.send(now_ns)
        if self.timer and now_ns >= self._next_ns:
            # Of several periods that are due, only the last releases a cycle.
            released_ns = now_ns - (now_ns - self._next_ns) % self.place.period_ns
            self._next_ns = released_ns + self.place.period_ns
            self._release(released_ns, now_ns)
        due_ns = min(self.pulse.wake(now_ns), self._miss(now_ns))
        if self.timer:
            due_ns = min(due_ns, self._next_ns)
        guard_ns = self.guard.due_ns
        # While no fallback is complete, the guard looks again every quarter of a period.
        again_ns = now_ns + self.place.period_ns // 4
        return due_ns if guard_ns is None else min(due_ns, max(guard_ns, again_ns))

    def _miss(self, now_ns: int) -> int:
        """Ask the relay for beats of nodes that are missing; return when others would be."""
        period_ns, detector = self.place.period_ns, self.pulse.detector
        late_ns = period_ns * 5 // 4
        ages = [detector.direct_age_ns(who, now_ns) for who in self._agents]
        missing = any(age_ns is None or age_ns > late_ns for age_ns in ages)
        if missing and not 0 <= now_ns - self._asked_ns < period_ns:
            self._asked_ns = now_ns
            self.place.transport.put(self.place.keys.of(channels.MISSED), b"")
        due_ns = [now_ns + late_ns - age_ns for age_ns in ages if age_ns and age_ns <= late_ns]
        return min(due_ns, default=now_ns + period_ns) + 1

    def _begin_anew(self, now_ns: int) -> None:
        """Restart timer and guard after the clock was set back."""
        self._next_ns, self._framed_ns = now_ns, now_ns - self.place.period_ns
        for noted in (self.guard.presence, self.guard.failures, self.guard):
            noted.restart()

    def _begin(self, now_ns: int) -> bool:
        """Begin the run if a placement is complete; return whether it has begun."""
        whole = [self.placement]
        if now_ns - self._since_ns > START_NS:
            whole += self.place.problem.controller.fallbacks
        elif self._unsure and not all(self._claims.below(self.run, who) for who in self._gates()):
            return False
        presence = self.guard.presence
        name = next((name for name in whole if presence.whole(name, now_ns)), None)
        if name is None:
            return False
        if name != self.placement:
            self._move(name, by_guard=True)
        self._begun, self._next_ns = True, now_ns
        return True

    def _workers(self) -> Iterator[str]:
        """Yield the names of the workers of the current placement."""
        placed = self.place.problem.candidates[self.placement]
        return (f"{task}@{node}" for task, node in placed.sites)

    def _gates(self) -> Iterator[str]:
        """Yield the names of the sinks' processes of the current placement."""
        placed = self.place.problem.candidates[self.placement].first
        return (f"sink.{task}@{placed[task]}" for task in self.place.problem.pipeline.sinks)

    def _release(self, released_ns: int, now_ns: int) -> None:
        """Stamp a cycle and send it to the source tasks."""
        group_ns = self.group_clock()
        if self.cycle + 1 >= self._reserved:
            self._reserved = self.cycle + RESERVED
        # At every cycle, because the state folder may have been removed and created again.
        self._write()
        early, self._ahead = self._ahead, None
        stamp = early or self._stamp(self.cycle, released_ns)
        self.cycle += 1
        self.guard.sent(stamp.cycle, released_ns, stamp.placement)
        if self.routes.shadow_ends(stamp):
            self.guard.shadow_sent(stamp.cycle, released_ns, stamp.shadow)
        self._send(stamp, here=True, elsewhere=early is None)
        intervals = self.intervals.take_unreported()
        stamped = Stamped(**asdict(stamp), intervals=intervals, group_ns=group_ns)
        self.place.send(channels.STAMPED, stamped)
        if self._early and self.timer:
            self._ahead = self._stamp(self.cycle, released_ns + self.place.period_ns)
            self._send(self._ahead, here=False, elsewhere=True)

    def _sources(self) -> Iterator[Destination]:
        """Yield the source tasks of all candidates, with their nodes."""
        for name in self.place.problem.candidates:
            yield from self.routes.destinations(STAMPER, Stamp(0, 0, 1, name, 0))

    def _send(self, stamp: Stamp, *, here: bool, elsewhere: bool) -> None:
        """Send a stamp to the sources on this node, on other nodes, or both."""
        place = self.place
        header = encode(Header(stamp, STAMPER, place.node, "none", seal=place.stamped(stamp)))
        for task, node, kind, _ in self.routes.destinations(STAMPER, stamp):
            if here if node == place.node else elsewhere:
                place.transport.put(place.keys.of(channels.INPUT, task, node, kind), b"", header)

    def _stamp(self, cycle: int, released_ns: int) -> Stamp:
        wanted = self.guard.probed if self.course.by_guard else None
        shadow = wanted or self._shadowed(cycle)
        if shadow == self.placement:
            shadow = ""
        return Stamp(self.run, cycle, self.term, self.placement, released_ns, shadow, self.forks)

    def _shadowed(self, cycle: int) -> str:
        """Return the candidate of this cycle's shadow by the estimator's plan; empty if none."""
        if not self.shadow_fraction:
            return ""
        others = self._alternatives[self._names.index(self.placement)]
        plan = shadow_stamps(cycle, cycle + 1, others, self.shadow_fraction)
        return self._names[int(plan[0])] if plan[0] >= 0 else ""

    # --------------------------------------------------------------------------- beats

    def _holds(self) -> BeatState:
        return BeatState(self.course.term, self.course.placement)


def _reported_by_all(
    partial: dict[int, set[str]], done: Completion, expected: frozenset[str]
) -> bool:
    """Add a report of a cycle; return whether it is the last of the expected reports."""
    if done.sink not in expected:
        return False
    cycle = done.stamp.cycle
    reported = partial.setdefault(cycle, set())
    if done.sink in reported:
        return False
    reported.add(done.sink)
    if len(partial) > MAX_PARTIAL:
        for old in sorted(partial)[: MAX_PARTIAL // 2]:
            del partial[old]
    return reported == expected
