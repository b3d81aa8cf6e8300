"""The guard in the simulator: its wake-ups, its observations and its probes."""

from __future__ import annotations

from functools import cached_property
from itertools import permutations, repeat, zip_longest

import numpy as np
from numpy.typing import NDArray

from dwell.control import CellGuard
from dwell.control.guard import MOST_OPEN
from dwell.kernels.advance import post_event
from dwell.kernels.arrays import CellArrays, way_back_ns
from dwell.kernels.codes import LAST_NS, EventKind
from dwell.kernels.realisation import LinkSegments, NodeChanges, Realisation
from dwell.kernels.rows import Row
from dwell.model import Problem
from dwell.model.instants import EVIDENCE_NS, HORIZON_NS, NEVER_NS
from dwell.model.number_arrays import Ints


class SimulatedGuard:
    """Passes observations from the kernel's tables to a cell's guard when the kernel wakes it.

    The kernel wakes the guard at a set instant if the completion of no cycle from a set cycle on
    has been received until then; otherwise, when the cycle after the newest completed one is as old
    as the patience. The guard never fires before it wakes. It may wake too early, because the
    kernel does not model its rest. The problem must have fallbacks.
    """

    def __init__(self, problem: Problem, realisation: Realisation, arrays: CellArrays) -> None:
        self.problem, self.realisation, self.arrays = problem, realisation, arrays
        self.release_ns, self.cycles = realisation.release_ns, realisation.cycles
        self.names = tuple(problem.candidates)
        self.guard = CellGuard(problem)
        # First cycle of the controller's placements, None after a move of the guard; and first
        # cycle of the last order or move.
        self._ordered: int | None = 0
        self._moved = 0
        # Number of released cycles that the guard knows, and the instant of its last update.
        self._told, self._told_ns = 0, -1
        # Candidate that each cycle probes, -1 for none; number of cycles whose probes the probation
        # knows, and the instant of its last update.
        self._probes = np.full(self.cycles, -1, np.int16)
        self._probed, self._probed_ns = 0, -1
        self._chains = {name: _Actuations(problem, arrays, name) for name in self.guard.chains}
        self._cell["patience_ns"] = min(self.guard.patience_ns, HORIZON_NS)
        self._arm(-1)

    @property
    def _cell(self) -> Row:
        """The cell's row in the kernel."""
        return self.arrays.tables.cells[0]

    # --------------------------------------------------------------------------- waking

    def wake(self, now: int) -> str | None:
        """Return the fallback to move to now; None if the placement stays."""
        self._tell(now)
        own_node = self._outages[self.problem.stamper_node]
        if not any(down <= now < up for down, up in own_node):
            for part, outages in self._outages.items():
                heard_ns = next((down for down, up in outages if down <= now < up), now)
                self.guard.presence.heard(part, heard_ns)
            fallback = self.guard.look(now)
            if fallback is not None:
                self._fall(now, fallback)
                return fallback
        self._arm(now)
        return None

    def _fall(self, now: int, fallback: str) -> None:
        """Move to a fallback; an order that has not stamped a cycle yet is cancelled."""
        if self._ordered is not None:
            heard = self._heard_ns(self._ordered, self._told)[0] <= now
            self.guard.probation.healthy(int(np.count_nonzero(heard)))
        self.guard.adopt(fallback, fallback=True)
        self._probes[self._told :] = -1
        self._ordered, self._moved = None, self._told
        self._arm(now)

    def _arm(self, now: int) -> None:
        """Set the next wake-up: when the guard may fire next if nothing completes until then."""
        guard = self.guard
        instants = [self._due_ns(guard.waits_for), self._due_ns(self._moved)]
        if guard.due_ns is not None and guard.due_ns <= now:
            # The guard is due but no fallback works: wake when a node, link or worker is back.
            parts = {self.problem.stamper_node}
            parts.update(*(guard.presence.parts[name] for name in guard.options))
            instants += [up for part in parts for _, up in self._outages[part]]
        self._cell["waited"] = min(guard.waits_for, self.cycles)
        chain_dues = [
            self._due_ns(cycle, patience_ns)
            for waits_for, patience_ns in guard.chain_waits
            for cycle in (waits_for, self._moved)
        ]
        instants += chain_dues
        wakes_ns = min((at for at in instants if at > now), default=LAST_NS)
        # Completed cycles do not end the wait for a chain, so they must not put off a wake.
        is_over = any(self._due_ns(*wait) <= now for wait in guard.chain_waits)
        chain_ns = min((at for at in chain_dues if at > now), default=LAST_NS)
        self._cell["chain_due_ns"] = wakes_ns if is_over else chain_ns
        self._wake_at(wakes_ns)

    def _due_ns(self, cycle: int, patience_ns: int | None = None) -> int:
        """Return the instant at which a cycle is as old as a patience, by default for cycles."""
        if cycle >= self.cycles:
            return LAST_NS
        patience_ns = self.guard.patience_ns if patience_ns is None else patience_ns
        return min(int(self.release_ns[cycle]) + patience_ns, LAST_NS)

    def _wake_at(self, at_ns: int) -> None:
        """Replace the next wake-up."""
        self._cell["wakes_ns"] = at_ns
        if at_ns < LAST_NS:
            post_event(self.arrays, at_ns, EventKind.GUARD)

    def moved(self, first: int) -> None:
        """Record an order that takes effect at a cycle."""
        if self._ordered is None:
            # A move of the guard before that cycle is a relapse, too.
            self.guard.probation.left()
            self._probes[first:] = -1
            self._ordered = first
        self._moved = first
        cell = self._cell
        cell["waited"] = min(cell["waited"], first)
        chain_dues = [self._due_ns(first, patience_ns) for _, patience_ns in self.guard.chain_waits]
        cell["chain_due_ns"] = min([int(cell["chain_due_ns"]), *chain_dues])
        # The new placement may have other fallbacks.
        due_ns = min([self._due_ns(first), *chain_dues])
        if due_ns < cell["wakes_ns"]:
            self._wake_at(due_ns)

    # -------------------------------------------------------------------------- telling

    def _tell(self, now: int) -> None:
        """Update the guard with all events until now, including completions received right now.

        Only the first and the last new order matter: the first may leave a fallback, and the last
        is in force.
        """
        placed = self.arrays.tables.stamps[0, self._told : self._released(now)]
        before = self.names.index(self.guard.placement)
        orders = self._told + np.flatnonzero(np.diff(placed, prepend=before))
        stops = {int(self.release_ns[first]) for first in (*orders[:1], *orders[-1:])}
        own_node = self._outages[self.problem.stamper_node]
        back_ns = max((up for _, up in own_node if up <= now), default=-1)
        if back_ns > self._told_ns:
            stops.add(back_ns)
        for stop_ns in sorted({*stops, now}):
            self._tell_until(stop_ns)
            if stop_ns == back_ns:
                self.guard.restart()

    def _tell_until(self, now: int) -> None:
        """Update the guard with the relevant events of an interval without orders.

        Without orders, the order and the repetition of events have no effect.
        """
        guard = self.guard
        stop = self._released(now)
        origins = {
            name: chain.origins(self._told_ns, now, stop) for name, chain in self._chains.items()
        }
        newest = [max(found, default=-1) for found in origins.values()]
        first = min([self._first_to_tell(stop, now), *(max(one, self._told) for one in newest)])
        guard.passed(max(first - self._told, 0))
        stamps = self._sent(first, stop)
        for cycle in range(max(first, self._told), stop):
            at_ns, (own, *shadows) = int(self.release_ns[cycle]), stamps[:, cycle - first].tolist()
            if self.names[own] != guard.placement:
                guard.adopt(self.names[own])
            guard.sent(cycle, at_ns, self.names[own])
            for code in shadows:
                if code >= 0:
                    guard.failures.released(self.names[code], cycle, at_ns)
        for row, i in np.argwhere(self._heard_ns(first, stop) <= now).tolist():
            cycle, code = first + i, stamps.item(row, i)
            if row == 0:
                guard.arrived(cycle, now, self.names[code])
            elif code >= 0:
                guard.failures.completed(self.names[code], cycle)
        for name, found in origins.items():
            for origin in found:
                guard.acted(name, origin, self.names[self.arrays.tables.stamps[0, origin]])
        self._told, self._told_ns = stop, now

    def _first_to_tell(self, stop: int, now: int) -> int:
        """Return the first cycle before `stop` that the guard still needs.

        It needs no cycle that is too old, except the newest completed one, and none that precedes a
        completed cycle or shadow of the same candidate.
        """
        oldest = self._released(now - max(EVIDENCE_NS, self.guard.patience_ns))
        stamps = self._sent(oldest, stop)
        heard = self._heard_ns(oldest, stop) <= now
        own = np.arange(len(stamps))[:, np.newaxis] == 0
        first = stop
        for sent in (own, *(stamps == code for code in range(len(self.names)))):
            completed = np.flatnonzero((sent & heard).any(axis=0))[-1:]
            missing = np.flatnonzero((sent & ~heard).any(axis=0))[:1]
            matter = completed if len(completed) else missing
            first = min([first, *(oldest + matter).tolist()])
        begin = self.guard.newest + 1
        late = np.flatnonzero(self._heard_ns(begin, oldest)[0] <= now)
        return min(first, begin + int(late[-1])) if len(late) else first

    def _sent(self, first: int, stop: int) -> NDArray[np.int16]:
        """Return the candidates of cycles and of the shadows that count, -1 for none."""
        stamps = self.arrays.tables.stamps[:, first:stop]
        if len(stamps) == 1 or not self._rates_apart:
            return stamps
        own, shadows = stamps
        return np.stack((own, np.where(self._counts(first, stop), shadows, -1)))

    def _counts(self, first: int, stop: int) -> NDArray[np.bool_]:
        """Return whether the shadow of each cycle counts, if it has one."""
        own, shadows = self.arrays.tables.stamps[:, first:stop]
        cycles, counts = np.arange(first, first + len(own)), np.ones(len(own), np.bool_)
        for (active, other), rates in self._rates_apart.items():
            mine = (own == active) & (shadows == other)
            counts[mine] = (cycles[mine] % rates == 0).any(axis=0)
        return counts

    @cached_property
    def _rates_apart(self) -> dict[tuple[int, int], Ints]:
        """Rates of the tasks that are apart, by active and other candidate; shape (n, 1).

        A shadow counts only in cycles in which such a task is due. Pairs whose shadows all count
        are left out.
        """
        pipeline, found = self.problem.pipeline, {}
        placed, rates = list(self.problem.candidates.values()), pipeline.rates
        for (i, active), (j, other) in permutations(enumerate(placed), 2):
            apart = {rates[task] for task in pipeline.diverging(active.first, other.first)}
            if apart and 1 not in apart:
                found[i, j] = np.array(sorted(apart), np.int64)[:, np.newaxis]
        return found

    def _released(self, now: int) -> int:
        """Return the number of cycles released before an instant."""
        return int(np.searchsorted(self.release_ns[: self.cycles], now))

    def _heard_ns(self, first: int, stop: int) -> NDArray[np.int64]:
        """Return when the guard receives the completions of cycles and shadows, or `NEVER_NS`.

        A shadow is complete when all sinks have their inputs and every sink that it shares with its
        cycle has completed.
        """
        tables, cycles = self.arrays.tables, slice(first, stop)
        latency_ns = tables.latency_ns[:, cycles]
        back_ns = tables.back_ns[tables.stamps[:, cycles]]
        heard_ns = self.release_ns[cycles] + latency_ns + back_ns
        return np.where(latency_ns < NEVER_NS, heard_ns, NEVER_NS)

    # --------------------------------------------------------------------------- probes

    def proven(self, now: int) -> str | None:
        """Return the wanted candidate if its probes have proven it by now."""
        wanted = self.guard.probation.wanted
        if wanted is None:
            return None
        self._tell_probes(now)
        return wanted if self.guard.probation.proven(wanted, now) else None

    def _tell_probes(self, now: int) -> None:
        """Update the probation with all releases and completions of probes until now, by time."""
        probation, told, stop = self.guard.probation, self._probed, self._released(now)
        first = max(told - MOST_OPEN, 0)
        cycles = np.arange(first, stop)
        release_ns, heard_ns = self.release_ns[first:stop], self._heard_ns(first, stop)[1]
        counts = self._counts(first, stop)
        new = (heard_ns <= now) & ((heard_ns > self._probed_ns) | (cycles >= told)) & counts
        # At equal times completions precede releases, unless the completed cycle is released then.
        after = np.where(heard_ns == release_ns, 2, 0)
        known = cycles[told - first :][counts[told - first :]]
        sent = zip(self.release_ns[known].tolist(), repeat(1), known.tolist(), strict=False)
        completed = zip(
            *(column[new].tolist() for column in (heard_ns, after, cycles)), strict=True
        )
        for at_ns, when, cycle in sorted([*sent, *completed]):
            if when == 1:
                probation.released(cycle, at_ns)
            else:
                probation.completed(cycle, at_ns)
        self._probed, self._probed_ns = max(told, stop), now

    def want(self, name: str | None, first: int) -> None:
        """Send probes through the wanted candidate from the cycle `first` on."""
        if name != self.guard.probation.wanted:
            self.guard.probation.want(name, first)
            probed = self.guard.probed
            self._probes[first:] = -1 if probed is None else self.names.index(probed)
            self._probed = first

    def stamp(self, start: int, stop: int) -> None:
        """Stamp the probes among cycles; other cycles keep their shadows."""
        if self._probed:
            probes = self._probes[start:stop]
            stamps = self.arrays.tables.stamps[1, start : start + len(probes)]
            np.copyto(stamps, probes, where=probes >= 0)

    # -------------------------------------------------------------------------- outages

    @cached_property
    def _outages(self) -> dict[str, list[tuple[int, int]]]:
        """Outages of nodes, links and workers, as (start, end) in ns."""
        nodes = NodeChanges.of(self.realisation.node_changes)
        links = LinkSegments.of(self.realisation.link_segments)
        found = {}
        for part in frozenset[str]().union(*self.guard.presence.parts.values()):
            task, at, node = part.partition("@")
            start_ms = self.problem.pipeline.tasks[task].start_ms if at else 0.0
            if "->" in part:
                changes = links.table[:, [0, 2]][links.table[:, 1] == _row(links.links, part)]
            else:
                row = _row(nodes.nodes, node or part)
                changes = nodes.table[:, [0, 3]][nodes.table[:, 1] == row]
            found[part] = _outages(changes, round(start_ms * 1e6))
        return found


