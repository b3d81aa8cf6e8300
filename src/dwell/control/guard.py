"""The guard: it leaves a placement whose cycles stop completing, and never returns by itself.

This module computes with instants that the caller passes in; it has no clock, thread or message.
Instants are integer nanoseconds of the clock of the guard's node, and never decrease.

A live cell's stamper and the simulator use the same `CellGuard`: they report events to it and
call `CellGuard.look` to learn whether to move.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import TypeAlias

from dwell.control.course import Course
from dwell.model import FrozenDict, Problem
from dwell.model.bounds import require
from dwell.model.chain import ChainPatience
from dwell.model.controller_settings import PROBE_CYCLES
from dwell.model.instants import EVIDENCE_NS

#: Largest number of doublings of the number of probes and of the length of a rest.
MOST_DOUBLINGS = 5
#: Completed cycles, in windows, after which a cell counts as healthy (see `Probation`).
HEALTH_WINDOWS = 10
#: Largest number of open probes; older probes no longer count.
MOST_OPEN = 1_024


#: Whether the guard may move to a candidate.
Whole: TypeAlias = Callable[[str], bool] | Mapping[str, bool]


class _Silence:
    """The wait for the cycle after the newest completed one.

    Parameters
    ----------
    kept : int
        Largest number of waiting cycles that are older than the patience. Younger cycles have no
        bound.
    """

    def __init__(self, patience_ns: int, kept: int = 1) -> None:
        self.patience_ns, self.kept = patience_ns, kept
        self.waiting: deque[tuple[int, int]] = deque()
        self.released = self.newest = -1

    def release(self, cycle: int, at_ns: int) -> None:
        """Wait for a cycle from its release on; ignore numbers that do not increase."""
        if cycle <= self.released:
            return
        self.released = cycle
        waiting, kept = self.waiting, self.kept
        waiting.append((cycle, at_ns))
        while len(waiting) > kept and waiting[kept][1] <= at_ns - self.patience_ns:
            waiting.popleft()

    def pass_over(self, cycle: int) -> None:
        """Record the release of a cycle that it does not wait for."""
        self.released = max(self.released, cycle)

    def complete(self, cycle: int) -> None:
        """Stop waiting for a completed cycle and all before it; ignore unknown cycles."""
        if self.newest < cycle <= self.released:
            self.newest = cycle
            self.skip(cycle)

    def skip(self, cycle: int) -> None:
        """Stop waiting for a cycle and all before it, even if it has not completed."""
        while self.waiting and self.waiting[0][0] <= cycle:
            self.waiting.popleft()

    def forget(self) -> None:
        """Stop waiting for all cycles released so far."""
        self.waiting.clear()

    @property
    def due_ns(self) -> int | None:
        """Instant at which the patience ends; None if no cycle is waiting."""
        return self.waiting[0][1] + self.patience_ns if self.waiting else None

    def over(self, now_ns: int) -> bool:
        """Whether the patience has ended."""
        due_ns = self.due_ns
        return due_ns is not None and now_ns >= due_ns


class _OriginSilence(_Silence):
    """The wait for a newer origin of a chain than the newest one so far.

    It keeps the newest origin itself, whose age counts. Without an origin it keeps the first cycle
    that it waits for.

    Parameters
    ----------
    every : int
        Cycles from one origin to the next.
    """

    def __init__(self, patience_ns: int, every: int) -> None:
        super().__init__(patience_ns)
        self.every = every

    def release(self, cycle: int, at_ns: int) -> None:
        """Wait for the actuation of a cycle in which the chain has an origin."""
        if cycle % self.every:
            self.pass_over(cycle)
        else:
            super().release(cycle, at_ns)

    def complete(self, cycle: int) -> None:
        """Record an actuation with an origin, and stop waiting for all cycles before it."""
        if self.newest < cycle <= self.released:
            self.newest = cycle
            self.skip(cycle - 1)


class FallbackRound:
    """The order in which fallbacks are tried: each once, those that failed last.

    A *round* begins when cycles stop completing, and ends with the next completed cycle or order.

    Parameters
    ----------
    fallbacks : iterable of str
        Candidates, best first.
    """

    def __init__(self, fallbacks: Iterable[str]) -> None:
        self.fallbacks = tuple(dict.fromkeys(fallbacks))
        # Failed fallbacks in the order of their failures, and the fallbacks tried so far.
        self._failed: dict[str, None] = {}
        self._tried: set[str] = set()

    def __repr__(self) -> str:
        tried = ", ".join(sorted(self._tried))
        return f"FallbackRound({', '.join(self.fallbacks)}; tried: {tried or 'none'})"

    @property
    def begun(self) -> bool:
        """Whether the guard has tried a fallback."""
        return bool(self._tried)

    def options(self, placement: str, carrier: str | None = None) -> list[str]:
        """Return the other untried fallbacks, next first.

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
        """Record a move of the guard away from a failed placement."""
        if left in self.fallbacks:
            self._failed.pop(left, None)
            self._failed[left] = None
        self._tried.add(to)

    def again(self) -> None:
        """Begin another round: each fallback may be tried again, those that failed last."""
        self._tried.clear()

    def over(self) -> None:
        """End the round after a completed cycle or an order."""
        self._failed.clear()
        self._tried.clear()


