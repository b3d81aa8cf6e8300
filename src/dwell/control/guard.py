"""The guard beside the stamper: it leaves a placement that has fallen silent, and never returns.

Everything here is arithmetic on instants that the caller brings: there is no clock, no thread and
no message. Instants are whole nanoseconds of one clock, that of the node the guard is on, and never
go back.

The same machine runs beside the stamper of a live cell and in the simulator: `CellGuard` is told
what happens, and asked whether to move.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TypeAlias

from dwell.control.course import Course
from dwell.model import FrozenDict, Problem
from dwell.model.bounds import require
from dwell.model.controller_settings import GUARD_CYCLES, PROBE_CYCLES
from dwell.model.instants import EVIDENCE_NS

#: However often a cell relapses, no more than this many times as many.
MOST_DOUBLINGS = 5
#: Windows' worth of completed cycles that make a cell healthy (see `Probation`).
HEALTH_WINDOWS = 10
#: Probes whose completion may still count, the newest of them.
MOST_OPEN = 1_024


#: Whether a candidate may be moved to.
Whole: TypeAlias = Callable[[str], bool] | Mapping[str, bool]


class _Silence:
    """Wait for the cycle after the newest completed one.

    Parameters
    ----------
    kept : int
        How many cycles older than the patience are kept, the newest of them; there is no bound on
        how many are released meanwhile.
    """

    __slots__ = ("kept", "newest", "patience_ns", "released", "waiting")

    def __init__(self, patience_ns: int, kept: int = 1) -> None:
        self.patience_ns, self.kept = patience_ns, kept
        self.waiting: deque[tuple[int, int]] = deque()
        self.released = self.newest = -1

    def release(self, cycle: int, at_ns: int) -> None:
        """Wait for a cycle, from its release on; numbers that do not grow are ignored."""
        if cycle <= self.released:
            return
        self.released = cycle
        waiting, kept = self.waiting, self.kept
        waiting.append((cycle, at_ns))
        while len(waiting) > kept and waiting[kept][1] <= at_ns - self.patience_ns:
            waiting.popleft()

    def complete(self, cycle: int) -> None:
        """Wait no longer for a cycle, nor for those before it; unknown ones are ignored."""
        if self.newest < cycle <= self.released:
            self.newest = cycle
            self.skip(cycle)

    def skip(self, cycle: int) -> None:
        """Wait no longer for a cycle, nor for those before it, though it has not completed."""
        while self.waiting and self.waiting[0][0] <= cycle:
            self.waiting.popleft()

    def forget(self) -> None:
        """Wait only for cycles that are released from now on."""
        self.waiting.clear()

    @property
    def due_ns(self) -> int | None:
        """Instant at which the patience ends; None where no cycle is waited for."""
        return self.waiting[0][1] + self.patience_ns if self.waiting else None

    def over(self, now_ns: int) -> bool:
        """Whether the patience has ended."""
        due_ns = self.due_ns
        return due_ns is not None and now_ns >= due_ns


class FallbackRound:
    """Which fallback is tried next: each once, those that have failed last.

    A *round* lasts from the placement under which nothing completes any more until a cycle has
    completed, or an order has come.

    Parameters
    ----------
    fallbacks : iterable of str
        Candidates, best first.
    """

    __slots__ = ("_failed", "_tried", "fallbacks")

    def __init__(self, fallbacks: Iterable[str]) -> None:
        self.fallbacks = tuple(dict.fromkeys(fallbacks))
        # In the order of their failures; and what the guard has moved to.
        self._failed: dict[str, None] = {}
        self._tried: set[str] = set()

    def __repr__(self) -> str:
        tried = ", ".join(sorted(self._tried))
        return f"FallbackRound({', '.join(self.fallbacks)}; tried: {tried or 'none'})"

    @property
    def begun(self) -> bool:
        """Whether any has been tried."""
        return bool(self._tried)

    def options(self, placement: str, carrier: str | None = None) -> list[str]:
        """Return the other fallbacks that have not been tried, the next one first.

        Parameters
        ----------
        carrier : str, optional
            Fallback that carried the cell before an order left it.
        """
        first = [] if carrier is None else [carrier]
        fresh = (name for name in self.fallbacks if name not in self._failed)
        order = dict.fromkeys((*first, *fresh, *self._failed))
        return [name for name in order if name != placement and name not in self._tried]

    def moved(self, left: str, to: str) -> None:
        """Note a move of the guard away from what has failed."""
        if left in self.fallbacks:
            self._failed.pop(left, None)
            self._failed[left] = None
        self._tried.add(to)

    def again(self) -> None:
        """Begin another round: all may be tried again, in the order of their failures."""
        self._tried.clear()

    def over(self) -> None:
        """Note that a cycle has completed, or that an order has come."""
        self._failed.clear()
        self._tried.clear()


class Guard:
    """Says when the cell must leave its placement by itself, and for which fallback.

    It *fires* when the cycle after the newest completed one is older than g periods. Precisely:

    * The *newest completed* cycle is the one with the highest number of which a completion has
      been heard, not the one heard last. A completion that comes after that of a later cycle
      changes nothing, and a cycle that is lost between two completed ones is nothing.
    * The *cycle after* it is the first one released with a higher number, so that gaps in the
      numbers (the stamper has started again) are no silence. Before anything has completed it is
      the first cycle released.
    * It *is older than* g periods from g periods after its release on, that instant included. A
      completion heard at that very instant comes first.
    * A move, whoever makes it, begins anew: only cycles released under the placement that holds
      now are waited for, so that a new placement has g periods to complete its first cycle. A
      late completion of a cycle of the placement before changes nothing.
    * Completions of cycles that were never released here are ignored.

    The guard is *on a fallback* from its own move until the next order. A fallback *carries* the
    cell once one of its cycles has completed. One that does not within g periods has failed, and
    the next is tried at once: first what carried the cell before an order left it, until the
    cycle has completed that is `probe_cycles` after that; then the others, best first; then those
    that have failed since the last completed cycle or order, in the order of their failures. Each
    is tried once a round.

    A fallback that carries earns a *rest*: of the first `probe_cycles` cycles after the move those
    that come after the first completed one are not waited for. When each fallback that is there has
    been tried and nothing has completed, the guard rests for as many cycles as well; another
    round begins when it would fire again, and what was not there is tried as soon as it is. Every
    further rest before an order doubles them, up to 32 times, so that a cell none of whose
    fallbacks can carry it is not thrown about. Afterwards cycles are waited for as under any
    placement: the controller may be content with the fallback, or gone. A fallback that the
    controller ordered is watched at once.

    **Bound.** While the guard does not rest, and f fallbacks are there of which one can carry the
    cell, at most (f + 1)(g + 1) consecutive cycles bring no actuation: for each placement before
    that one the first that is lost, those released within the g periods after its release, and the
    one that may be released at the instant of the move. So it is g + 1 after a single fault from
    which on the first fallback that is tried works. (2g + 1 if an order to another placement that
    the fault broke takes effect within these g periods.) Without a fault it does not fire while
    every cycle completes, and is heard, within g periods of its release, nor, where single cycles
    are lost, while the others are heard within g - 1.

    Parameters
    ----------
    fallbacks : iterable of str
        Candidates, best first; none: it never fires.
    guard_cycles : int
        g, at least 2.
    period_ns : int
        P.
    probe_cycles : int
        Cycles that it rests for, at least 1: as many as would prove a placement.
    placement : str
        Candidate that the first cycles are stamped with.

    Attributes
    ----------
    course : Course
        Where the cell is, and whose move that was.
    newest : int
        Highest cycle completed, -1 for none.
    """

    __slots__ = (
        "_carrier",
        "_rest",
        "_rest_last",
        "_rests",
        "_returned",
        "_round",
        "_silence",
        "_since",
        "_spent_ns",
        "course",
        "probe_cycles",
    )

    def __init__(
        self,
        fallbacks: Iterable[str],
        *,
        guard_cycles: int,
        period_ns: int,
        probe_cycles: int,
        placement: str,
    ) -> None:
        GUARD_CYCLES.check("guard_cycles", guard_cycles)
        PROBE_CYCLES.check("probe_cycles", probe_cycles)
        require(period_ns > 0, "period_ns", period_ns, "at least 1")
        self.probe_cycles = probe_cycles
        self.course = Course(placement)
        self._silence = _Silence(guard_cycles * period_ns)
        self._round = FallbackRound(fallbacks)
        # Last cycle before the last move; and before an order left the fallback that carried.
        self._since = self._returned = -1
        self._carrier: str | None = None
        # Rests since the last order; cycles left of this one, and the last that it has waited for
        # all the same; when each fallback had been tried.
        self._rests = self._rest = 0
        self._rest_last = -1
        self._spent_ns: int | None = None

    def __repr__(self) -> str:
        how = ", resting" if self.resting else ", on a fallback" if self.on_fallback else ""
        where = f"{', '.join(self.fallbacks)}; at {self.placement!r}{how}"
        return f"{type(self).__name__}({where}, newest={self.newest})"

    @property
    def placement(self) -> str:
        """Candidate that holds."""
        return self.course.placement

    @property
    def on_fallback(self) -> bool:
        """Whether it is the guard's own move that holds."""
        return self.course.by_guard

    @property
    def fallbacks(self) -> tuple[str, ...]:
        """Candidates that it may move to, best first."""
        return self._round.fallbacks

    @property
    def newest(self) -> int:
        """Highest cycle completed, -1 for none."""
        return self._silence.newest

    @property
    def patience_ns(self) -> int:
        """Longest wait for a cycle: g periods."""
        return self._silence.patience_ns

    @property
    def carries(self) -> bool:
        """Whether a cycle has completed since the last move."""
        return self._silence.newest > self._since

    @property
    def resting(self) -> bool:
        """Whether it rests, or will when a cycle has completed, so soon after its own move."""
        return self._rest > 0

    @property
    def waits_for(self) -> int:
        """Cycle that it waits for, or will: none before it makes it fire."""
        silence = self._silence
        if silence.waiting:
            return silence.waiting[0][0]
        rests = self.carries or self._spent_ns is not None
        return silence.released + 1 + (self._rest if rests else 0)

    @property
    def options(self) -> list[str]:
        """Fallbacks that it may try, the next one first."""
        recent = self.newest <= self._returned + self.probe_cycles
        return self._round.options(self.placement, self._carrier if recent else None)

    def released(self, cycle: int, at_ns: int) -> None:
        """Note a cycle that has been stamped and released."""
        silence = self._silence
        if not self._rest or cycle <= silence.released:
            silence.release(cycle, at_ns)
            return
        self._rest -= 1
        if self._spent_ns is None and not self.carries:
            silence.release(cycle, at_ns)
            self._rest_last = cycle
        else:
            silence.released = cycle

    def passed(self, cycles: int) -> None:
        """Note how many cycles have been released before one that has completed.

        Of these nothing else has to be noted.
        """
        self._rest = max(self._rest - cycles, 0)

    def completed(self, cycle: int, at_ns: int) -> None:
        """Note that the completion of a cycle (by every sink) has been heard."""
        self._silence.complete(cycle)
        if self.carries:
            self._silence.skip(self._rest_last)

    @property
    def due_ns(self) -> int | None:
        """Next instant at which it would fire if nothing completed; None where it would not.

        It lies in the past where the guard has fired and a fallback was not there.
        """
        if not any(name != self.placement for name in self.fallbacks):
            return None
        if self._spent_ns is not None and not self.carries and self.options:
            return self._spent_ns
        return self._silence.due_ns

    def check(self, now_ns: int, whole: Whole, heard: Whole | None = None) -> str | None:
        """Look whether to move, and where to; the rest after a round begins here, too.

        Parameters
        ----------
        whole : callable of str to bool, or mapping
            Whether all nodes, links and workers of a candidate were heard lately, and not all of
            its last cycles failed; see `Presence` and `Failures`.
        heard : callable of str to bool, or mapping, optional
            Whether they were heard; asked where no fallback that may be tried is whole.

        Returns
        -------
        str or None
            The fallback to try; `adopt` it. None where there is no reason to move, or no such
            fallback: the guard stays armed, so ask again when one may be there.
        """
        due_ns = self.due_ns
        if due_ns is None or now_ns < due_ns:
            return None
        if self.carries:
            self._round.over()
        elif self._spent_ns is not None and self._silence.over(now_ns):
            self._round.again()
        options = self.options
        for asked in (whole, whole if heard is None else heard):
            ask = asked.__getitem__ if isinstance(asked, Mapping) else asked
            for name in options:
                if ask(name):
                    return name
        if self._fails and self._round.begun:
            self._begin_rest()
            self._spent_ns = now_ns
        return None

    @property
    def _fails(self) -> bool:
        """Whether it is on a fallback that is being tried, and has not carried the cell yet."""
        return self.on_fallback and self._spent_ns is None and not self.carries

    def adopt(self, candidate: str, fallback: bool = False) -> None:
        """Take note of a move: cycles released from now on have another placement.

        Parameters
        ----------
        fallback : bool
            Whether the guard itself makes it (`check` said so), and no order. An order for the
            placement that holds already is a move, too: it makes a fallback the controller's.
        """
        if fallback:
            self._rests += not self._fails
            self._round.moved(self.placement, candidate)
            self._carrier = None
            self.course.fall(candidate, self.placement)
        else:
            if self.on_fallback:
                self._carrier = self.placement if self.carries else None
                self._returned = self._silence.released
            self._rests = 0
            self._round.over()
            self.course.move(candidate)
        self._begin_rest()
        self._spent_ns, self._since = None, self._silence.released

    def _begin_rest(self) -> None:
        """Wait for nothing that is out, and rest longer with each rest before an order."""
        rests = self._rests
        self._rest = self.probe_cycles << min(rests - 1, MOST_DOUBLINGS) if rests else 0
        self._rest_last = -1
        self._silence.forget()

    def restart(self) -> None:
        """Begin anew: nothing released so far is waited for (the guard's own node was away)."""
        self._silence.forget()


