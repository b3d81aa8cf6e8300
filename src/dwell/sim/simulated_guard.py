"""The guard in the simulator: when it looks, what it finds whole, and the probes of the return."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dwell.control import (
    FallbackRound,
    Presence,
    Probation,
    parts_of,
    rest_cycles,
)
from dwell.kernels.advance import post_event
from dwell.kernels.arrays import Arrays
from dwell.kernels.codes import LAST_NS, CycleOutcome, EventKind, make_key
from dwell.kernels.realisation import LinkSegments, NodeChanges, Realisation
from dwell.kernels.rows import Row
from dwell.model import Problem
from dwell.model.instants import EVIDENCE_NS, HORIZON_NS, NEVER_NS


class SimulatedGuard:
    """The guard of one cell: the event loop says when it fires, this says what then.

    Parameters
    ----------
    problem : Problem
        With fallbacks.
    arrays : Arrays
        The simulation about to be played; the guard is armed in it.
    """

    def __init__(self, problem: Problem, realisation: Realisation, arrays: Arrays) -> None:
        self.problem, self.arrays = problem, arrays
        self.release_ns, self.cycles = realisation.release_ns, realisation.cycles
        self.names = tuple(problem.candidates)
        period_ns = round(problem.pipeline.period_ms * 1e6)
        self.patience_ns = min(problem.controller.guard_cycles * period_ns, HORIZON_NS)
        self.presence_ns = Presence.of(problem).within_ns
        self.probation = Probation.of(problem)
        self.probes = _Probes(realisation, arrays)
        self.since: int | None = 0
        self._round = FallbackRound(problem.controller.fallbacks)
        # What the guard itself has moved to, with its first cycle, until an order takes effect;
        # and what carried the cell until then.
        self._own: tuple[str, int] | None = None
        self._carrier: str | None = None
        # Rests since the last order; first cycle after the one that a round has ended with.
        self._rests = 0
        self._spent_until: int | None = None
        self._outages = _Outages(problem, realisation)
        self._arm(0, rest=0)

    @property
    def _cell(self) -> Row:
        """The cell's row in the kernel."""
        return self.arrays.tables.cells[0]

    @property
    def on_fallback(self) -> bool:
        """Whether the guard's own move holds."""
        return self.since is None

    def _arm(self, first: int, *, rest: int) -> None:
        """Wait for the completions of the cycles from `first` on, and of none before.

        Once one has completed, of those after the first `rest` cycles alone.
        """
        cell = self._cell
        cell["patience_ns"] = self.patience_ns
        cell["waited"] = cell["moved"] = min(first, self.cycles)
        cell["rested"] = min(first + rest, self.cycles)
        if first < self.cycles:
            self._look_at(self._due_ns(first))

    def _due_ns(self, first: int) -> int:
        """Instant at which the guard fires if no cycle from `first` on completes."""
        if first >= self.cycles:
            return LAST_NS
        return min(int(self.release_ns[first]) + self.patience_ns, LAST_NS)

    def _look_at(self, at_ns: int) -> None:
        """Look at an instant, and not before."""
        self._cell["looks_ns"] = at_ns
        post_event(self.arrays, at_ns, make_key(EventKind.GUARD))

    def fire(self, now: int, active: str) -> str | None:
        """Return the fallback that the cell moves to now; None where it has to wait for one.

        It waits where its own node is down, or was since the release of the cycle it waits for,
        until cycles released since then are missing; and where no fallback is left to be tried,
        until one is there, or the rest is over.
        """
        first = self._released(now)
        carrier = self._settle(now, first)
        if self._waits(now, first):
            return None

        def there(name: str) -> bool:
            since_ns = now - self.presence_ns
            return not any(self._outages.missing(part, since_ns, now) for part in self._parts(name))

        def whole(name: str) -> bool:
            return there(name) and not self._failing(name, now, first)

        fallback = self._round.next(active, whole, there, carrier)
        if fallback is None:
            if self._tries(now, first) and self._round.begun:
                rest = rest_cycles(self.probation.probe_cycles, self._rests)
                self._spent_until = min(first + rest, self.cycles)
                self._cell["rested"] = self._spent_until
            self._look_later(now, self._round.options(active, carrier))
        return fallback

    def _released(self, now: int) -> int:
        """Return how many cycles were released before an instant."""
        return int(np.searchsorted(self.release_ns[: self.cycles], now))

    def _settle(self, now: int, first: int) -> str | None:
        """Begin anew where an order has taken effect; returns what carried the cell before it."""
        since = self.since
        if since is None or since >= first:
            return None
        self._round.over()
        self._rests, self._spent_until = 0, None
        if self._own is not None:
            fallback, begun = self._own
            carried = self._newest(begun, since, int(self.release_ns[since])) >= 0
            self._own, self._carrier = None, fallback if carried else None
        recent = self._newest(since, first, now) < since + self.probation.probe_cycles
        return self._carrier if recent else None

    def _waits(self, now: int, first: int) -> bool:
        """Whether it is too early to move: the guard rests, or its own node has been away."""
        cell, own = self._cell, self._outages.of(self.problem.stamper_node)
        back_ns = max((up for down, up in own if down <= now), default=0)
        if self._carries(now, first):
            self._round.over()
            self._spent_until = None
            cell["waited"] = max(cell["waited"], cell["rested"])
        spent = self._spent_until
        waited = int(cell["waited"]) if spent is None else spent
        if waited < self.cycles and back_ns > self.release_ns[waited]:
            waited = self._released(back_ns)
        due_ns = self._due_ns(waited)
        if spent is None:
            cell["waited"] = waited
            if due_ns > now:
                self._look_at(due_ns)
            return due_ns > now
        self._spent_until = waited
        if back_ns > now:
            self._look_at(back_ns)
            return True
        if due_ns <= now:
            self._round.again()
        return False

    def _look_later(self, now: int, options: Iterable[str]) -> None:
        """Look again when what may be tried is back, or a rest is over, or an order was in vain."""
        ends = (
            up for name in options for part in self._parts(name) for _, up in self._outages.of(part)
        )
        waited = [int(self._cell["moved"]), self._spent_until]
        dues = (self._due_ns(cycle) for cycle in waited if cycle is not None)
        again = min((at for at in (*ends, *dues) if at > now), default=LAST_NS)
        if again < LAST_NS:
            self._look_at(again)

    def _heard(self, first: int, stop: int, now: int) -> NDArray[np.bool_]:
        """Return which of some cycles have been heard to complete by an instant."""
        tables, cycles = self.arrays.tables, slice(first, stop)
        code = tables.stamps[0, cycles].astype(np.int64)
        ended = self.release_ns[cycles] + tables.latency_ns[0, cycles]
        done = tables.outcome[0, cycles] == CycleOutcome.DONE
        return np.asarray(done & (ended <= now - tables.back_ns[code]))

    def _newest(self, first: int, stop: int, now: int) -> int:
        """Return the highest of some cycles that has been heard to complete; -1 for none."""
        heard = np.flatnonzero(self._heard(first, stop, now))
        return first + int(heard[-1]) if len(heard) else -1

    def _carries(self, now: int, first: int) -> bool:
        """Whether what the guard has moved to has completed a cycle."""
        return self._own is not None and self._newest(self._own[1], first, now) >= 0

    def _tries(self, now: int, first: int) -> bool:
        """Whether a fallback is being tried, and has not carried the cell yet."""
        spent = self._spent_until is not None
        return self._own is not None and not spent and not self._carries(now, first)

    def _failing(self, name: str, now: int, first: int) -> bool:
        """Whether the last k cycles and shadows through a candidate failed, none of them long ago.

        As `dwell.control.Failures`.
        """
        code, failed = self.names.index(name), 0
        for cycle in range(first - 1, -1, -1):
            released_ns = int(self.release_ns[cycle])
            cells = np.flatnonzero(self.arrays.tables.stamps[:, cycle] == code)
            if released_ns < now - EVIDENCE_NS:
                break
            if not len(cells):
                continue
            if self._completed(int(cells[0]), cycle, now):
                break
            failed += released_ns <= now - self.patience_ns
            if failed == self.problem.controller.failures_in_a_row:
                return True
        return False

    def _completed(self, cell: int, cycle: int, now: int) -> bool:
        """Whether a cycle, or its shadow, has been heard to complete by an instant."""
        if cell == 0:
            return bool(self._heard(cycle, cycle + 1, now)[0])
        heard_ns = self.probes.heard_ns(cycle)
        return heard_ns is not None and heard_ns <= now

    def _parts(self, name: str) -> Iterable[str]:
        return sorted(parts_of(self.problem, name))

    def fell(self, now: int, first: int, left: str, to: str) -> None:
        """Note that the cell has moved to a fallback, which is stamped from a cycle on."""
        self._note_health(now)
        self.probation.fell()
        self._rests += not self._tries(now, first)
        self._round.moved(left, to)
        # An order that has not stamped a cycle yet is void.
        self._own, self._carrier, self.since = (to, first), None, None
        self._spent_until = None
        self._arm(first, rest=rest_cycles(self.probation.probe_cycles, self._rests))

    def moved(self, first: int) -> None:
        """Take note of an order that takes effect at a cycle."""
        if self.since is None:
            self.probation.left()
            self.probes.end(first)
            self.since = first
        cell = self._cell
        # Cycles before are waited for, but those for which it still rests.
        cell["waited"] = min(max(cell["waited"], cell["moved"]), first)
        cell["rested"] = min(cell["rested"], first)
        cell["moved"] = first
        # Other fallbacks may be open to the new placement than those that were not whole.
        due_ns, next_ns = self._due_ns(first), int(cell["looks_ns"])
        if due_ns < LAST_NS and not 0 <= next_ns <= due_ns:
            self._look_at(due_ns)

    def _note_health(self, now: int) -> None:
        """Count what was heard to complete since the cell has been under orders."""
        if self.since is None:
            return
        heard = self._heard(self.since, self._released(now), now)
        self.probation.healthy(int(np.count_nonzero(heard)))

    def proven(self, now: int) -> str | None:
        """Return the candidate that probes have proven by now."""
        wanted = self.probation.wanted
        if not self.on_fallback or wanted is None:
            return None
        for at_ns, completed, cycle in self.probes.news(now):
            if completed:
                self.probation.completed(cycle, at_ns)
            else:
                self.probation.released(cycle, at_ns)
        return wanted if self.probation.proven(wanted, now) else None

    def want(self, name: str | None, first: int) -> None:
        """Send every cycle from `first` on through what is wanted, too."""
        if name != self.probation.wanted:
            self.probation.want(name)
            self.probes.begin(None if name is None else self.names.index(name), first)