class Guard:
    """Decides when the cell must leave its placement without an order, and for which fallback.

    The guard *fires* when the cycle after the newest completed cycle is as old as the *patience*,
    max(D, P) + (g - 1) P: the deadlines of g cycles have then passed. It also fires when the newest
    origin of a *guarded chain* is as old as the chain's patience. In detail:

    * The *newest completed* cycle has the highest number of all completed cycles, in whatever order
      their completions arrive. A late completion of an older cycle and a cycle lost between two
      completed cycles change nothing.
    * The *cycle after* it is the first released cycle with a higher number, because the numbers
      have gaps when the stamper restarts. Before the first completion it is the first released
      cycle.
    * The guard fires from the patience after the release of that cycle on, including that instant.
      A completion at that instant counts first.
    * Every move restarts the wait. The guard waits only for cycles released after the move, and a
      new placement has the patience to complete its first cycle. Late completions of earlier cycles
      change nothing.
    * The guard ignores completions of cycles that were never released here.
    * The newest origin of a chain is the highest cycle from which one of its actuations descends,
      or at first the first cycle with an origin that the guard waits for. Moves, rests
      and restarts apply to origins as they do to cycles.

    The guard is *on a fallback* from its own move until the next order. A fallback *carries* the
    cell once one of its cycles has completed and each guarded chain has actuated from one of its
    cycles. If one of these does not occur within its patience, the fallback has failed, and the
    guard tries the next at once. It tries each fallback once per round, in this order:

    1. the fallback that carried the cell before an order left it, until a cycle has completed that
       was released more than `probe_cycles` cycles after the last one under that fallback;
    2. the other fallbacks, best first;
    3. fallbacks that have failed since the last completed cycle or order, earliest failure first.

    After its move the guard *rests* for `probe_cycles` cycles: once a first cycle has completed (or
    a chain has actuated), it does not wait for the others. It also rests when it has tried
    every available fallback and no cycle has completed. The next round then begins when the guard
    would fire again, but a fallback that becomes available is tried at once. Every further rest
    before an order is twice as long, up to 32 times `probe_cycles`; this limits the moves of a cell
    that no fallback can carry. After a rest the guard waits for cycles as under any placement,
    because the controller may keep the fallback or may be down. A fallback ordered by the
    controller gets no rest.

    **Bound.** Assume that the guard does not rest, that f fallbacks are available, and that at
    least one can carry the cell. Let n be D / P, rounded up: `Pipeline.open_cycles`. Then at most
    (f + 1)(g + n) consecutive cycles bring no actuation. Each placement that fails costs its first
    lost cycle, the cycles released in the patience after it, and a cycle that may be released at
    the instant of the move. After a single fault the bound is g + n if the first fallback works.
    (It is 2(g + n) - 1 if, within the patience, an order takes effect to another placement that the
    fault broke.) Without a fault, the guard does not fire while every completion arrives within the
    patience. If single cycles are lost, it does not fire while the other completions arrive one
    period earlier.

    Parameters
    ----------
    fallbacks : iterable of str
        Candidates, best first. A guard without fallbacks never fires.
    patience_ns : int
        Longest wait for a cycle after its release.
    probe_cycles : int
        Length of the first rest in cycles, at least 1; also the probes that prove a placement.
    placement : str
        Candidate of the first cycles.
    chains : mapping of str to ChainPatience, optional
        Guarded chains, by name.

    Attributes
    ----------
    course : Course
        Placement of the cell, and whether the guard moved it there.
    newest : int
        Highest completed cycle, -1 for none.
    """

    def __init__(
        self,
        fallbacks: Iterable[str],
        *,
        patience_ns: int,
        probe_cycles: int,
        placement: str,
        chains: Mapping[str, ChainPatience] | None = None,
    ) -> None:
        PROBE_CYCLES.check("probe_cycles", probe_cycles)
        require(patience_ns > 0, "patience_ns", patience_ns, "at least 1")
        self.probe_cycles = probe_cycles
        self.course = Course(placement)
        self._silence = _Silence(patience_ns)
        self._chains = {
            name: _OriginSilence(chain.patience_ns, chain.every)
            for name, chain in (chains or {}).items()
        }
        self._waits: tuple[_Silence, ...] = (self._silence, *self._chains.values())
        self._round = FallbackRound(fallbacks)
        # Last cycle before the last move, and last cycle before an order left the fallback.
        self._since = self._returned = -1
        self._carrier: str | None = None
        # Rests since the last order; remaining cycles of this rest; last cycle of the rest that
        # the guard waited for; instant at which every available fallback had been tried.
        self._rests = self._rest = 0
        self._rest_last = -1
        self._spent_ns: int | None = None

    def __repr__(self) -> str:
        how = ", resting" if self.resting else ", on a fallback" if self.on_fallback else ""
        where = f"{', '.join(self.fallbacks)}; at {self.placement!r}{how}"
        return f"{type(self).__name__}({where}, newest={self.newest})"

    @property
    def placement(self) -> str:
        """Candidate in force."""
        return self.course.placement

    @property
    def on_fallback(self) -> bool:
        """Whether the guard itself made the last move."""
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
        """Longest wait for a cycle after its release."""
        return self._silence.patience_ns

    @property
    def chains(self) -> tuple[str, ...]:
        """Names of the guarded chains."""
        return tuple(self._chains)

    @property
    def carries(self) -> bool:
        """Whether a cycle has completed, and each guarded chain actuated, since the last move."""
        return all(wait.newest > self._since for wait in self._waits)

    @property
    def resting(self) -> bool:
        """Whether the guard rests, or will rest as soon as a cycle completes."""
        return self._rest > 0

    @property
    def waits_for(self) -> int:
        """Earliest cycle, released or to come, whose completion the guard may wait for."""
        return self._waits_from(self._silence)

    @property
    def chain_waits(self) -> Iterator[tuple[int, int]]:
        """Earliest cycle whose age may make the guard fire, and the patience, of each chain."""
        return ((self._waits_from(wait), wait.patience_ns) for wait in self._chains.values())

    def _waits_from(self, wait: _Silence) -> int:
        if wait.waiting:
            return wait.waiting[0][0]
        rests = wait.newest > self._since or self._spent_ns is not None
        return wait.released + 1 + (self._rest if rests else 0)

    @property
    def options(self) -> list[str]:
        """Fallbacks that the guard may try, next first."""
        recent = min(wait.newest for wait in self._waits) <= self._returned + self.probe_cycles
        return self._round.options(self.placement, self._carrier if recent else None)

    def released(self, cycle: int, at_ns: int, *, is_idle: bool = False) -> None:
        """Record the release of a stamped cycle; an idle cycle has no completion."""
        rests = self._rest > 0 and cycle > self._silence.released
        self._rest -= rests
        for wait in self._waits:
            waits = not rests or (self._spent_ns is None and wait.newest <= self._since)
            if rests and waits:
                self._rest_last = cycle
            if not waits or (is_idle and wait is self._silence):
                wait.pass_over(cycle)
            else:
                wait.release(cycle, at_ns)

    def passed(self, cycles: int) -> None:
        """Record cycles released before a completed one, in place of `released` for each."""
        self._rest = max(self._rest - cycles, 0)

    def completed(self, cycle: int, at_ns: int) -> None:
        """Record the completion of a cycle by every sink."""
        self._complete(self._silence, cycle)

    def actuated(self, chain: str, origin: int) -> None:
        """Record an actuation of a guarded chain that descends from the cycle `origin`."""
        self._complete(self._chains[chain], origin)

    def _complete(self, wait: _Silence, cycle: int) -> None:
        wait.complete(cycle)
        if wait.newest > self._since:
            wait.skip(self._rest_last)

    @property
    def due_ns(self) -> int | None:
        """Next instant at which the guard fires if no cycle completes; None if it cannot fire.

        The instant is past if the guard has fired and no fallback was available.
        """
        if not any(name != self.placement for name in self.fallbacks):
            return None
        is_spent = self._spent_ns is not None and self._round.begun
        if is_spent and not self.carries and self.options:
            return self._spent_ns
        dues = (wait.due_ns for wait in self._waits)
        return min((due_ns for due_ns in dues if due_ns is not None), default=None)

    def check(self, now_ns: int, whole: Whole, heard: Whole | None = None) -> str | None:
        """Return the fallback to move to now, if any; begin a rest at the end of a round.

        Parameters
        ----------
        whole : callable of str to bool, or mapping
            Whether all nodes, links and workers of a candidate have sent a recent sign of life and
            its last cycles have not all failed (see `Presence` and `Failures`).
        heard : callable of str to bool, or mapping, optional
            Whether they have sent a recent sign of life; used if no untried fallback is `whole`.

        Returns
        -------
        str or None
            Fallback to pass to `adopt`. None if the guard need not move or no fallback is
            available; in the latter case call again when one may have become available.
        """
        due_ns = self.due_ns
        if due_ns is None or now_ns < due_ns:
            return None
        if self.carries:
            self._round.over()
        elif self._spent_ns is not None and any(wait.over(now_ns) for wait in self._waits):
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
        """Whether the guard is trying a fallback that has not carried the cell yet."""
        return self.on_fallback and self._spent_ns is None and not self.carries

    def adopt(self, candidate: str, fallback: bool = False) -> None:
        """Record a move: the cycles released from now on have the placement `candidate`.

        Parameters
        ----------
        fallback : bool
            Whether the guard makes the move (after `check`) and not an order. An order for the
            placement in force is also a move: it ends the state *on a fallback*.
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
        """Forget all released cycles, and rest twice as long with each rest since an order."""
        rests = self._rests
        self._rest = self.probe_cycles << min(rests - 1, MOST_DOUBLINGS) if rests else 0
        self._rest_last = -1
        self.restart()

    def restart(self) -> None:
        """Forget all released cycles, as after an outage of the guard's own node."""
        for wait in self._waits:
            wait.forget()