def _patience_ns(problem: Problem) -> int:
    """Longest wait of a cell for a cycle: g periods."""
    return problem.controller.guard_cycles * problem.pipeline.period_ns


def parts_of(problem: Problem, candidate: str) -> frozenset[str]:
    """Return the names of all that must be there for a candidate to be whole.

    Nodes by their name, links as ``R1->E``, workers as ``perception@E``.
    """
    pipeline, placement = problem.pipeline, problem.candidates[candidate]
    crossed = {(placement[flow.source], placement[flow.target]) for flow in pipeline.flows}
    return frozenset(
        {
            *placement.values(),
            *(f"{source}->{target}" for source, target in crossed if source != target),
            *(f"{task}@{node}" for task, node in placement.items()),
        }
    )


class Presence:
    """Last sign of life of every node, link and worker, and the candidates that are whole.

    Parameters
    ----------
    parts : mapping of str to collection of str
        Parts of each candidate; see `parts_of`.
    within_ns : int
        Age beyond which a sign of life counts no more.
    """

    __slots__ = ("_heard_ns", "parts", "within_ns")

    def __init__(self, parts: Mapping[str, Collection[str]], within_ns: int) -> None:
        self.parts = FrozenDict({name: frozenset(mine) for name, mine in parts.items()})
        self.within_ns = within_ns
        self._heard_ns: dict[str, int] = {}

    def __repr__(self) -> str:
        return f"<Presence of {len(self._heard_ns)} parts, within {self.within_ns / 1e6:g} ms>"

    @classmethod
    def of(cls, problem: Problem) -> Presence:
        """Make that of all candidates of a cell: heard within g - 1 periods.

        What a fault has ended may have been heard up to a period after the release of the first
        cycle that it cost. The guard looks g periods after that release: of what it takes for
        whole, the last sign of life has to be younger than that.
        """
        period_ns = problem.pipeline.period_ns
        parts = {name: parts_of(problem, name) for name in problem.candidates}
        return cls(parts, max(problem.controller.guard_cycles - 1, 1) * period_ns)

    def heard(self, part: str, at_ns: int) -> None:
        """Note a sign of life."""
        self._heard_ns[part] = max(at_ns, self._heard_ns.get(part, at_ns))

    def gone(self, part: str) -> None:
        """Forget a part that has said itself that it cannot do its work."""
        self._heard_ns.pop(part, None)

    def restart(self) -> None:
        """Forget everything: nobody has been heard yet."""
        self._heard_ns.clear()

    def missing(self, candidate: str, now_ns: int) -> frozenset[str]:
        """Return the parts of a candidate that were not heard lately."""
        since_ns = now_ns - self.within_ns
        heard_ns = self._heard_ns
        return frozenset(
            part for part in self.parts[candidate] if heard_ns.get(part, since_ns) <= since_ns
        )

    def whole(self, candidate: str, now_ns: int) -> bool:
        """Whether all parts of a candidate were heard lately."""
        return not self.missing(candidate, now_ns)


