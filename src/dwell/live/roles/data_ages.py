"""Data ages and reaction times of a live cell's chains, from the origins that its messages carry.

An actuation is the completion of a job of the chain's last task; of a sink task it is the arrival
of the command at the gate. Its age counts from the release of the oldest cycle of the chain's first
task from which it descends. docs/background/simulator.md has the rules, under "Chains".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from dwell.control import (
    NO_AGE,
    age_l95_ms,
    age_missed,
    final_l95_ms,
    mean_age_ms,
    reactions,
)
from dwell.live.roles.cycle_ledger import Ledger, LiveCycle
from dwell.live.roles.origins import last_job, origin_of
from dwell.live.wire.messages import NOT_APPLIED, STALE, Origin
from dwell.model import Chain, FrozenDict, Problem
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints
from dwell.record import Values


class KnownOrigins(NamedTuple):
    """Cycles from which the actuations of a chain before a window descend.

    Parameters
    ----------
    oldest_ns : int
        Release of the origin of the last actuation.
    newest : int or None
        The newest cycle from which one of them descends.
    released_ns : dict of int to int
        Release of this cycle and of later cycles of the window before.
    """

    oldest_ns: int = 0
    newest: int | None = None
    released_ns: Mapping[int, int] = FrozenDict()


class Actuation(NamedTuple):
    """An actuation of a chain: its cycle's place, its instant, and its origin.

    `born_ns` is the release of its origin, and `newest` the newest cycle, or None.
    """

    place: int
    at_ns: int
    born_ns: int
    newest: int | None

    @property
    def age_ns(self) -> int:
        """Data age."""
        return max(self.at_ns - self.born_ns, 0)


class DataAges:
    """Data ages and reaction times in windows.

    An actuation that descends from no cycle has the origin of the actuation before it; `known` has
    the origins of the closed windows, by chain.
    """

    def __init__(self, problem: Problem, ledger: Ledger) -> None:
        pipeline, objective = problem.pipeline, problem.objective
        self._chains, self._ledger = pipeline.chains, ledger
        self._sinks, self._rates = frozenset(pipeline.sinks), pipeline.rates
        self._period_ns, self._censor_ms = pipeline.period_ns, problem.censor_ms
        self._max_age_ms = max(map(problem.max_age_ms, pipeline.sinks))
        self._latency, self._weighs_age = objective.latency, objective.weighs_age
        self.known: Mapping[str, KnownOrigins] = dict.fromkeys(self._chains, KnownOrigins())

    @property
    def reach_ns(self) -> int:
        """Time before a window in which a cycle's command may count in the window's mean age.

        A cycle that waits may take a value that is newer than itself, until its command is too old.
        """
        reach_ms = self._censor_ms + self._max_age_ms
        return round(reach_ms * 1e6) * (self._weighs_age or self._latency is not None)

    def closed(self, cycles: Sequence[LiveCycle]) -> None:
        """Record the cycles of a window, or between windows, whose end has come."""
        self.known = self.after(cycles, self.known)

    def after(
        self, cycles: Sequence[LiveCycle], known: Mapping[str, KnownOrigins]
    ) -> Mapping[str, KnownOrigins]:
        """Return the origins known after a window; `known` as it was before the window."""
        found: dict[str, KnownOrigins] = {}
        for name in self._chains:
            before = known[name]
            acted = self._actuations(name, cycles, before)
            ends = before.newest, *(one.newest for one in acted)
            newest = max((one for one in ends if one is not None), default=None)
            later = {one.number: one.at_ns for one in cycles if one.number >= (newest or 0)}
            oldest_ns = acted[-1].born_ns if acted else before.oldest_ns
            found[name] = KnownOrigins(oldest_ns, newest, later)
        return found

    def judge(
        self, cycles: Sequence[LiveCycle], close_ns: int, known: Mapping[str, KnownOrigins]
    ) -> None:
        """Set the age in J of some cycles, and whether data were over age by `close_ns`."""
        for cycle in cycles if self._chains else ():
            cycle.over_age, cycle.acted_ns = False, None
        for name, chain in self._chains.items():
            if not (chain.is_bounded or name == self._latency):
                continue
            for one in self._actuations(name, cycles, known[name]):
                cycle = cycles[one.place]
                if chain.is_bounded and one.at_ns <= close_ns:
                    cycle.over_age |= one.age_ns > chain.max_age_ns
                if name == self._latency:
                    cycle.acted_ns = one.at_ns - cycle.at_ns, one.age_ns

    def values(self, cycles: Sequence[LiveCycle], known: Mapping[str, KnownOrigins]) -> Values:
        """Return the columns of a window; `known` as it was before the window."""
        found: dict[str, object] = {}
        for name, chain in self._chains.items():
            before = known[name]
            acted = self._actuations(name, cycles, before)
            ages_ns = _by_cycle(acted, len(cycles))[None]
            found[f"age_l95_{name}"] = float(age_l95_ms(ages_ns)[0])
            found[f"age_missed_{name}"] = float(age_missed(ages_ns, chain.max_age_ns)[0])
            after_ns = self._reactions(chain, cycles, acted, before)
            l95_ms = float(final_l95_ms(np.array(after_ns))) if after_ns else np.inf
            found[f"reaction_l95_{name}"] = l95_ms
        return found

    def _reactions(
        self,
        chain: Chain,
        cycles: Sequence[LiveCycle],
        acted: Sequence[Actuation],
        before: KnownOrigins,
    ) -> list[int]:
        """Return the reaction times that end at actuations in some cycles.

        Unknown releases count as regular. If no origin is known before these cycles, releases
        before them do not count.
        """
        every, first = self._rates[chain.source], cycles[0]
        at_ns, newest_of = np.full((2, len(cycles)), NEVER_NS)
        for one in acted:
            at_ns[one.place] = one.at_ns
            newest_of[one.place] = -1 if one.newest is None else one.newest
        released_ns = {**before.released_ns, **{cycle.number: cycle.at_ns for cycle in cycles}}
        since = before.newest
        if since is None:
            since = -(-first.number // every) * every
        waits = reactions(at_ns, newest_of, every, since)
        return [
            int(at_ns[place])
            - released_ns.get(one, first.at_ns + (one - first.number) * self._period_ns)
            for one, place in zip(*(found.tolist() for found in waits), strict=True)
        ]

    def seen(
        self, recent: Sequence[LiveCycle], cycles: Sequence[LiveCycle], close_ns: int
    ) -> tuple[Ints | None, float | None]:
        """Return the ages that J needs of some cycles, as known at their end.

        Parameters
        ----------
        recent : list of LiveCycle
            All cycles since `reach_ns` before the first of `cycles`.

        Returns
        -------
        ages_ns, age_ms
            As in `ClosedWindow`.
        """
        name, acted = self._latency, list[Actuation]()
        if name is not None:
            acted = self._actuations(name, recent, self.known[name])
            acted = [one for one in acted if one.at_ns <= close_ns]
        elif self._weighs_age:
            done = [(place, one) for place, one in enumerate(recent) if one.latency_ns < NEVER_NS]
            acted = [Actuation(i, one.at_ns + one.latency_ns, one.at_ns, None) for i, one in done]
        age_ms = None
        if self._weighs_age:
            applied = (one for one in acted if not recent[one.place].came_to(NOT_APPLIED, STALE))
            commands = sorted(applied, key=lambda one: -one.place)
            ends = cycles[0].at_ns, close_ns
            pairs = ((one.at_ns, one.born_ns) for one in commands)
            age_ms = mean_age_ms(pairs, *ends, self._censor_ms)
        if name is None:
            return None, age_ms
        begin = recent.index(cycles[0])
        return _by_cycle(acted, len(recent))[begin : begin + len(cycles)], age_ms

    def cycle_values(self, cycle: LiveCycle) -> Values:
        """Return the columns of a cycle, if a chain counts as latency."""
        if self._latency is None:
            return {}
        latency_ns, age_ns = cycle.acted_ns or (None, None)
        return {"chain_latency_ns": latency_ns, "chain_age_ns": age_ns}

    def _actuations(
        self, name: str, cycles: Sequence[LiveCycle], known: KnownOrigins
    ) -> list[Actuation]:
        """Return the actuations of a chain in some cycles, by instant, then by cycle."""
        chain, born_ns, acted = self._chains[name], known.oldest_ns, list[Actuation]()
        found = ((place, self._actuation(chain, cycle)) for place, cycle in enumerate(cycles))
        timed = [(one[0], place, one[1]) for place, one in found if one is not None]
        for at_ns, place, origin in sorted(timed, key=lambda one: one[:2]):
            if origin is not None:
                born_ns = origin.released_ns - cycles[place].origin_ns
            newest = None if origin is None else origin.newest
            acted.append(Actuation(place, at_ns, born_ns, newest))
        return acted

    def _actuation(self, chain: Chain, cycle: LiveCycle) -> tuple[int, Origin | None] | None:
        """Return the instant and the origin of an actuation; None if unknown."""
        task = chain.target
        done = cycle.reports.get(task)
        if task in self._sinks and done is None:
            return None
        reports = cycle.all_reports if done is None else (done,)
        hop = next((job for one in reports if (job := last_job(one, task)) is not None), None)
        if hop is None:
            return None
        end = (hop.node, hop.ended_ns) if done is None else (done.node, done.done_ns)
        at_ns = self._ledger.instant_ns(cycle, *end)
        if at_ns is None:
            if cycle.latency_ns >= NEVER_NS:
                return None
            at_ns = cycle.at_ns + cycle.latency_ns
        return at_ns, origin_of(hop, chain.source)


def _by_cycle(acted: Iterable[Actuation], count: int) -> Ints:
    """Return the age in each of `count` cycles, `NO_AGE` without an actuation."""
    ages_ns = np.full(count, NO_AGE, np.int64)
    for one in acted:
        ages_ns[one.place] = one.age_ns
    return ages_ns