def parts_of(problem: Problem, candidate: str) -> frozenset[str]:
    """Return the names of all parts that a candidate needs.

    Nodes have their name; links have the form ``R1->E``, workers ``perception@E``.
    """
    pipeline, copies = problem.pipeline, problem.candidates[candidate].copies
    crossed = {(one[flow.source], one[flow.target]) for one in copies for flow in pipeline.flows}
    return frozenset(
        {
            *(node for placement in copies for node in placement.values()),
            *(f"{source}->{target}" for source, target in crossed if source != target),
            *(f"{task}@{node}" for placement in copies for task, node in placement.items()),
        }
    )


class Presence:
    """Last sign of life of every node, link and worker, and the candidates with all parts alive.

    Parameters
    ----------
    parts : mapping of str to collection of str
        Parts of each candidate without replicas; see `parts_of`.
    within_ns : int
        Age from which on a sign of life no longer counts.
    members : mapping of str to collection of str, optional
        Members of each candidate with replicas.
    """

    def __init__(
        self,
        parts: Mapping[str, Collection[str]],
        within_ns: int,
        members: Mapping[str, Collection[str]] | None = None,
    ) -> None:
        self.parts = FrozenDict({name: frozenset(mine) for name, mine in parts.items()})
        self.within_ns = within_ns
        self.members = FrozenDict(members or {})
        self._heard_ns: dict[str, int] = {}

    def __repr__(self) -> str:
        return f"<Presence of {len(self._heard_ns)} parts, within {self.within_ns / 1e6:g} ms>"

    @classmethod
    def of(cls, problem: Problem) -> Presence:
        """Return the presence of a cell, with a largest age of g - 1 periods.

        The last sign of life of a failed part may arrive up to max(D, P) after the release of the
        first lost cycle. The guard checks g - 1 periods after that, so a part counts as alive only
        if its last sign of life is younger than g - 1 periods.
        """
        period_ns = problem.pipeline.period_ns
        parts = {name: parts_of(problem, name) for name in problem.plain_candidates}
        members = {name: one.members for name, one in problem.replicas.items()}
        return cls(parts, max(problem.controller.guard_cycles - 1, 1) * period_ns, members)

    def heard(self, part: str, at_ns: int) -> None:
        """Record a sign of life."""
        self._heard_ns[part] = max(at_ns, self._heard_ns.get(part, at_ns))

    def gone(self, part: str) -> None:
        """Forget a part that has reported its own failure."""
        self._heard_ns.pop(part, None)

    def restart(self) -> None:
        """Forget all signs of life."""
        self._heard_ns.clear()

    def missing(self, candidate: str, now_ns: int) -> frozenset[str]:
        """Return the parts of a candidate without a recent sign of life.

        The parts of replicas are the parts of the member that lacks fewest.
        """
        if candidate in self.members:
            return min((self.missing(name, now_ns) for name in self.members[candidate]), key=len)
        since_ns = now_ns - self.within_ns
        heard_ns = self._heard_ns
        return frozenset(
            part for part in self.parts[candidate] if heard_ns.get(part, since_ns) <= since_ns
        )

    def whole(self, candidate: str, now_ns: int) -> bool:
        """Whether all parts of a candidate have sent a recent sign of life."""
        return not self.missing(candidate, now_ns)