class Failures:
    """The last cycles and shadows through every candidate that nobody has heard complete.

    Parameters
    ----------
    candidates : iterable of str
    in_a_row : int
        k: as many failures make a candidate fail.
    patience_ns : int
        Time from a release after which a cycle that is not heard to complete has failed.
    """

    __slots__ = ("_through", "in_a_row")

    def __init__(self, candidates: Iterable[str], in_a_row: int, patience_ns: int) -> None:
        self.in_a_row = in_a_row
        self._through = {name: _Silence(patience_ns, kept=in_a_row) for name in candidates}

    def __repr__(self) -> str:
        return f"<Failures of {len(self._through)} candidates, {self.in_a_row} in a row>"

    @classmethod
    def of(cls, problem: Problem) -> Failures:
        """Make that of a cell: g + 1 in a row, each g periods old."""
        in_a_row = problem.controller.failures_in_a_row
        return cls(problem.candidates, in_a_row, _patience_ns(problem))

    def released(self, candidate: str, cycle: int, at_ns: int) -> None:
        """Note that a cycle, or its shadow, has been sent through a candidate."""
        self._through[candidate].release(cycle, at_ns)

    def completed(self, candidate: str, cycle: int) -> None:
        """Note that a completion has been heard; unknown ones are ignored."""
        self._through[candidate].complete(cycle)

    def failing(self, candidate: str, now_ns: int) -> bool:
        """Whether the last k have all failed, none of them more than `EVIDENCE_NS` ago."""
        silence = self._through[candidate]
        failed_ns = [at for _, at in silence.waiting if at <= now_ns - silence.patience_ns]
        if len(failed_ns) < self.in_a_row:
            return False
        return failed_ns[-self.in_a_row] >= now_ns - EVIDENCE_NS

    def restart(self) -> None:
        """Forget everything."""
        for silence in self._through.values():
            silence.forget()