class _Actuations:
    """Actuations of a guarded chain, when the guard learns of them."""

    def __init__(self, problem: Problem, arrays: CellArrays, name: str) -> None:
        pipeline, self._arrays = problem.pipeline, arrays
        self._row, target = list(pipeline.chains).index(name), pipeline.chains[name].target
        placed = problem.candidates.values()
        self._back_ns = np.array([way_back_ns(problem, {one.first[target]}) for one in placed])
        # First cycle whose actuation the guard may not know yet.
        self._first = 0

    def origins(self, after: int, now: int, stop: int) -> list[int]:
        """Return the origins that the guard learns of after an instant until now.

        Parameters
        ----------
        stop : int
            Number of released cycles.
        """
        tables, cycles = self._arrays.tables, slice(self._first, stop)
        at_ns = tables.actuated_ns[0, self._row, cycles]
        heard_ns = np.where(
            at_ns < NEVER_NS, at_ns + self._back_ns[tables.stamps[0, cycles]], NEVER_NS
        )
        new = (heard_ns > after) & (heard_ns <= now)
        found: list[int] = np.unique(tables.actuated_from[0, self._row, cycles][new]).tolist()
        # Older cycles are over: the ring of the cycles in flight has other cycles in their places.
        over = stop - int(self._arrays.whole.tables.clock[0]["n_slots"])
        known = np.arange(self._first, stop) < over
        open_ = np.flatnonzero(~((heard_ns <= now) | (known & (at_ns == NEVER_NS))))
        self._first += int(open_[0]) if len(open_) else len(known)
        return found


def _row(names: tuple[str, ...], name: str) -> int:
    return names.index(name) if name in names else -1


def _outages(changes: NDArray[np.int64], start_ns: int) -> list[tuple[int, int]]:
    """Return outages as (start, end) in ns; each end includes the restart time `start_ns`.

    The rows of `changes` contain an instant, ascending, and whether the part is down from then on.
    """
    turns_ns = changes[np.diff(changes[:, 1], prepend=0) != 0, 0].tolist()
    outages: list[tuple[int, int]] = []
    for down, up in zip_longest(turns_ns[::2], turns_ns[1::2], fillvalue=LAST_NS):
        begun = outages.pop()[0] if outages and down <= outages[-1][1] else down
        outages.append((begun, min(up + start_ns, LAST_NS)))
    return outages