class _Outages:
    """Outages of nodes, links and workers."""

    def __init__(self, problem: Problem, realisation: Realisation) -> None:
        self.problem = problem
        self._changes = NodeChanges.of(realisation.node_changes)
        self._segments = LinkSegments.of(realisation.link_segments)
        self._known: dict[str, list[tuple[int, int]]] = {}

    def of(self, part: str) -> list[tuple[int, int]]:
        """Return the outages of a node, a link or a worker: from when, until when."""
        if part not in self._known:
            self._known[part] = list(self._find(part))
        return self._known[part]

    def missing(self, part: str, since_ns: int, now: int) -> bool:
        """Whether a part could not be heard from `since_ns` until now."""
        return any(down <= since_ns and now < up for down, up in self.of(part))

    def _find(self, part: str) -> Iterator[tuple[int, int]]:
        task, at, node = part.partition("@")
        if at:
            start_ns = round(self.problem.pipeline.tasks[task].start_ms * 1e6)
            return _joined((down, up + start_ns) for down, up in self.of(node))
        if part in self.problem.fabric.nodes:
            nodes, table = self._changes.nodes, self._changes.table
            mine = table[table[:, 1] == nodes.index(part)] if part in nodes else table[:0]
            return _joined(_intervals(mine[:, 0], mine[:, 3]))
        links, table = self._segments.links, self._segments.table
        mine = table[table[:, 1] == links.index(part)] if part in links else table[:0]
        return _joined(_intervals(mine[:, 0], mine[:, 2]))