class Probation:
    """Permission for an order to leave the fallback: h probes through the wanted placement.

    A *probe* is the shadow of a cycle through the placement that is wanted. While somebody wants to
    leave, every cycle brings one. Once h of them have completed since the wish began, the placement
    is *proven*, for as long as the wish lasts. By the measure of the guard itself: where the
    probe after the newest completed one becomes older than g periods, the count begins anew, for
    there the guard would have fired.

    h is `probe_cycles` at first. It doubles at every *relapse*: the guard fires before a whole
    *stretch of health* has completed since the fallback was left. It halves, not below
    `probe_cycles`, with every stretch of health that completes under orders. It never exceeds 32
    times `probe_cycles`.

    Parameters
    ----------
    probe_cycles : int
        The least h, at least 1.
    health_cycles : int
        Completed cycles that make a stretch of health.
    patience_ns : int
        g periods.

    Attributes
    ----------
    needed : int
        h.
    wanted : str or None
        Placement that probes are sent through.
    """

    __slots__ = (
        "_count",
        "_first",
        "_health",
        "_on_fallback",
        "_open",
        "_returned",
        "_silence",
        "health_cycles",
        "most",
        "needed",
        "probe_cycles",
        "wanted",
    )

    def __init__(self, probe_cycles: int, *, health_cycles: int, patience_ns: int) -> None:
        PROBE_CYCLES.check("probe_cycles", probe_cycles)
        require(health_cycles >= 1, "health_cycles", health_cycles, "at least 1")
        self.probe_cycles = self.needed = probe_cycles
        self.most = probe_cycles << MOST_DOUBLINGS
        self.health_cycles = health_cycles
        self.wanted: str | None = None
        self._silence = _Silence(patience_ns)
        # Probes under this wish that have not completed, in their order.
        self._open: dict[int, None] = {}
        self._count = self._first = self._health = 0
        self._on_fallback = self._returned = False

    @classmethod
    def of(cls, problem: Problem) -> Probation:
        """Make that of a cell: ten windows completed are a stretch of health."""
        return cls(
            problem.controller.probe_cycles,
            health_cycles=HEALTH_WINDOWS * problem.window_cycles,
            patience_ns=_patience_ns(problem),
        )

    def __repr__(self) -> str:
        return f"Probation({self._count} of {self.needed} through {self.wanted!r})"

    def want(self, candidate: str | None, first: int = 0) -> None:
        """Set the placement that the fallback shall be left for; another wish begins anew.

        Parameters
        ----------
        first : int
            First cycle that is a probe under this wish.
        """
        if candidate != self.wanted:
            self.wanted, self._count, self._first = candidate, 0, first
            self._open.clear()
            self._silence.forget()

    def released(self, cycle: int, at_ns: int) -> None:
        """Note that a cycle has been sent as a probe through the wanted placement."""
        self._look(at_ns)
        if cycle >= max(self._first, self._silence.released + 1):
            self._silence.release(cycle, at_ns)
            self._open[cycle] = None
            if len(self._open) > MOST_OPEN:
                del self._open[next(iter(self._open))]

    def completed(self, cycle: int, at_ns: int) -> None:
        """Note that the completion of a probe through the wanted placement has been heard.

        One that comes after that of a later cycle counts, too. One that was sent under a wish
        before, or that has been heard of already, does not.
        """
        self._look(at_ns, also_now=False)
        if cycle in self._open:
            del self._open[cycle]
            self._count += 1
            self._silence.complete(cycle)

    def done(self, now_ns: int) -> int:
        """Return how many probes count by now, at most h."""
        self._look(now_ns)
        return min(self._count, self.needed)

    def proven(self, candidate: str, now_ns: int) -> bool:
        """Whether an order for a candidate may leave the fallback."""
        return self.done(now_ns) == self.needed and candidate == self.wanted

    def _look(self, now_ns: int, *, also_now: bool = True) -> None:
        """Begin to count anew where the patience has ended."""
        if self._silence.over(now_ns if also_now else now_ns - 1):
            self._count = 0

    def fell(self) -> None:
        """Note that the guard has moved the cell to a fallback."""
        if self._returned:
            self.needed = min(2 * self.needed, self.most)
        self._on_fallback, self._returned, self._health = True, False, 0
        self.want(None)

    def left(self) -> None:
        """Note that an order has left the fallback."""
        self._on_fallback, self._returned, self._health = False, True, 0
        self.want(None)

    def healthy(self, cycles: int = 1) -> None:
        """Note cycles that have completed; under a fallback they say nothing."""
        if self._on_fallback:
            return
        self._health += cycles
        stretches, self._health = divmod(self._health, self.health_cycles)
        if stretches:
            self._returned = False
            self.needed = max(self.needed >> stretches, self.probe_cycles)