class Failures:
    """Cycles and shadows that have failed since the last completion, by candidate.

    Parameters
    ----------
    candidates : iterable of str
    in_a_row : int
        k: number of failures in a row after which a candidate fails.
    patience_ns : int
        Time after its release at which a cycle without a completion has failed.
    """

    def __init__(self, candidates: Iterable[str], in_a_row: int, patience_ns: int) -> None:
        self.in_a_row = in_a_row
        self._through = {name: _Silence(patience_ns, kept=in_a_row) for name in candidates}

    def __repr__(self) -> str:
        return f"<Failures of {len(self._through)} candidates, {self.in_a_row} in a row>"

    @classmethod
    def of(cls, problem: Problem) -> Failures:
        """Return the failures of a cell, with k = g + 1 and the guard's longest patience."""
        in_a_row = problem.controller.failures_in_a_row
        return cls(problem.candidates, in_a_row, problem.longest_patience_ns)

    def released(self, candidate: str, cycle: int, at_ns: int) -> None:
        """Record the release of a cycle or its shadow through a candidate."""
        self._through[candidate].release(cycle, at_ns)

    def completed(self, candidate: str, cycle: int) -> None:
        """Record a completion; ignore unknown cycles."""
        self._through[candidate].complete(cycle)

    def failing(self, candidate: str, now_ns: int) -> bool:
        """Whether the last k cycles have all failed and were released within `EVIDENCE_NS`."""
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

    A *probe* is the shadow of a cycle through the wanted placement, or through a member of wanted
    replicas (see `CellGuard.probed`). Every cycle has a probe while the policy or a person wants to
    leave the fallback. Once h probes have completed, the placement
    is *proven* as long as it stays wanted. If the probe after the newest completed one becomes as
    old as the patience, counting restarts, because the guard would have fired.

    At first h equals `probe_cycles`. It doubles at every *relapse*: the guard fires before
    `health_cycles` cycles have completed since an order left the fallback. It halves, down to
    `probe_cycles`, with every `health_cycles` cycles that complete under orders. It never exceeds
    32 times `probe_cycles`.

    Parameters
    ----------
    probe_cycles : int
        Smallest h, at least 1.
    health_cycles : int
        Completed cycles after which the cell counts as healthy.
    patience_ns : int
        The guard's patience.

    Attributes
    ----------
    needed : int
        h.
    wanted : str or None
        Placement of the probes.
    """

    def __init__(self, probe_cycles: int, *, health_cycles: int, patience_ns: int) -> None:
        PROBE_CYCLES.check("probe_cycles", probe_cycles)
        require(health_cycles >= 1, "health_cycles", health_cycles, "at least 1")
        self.probe_cycles = self.needed = probe_cycles
        self.most = probe_cycles << MOST_DOUBLINGS
        self.health_cycles = health_cycles
        self.wanted: str | None = None
        self._silence = _Silence(patience_ns)
        # Probes of the wanted placement that have not completed, oldest first.
        self._open: dict[int, None] = {}
        self._count = self._first = self._health = 0
        self._on_fallback = self._returned = False

    @classmethod
    def of(cls, problem: Problem) -> Probation:
        """Return the probation of a cell, which is healthy after `HEALTH_WINDOWS` windows."""
        return cls(
            problem.controller.probe_cycles,
            health_cycles=HEALTH_WINDOWS * problem.window_cycles,
            patience_ns=problem.longest_patience_ns,
        )

    def __repr__(self) -> str:
        return f"Probation({self._count} of {self.needed} through {self.wanted!r})"

    def want(self, candidate: str | None, first: int = 0) -> None:
        """Set the wanted placement; a change of it restarts counting.

        Parameters
        ----------
        first : int
            First cycle that counts as a probe.
        """
        if candidate != self.wanted:
            self.wanted, self._count, self._first = candidate, 0, first
            self._open.clear()
            self._silence.forget()

    def released(self, cycle: int, at_ns: int) -> None:
        """Record the release of a probe through the wanted placement."""
        self._look(at_ns)
        if cycle >= max(self._first, self._silence.released + 1):
            self._silence.release(cycle, at_ns)
            self._open[cycle] = None
            if len(self._open) > MOST_OPEN:
                del self._open[next(iter(self._open))]

    def completed(self, cycle: int, at_ns: int) -> None:
        """Record the completion of a probe through the wanted placement.

        Completions count in any order, but only once, and only for probes released since the
        placement became wanted.
        """
        self._look(at_ns, also_now=False)
        if cycle in self._open:
            del self._open[cycle]
            self._count += 1
            self._silence.complete(cycle)

    def done(self, now_ns: int) -> int:
        """Return the number of completed probes, at most h."""
        self._look(now_ns)
        return min(self._count, self.needed)

    def proven(self, candidate: str, now_ns: int) -> bool:
        """Whether an order for a candidate may leave the fallback."""
        return self.done(now_ns) == self.needed and candidate == self.wanted

    def _look(self, now_ns: int, *, also_now: bool = True) -> None:
        """Restart counting if the patience has ended."""
        if self._silence.over(now_ns if also_now else now_ns - 1):
            self._count = 0

    def fell(self) -> None:
        """Record that the guard has moved the cell to a fallback."""
        if self._returned:
            self.needed = min(2 * self.needed, self.most)
        self._on_fallback, self._returned, self._health = True, False, 0
        self.want(None)

    def left(self) -> None:
        """Record that an order has replaced the fallback."""
        self._on_fallback, self._returned, self._health = False, True, 0
        self.want(None)

    def healthy(self, cycles: int = 1) -> None:
        """Record completed cycles; ignore them on a fallback."""
        if self._on_fallback:
            return
        self._health += cycles
        stretches, self._health = divmod(self._health, self.health_cycles)
        if stretches:
            self._returned = False
            self.needed = max(self.needed >> stretches, self.probe_cycles)


class CellGuard(Guard):
    """The guard of a cell, with its signs of life, failures and probation.

    Parameters
    ----------
    problem : Problem
    placement : str, optional
        Candidate of the first cycles; the initial one by default.

    Attributes
    ----------
    presence : Presence
        Signs of life; the caller reports them.
    failures : Failures
        Cycles and shadows without a completion.
    probation : Probation
        Probes; the caller reports the wanted placement and the cycles completed under orders.
    """

    def __init__(self, problem: Problem, placement: str | None = None) -> None:
        settings, rates = problem.controller, problem.pipeline.rates
        self._sink_rates = {rates[name] for name in problem.pipeline.sinks}
        super().__init__(
            settings.fallbacks,
            patience_ns=problem.guard_patience_ns,
            probe_cycles=settings.probe_cycles,
            placement=placement or problem.initial,
            chains=problem.chain_patiences,
        )
        self.presence, self.failures = Presence.of(problem), Failures.of(problem)
        self.probation = Probation.of(problem)

    @property
    def probed(self) -> str | None:
        """Candidate of the probes: the wanted one, or the first of its members not in force."""
        wanted = self.probation.wanted
        members = self.presence.members.get(wanted or "", ())
        return next((name for name in members if name != self.placement), wanted)

    def sent(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Record the release of a cycle through a candidate; a cycle without a sink is idle."""
        is_idle = all(cycle % rate for rate in self._sink_rates)
        self.released(cycle, at_ns, is_idle=is_idle)
        if not is_idle:
            self.failures.released(candidate, cycle, at_ns)

    def shadow_sent(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Record the release of the shadow of a cycle through a candidate."""
        self.failures.released(candidate, cycle, at_ns)
        if candidate == self.probed:
            self.probation.released(cycle, at_ns)

    def arrived(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Record the completion of a cycle through a candidate."""
        self.failures.completed(candidate, cycle)
        # Ignore a later cycle that was released through another placement than the current one.
        if candidate == self.placement or cycle <= self._since:
            self.completed(cycle, at_ns)

    def acted(self, chain: str, origin: int, candidate: str) -> None:
        """Record an actuation of a guarded chain.

        Parameters
        ----------
        origin : int
            Oldest cycle from which the actuation descends.
        candidate : str
            Placement of that cycle.
        """
        if candidate == self.placement or origin <= self._since:
            self.actuated(chain, origin)

    def shadow_arrived(self, cycle: int, at_ns: int, candidate: str) -> None:
        """Record the completion of a shadow through a candidate."""
        self.failures.completed(candidate, cycle)
        if candidate == self.probed:
            self.probation.completed(cycle, at_ns)

    def look(self, now_ns: int) -> str | None:
        """Return the fallback to try, if the cell has to move now; see `check`."""

        def heard(name: str) -> bool:
            return self.presence.whole(name, now_ns)

        def whole(name: str) -> bool:
            return heard(name) and not self.failures.failing(name, now_ns)

        return self.check(now_ns, whole, heard)

    def adopt(self, candidate: str, fallback: bool = False) -> None:
        """Record a move (see `Guard.adopt`), and update the probation."""
        left = self.on_fallback and not fallback
        super().adopt(candidate, fallback)
        if fallback:
            self.probation.fell()
        elif left:
            self.probation.left()