def _intervals(at_ns: NDArray[np.int64], down: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield from when until when something is down."""
    begun: int | None = None
    for at, is_down in zip(at_ns.tolist(), down.tolist(), strict=True):
        if is_down and begun is None:
            begun = at
        elif not is_down and begun is not None:
            yield begun, at
            begun = None
    if begun is not None:
        yield begun, LAST_NS


def _joined(intervals: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Join intervals of which one begins before the other has ended."""
    last: tuple[int, int] | None = None
    for down, up in intervals:
        if last is not None and down <= last[1]:
            last = (last[0], max(up, last[1]))
            continue
        if last is not None:
            yield last
        last = (down, up)
    if last is not None:
        yield last


@dataclass(slots=True)
class _ProbeRequest:
    """Cycles from `first` on are also sent through a candidate; through none where it is None."""

    first: int
    code: int | None


class _Probes:
    """Probes: the cycles that are sent as probes, and their completions."""

    def __init__(self, realisation: Realisation, arrays: Arrays) -> None:
        self.arrays = arrays
        self.release_ns, self.cycles = realisation.release_ns, realisation.cycles
        self._requests: list[_ProbeRequest] = []
        self._open: list[int] = []
        self._next = 0

    def begin(self, code: int | None, first: int) -> None:
        """Send cycles from `first` on through another candidate, or no longer."""
        self._requests = [
            *(request for request in self._requests if request.first < first),
            _ProbeRequest(first, code),
        ]
        self._open, self._next = [], first

    def end(self, first: int) -> None:
        """Send none from `first` on."""
        if self._requests:
            self.begin(None, first)

    def stamp(self, start: int, stop: int) -> None:
        """Stamp the probes among some cycles; the others keep what they have."""
        stamps = self.arrays.tables.stamps
        for i, request in enumerate(self._requests):
            until = self._requests[i + 1].first if i + 1 < len(self._requests) else self.cycles
            if request.code is not None:
                stamps[1, max(start, request.first) : min(stop, until, self.cycles)] = request.code

    def news(self, now: int) -> list[tuple[int, bool, int]]:
        """Return what has happened to probes: when, whether they completed, and which cycle.

        In the order of time, completions first, unless one comes with the release; each once.
        """
        last = int(np.searchsorted(self.release_ns[: self.cycles], now))
        release_ns = self.release_ns
        found = [(int(release_ns[cycle]), False, cycle) for cycle in range(self._next, last)]
        unknown = [*self._open, *range(self._next, last)]
        self._next, self._open = max(self._next, last), []
        for cycle in unknown:
            heard_ns = self.heard_ns(cycle)
            if heard_ns is not None and heard_ns <= now:
                found.append((heard_ns, True, cycle))
            elif heard_ns is not None or self._under_way(cycle):
                self._open.append(cycle)

        def order(news: tuple[int, bool, int]) -> tuple[int, int, int]:
            at_ns, completed, cycle = news
            return at_ns, (2 if at_ns == release_ns[cycle] else 0) if completed else 1, cycle

        return sorted(found, key=order)

    def heard_ns(self, cycle: int) -> int | None:
        """Instant at which the completion of a probe is heard, None if it has not completed.

        All sinks have their inputs then; one that it shares with its cycle must have completed.
        """
        tables = self.arrays.tables
        latency_ns = int(tables.latency_ns[1, cycle])
        if latency_ns >= NEVER_NS:
            return None
        back_ns = tables.back_ns[tables.stamps[1, cycle]]
        return int(self.release_ns[cycle]) + latency_ns + int(back_ns)

    def _under_way(self, cycle: int) -> bool:
        """Whether anything of a cycle or its probe may still happen."""
        tables = self.arrays.tables
        n_slots = len(tables.slots) // 2
        slots = tables.slots[[cycle % n_slots, n_slots + cycle % n_slots]]
        return bool(((slots["cycle"] == cycle) & (slots["live"] > 0)).any())