class CellGuard(Guard):
    """The guard of a cell: all that has to be noted of what happens in it.

    Parameters
    ----------
    problem : Problem
    placement : str, optional
        Candidate that the first cycles are stamped with; by default the initial one.

    Attributes
    ----------
    presence : Presence
        To be told the signs of life.
    failures : Failures
        Cycles and shadows that nobody has heard complete.
    probation : Probation
        To be told who wants to leave the fallback, and what completes under orders.
    """

    __slots__ = ("failures", "presence", "probation")

    def __init__(self, problem: Problem, placement: str | None = None) -> None:
        settings = problem.controller
        super().__init__(
            settings.fallbacks,
            guard_cycles=settings.guard_cycles,
            period_ns=problem.pipeline.period_ns,
            probe_cycles=settings.probe_cycles,
            placement=placement or problem.initial,
        )
        self.presence, self.failures = Presence.of(problem), Failures.of(problem)
        self.probation = Probation.of(problem)

    def sent(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Note that a cycle has been released through a candidate."""
        self.released(cycle, at_ns)
        self.failures.released(candidate, cycle, at_ns)

    def shadow_sent(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Note that a cycle has also been released through another candidate."""
        self.failures.released(candidate, cycle, at_ns)
        if candidate == self.probation.wanted:
            self.probation.released(cycle, at_ns)

    def arrived(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Note that the completion of a cycle through a candidate has been heard."""
        self.failures.completed(candidate, cycle)
        # One that was sent a cycle early, before a move, says nothing of the placement that holds.
        if candidate == self.placement or cycle <= self._since:
            self.completed(cycle, at_ns)

    def shadow_arrived(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Note that the completion of a shadow through a candidate has been heard."""
        self.failures.completed(candidate, cycle)
        if candidate == self.probation.wanted:
            self.probation.completed(cycle, at_ns)

    def look(self, now_ns: int) -> str | None:
        """Return the fallback to try, if the cell has to move now; see `check`."""

        def heard(name: str) -> bool:
            return self.presence.whole(name, now_ns)

        def whole(name: str) -> bool:
            return heard(name) and not self.failures.failing(name, now_ns)

        return self.check(now_ns, whole, heard)

    def adopt(self, candidate: str, fallback: bool = False) -> None:
        """Take note of a move (see `Guard.adopt`), and of what it says of the probation."""
        left = self.on_fallback and not fallback
        super().adopt(candidate, fallback)
        if fallback:
            self.probation.fell()
        elif left:
            self.probation.left()
