"""Data ages of the chains of a live cell, from the origins that its messages carry.

An actuation is the completion of a job of the chain's last task; of a sink task it is the arrival
of the command at the gate. Its age counts from the release of the oldest cycle of the chain's first
task from which it descends. docs/background/simulator.md has the rules, under "Chains".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import count

import numpy as np

from dwell.control import NO_AGE, age_l95_ms, age_missed
from dwell.live.roles.cycle_ledger import Ledger, LiveCycle
from dwell.live.roles.origins import last_job, origin_of
from dwell.model import Chain, Problem
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints
from dwell.record import Values


class DataAges:
    """Data ages in windows.

    An actuation that descends from no cycle has the origin of the actuation before it; `known` has
    the release of the last one of the closed windows, by chain.
    """

    def __init__(self, problem: Problem, ledger: Ledger) -> None:
        self._chains, self._ledger = problem.pipeline.chains, ledger
        self._sinks = frozenset(problem.pipeline.sinks)
        self.known: Mapping[str, int] = {}

    def closed(self, cycles: Sequence[LiveCycle]) -> None:
        """Record a window whose end has come."""
        if self._chains:
            last = {name: self._ages(chain, cycles, 0)[1] for name, chain in self._chains.items()}
            self.known = {**self.known, **{name: at for name, at in last.items() if at}}

    def judge(self, cycles: Sequence[LiveCycle], close_ns: int, known: Mapping[str, int]) -> None:
        """Mark the cycles in which an actuation before the end of their window was over age."""
        bounded = {n: one for n, one in self._chains.items() if one.is_bounded}
        for cycle in cycles if bounded else ():
            cycle.over_age = False
        for name, chain in bounded.items():
            ages_ns, _ = self._ages(chain, cycles, known.get(name, 0), until_ns=close_ns)
            for cycle, age_ns in zip(cycles, ages_ns.tolist(), strict=True):
                cycle.over_age |= age_ns > chain.max_age_ns

    def values(self, cycles: Sequence[LiveCycle], known: Mapping[str, int]) -> Values:
        """Return the columns of a window; `known` as it was before the window."""
        found: dict[str, object] = {}
        for name, chain in self._chains.items():
            ages_ns = self._ages(chain, cycles, known.get(name, 0))[0][None]
            found[f"age_l95_{name}"] = float(age_l95_ms(ages_ns)[0])
            found[f"age_missed_{name}"] = float(age_missed(ages_ns, chain.max_age_ns)[0])
        return found

    def _ages(
        self,
        chain: Chain,
        cycles: Sequence[LiveCycle],
        origin_ns: int,
        until_ns: int = NEVER_NS,
    ) -> tuple[Ints, int]:
        """Return the ages of a chain by cycle, `NO_AGE` without one, and the last origin."""
        ages_ns = np.full(len(cycles), NO_AGE, np.int64)
        actuated = [(*found, place) for place, found in self._actuations(chain, cycles)]
        for at_ns, origin, place in sorted(actuated, key=lambda one: (one[0], one[2])):
            if at_ns > until_ns:
                break
            origin_ns = origin_ns if origin is None else origin
            ages_ns[place] = max(at_ns - origin_ns, 0)
        return ages_ns, origin_ns

    def _actuations(
        self, chain: Chain, cycles: Sequence[LiveCycle]
    ) -> list[tuple[int, tuple[int, int | None]]]:
        found = zip(count(), (self._actuation(chain, cycle) for cycle in cycles), strict=False)
        return [(place, one) for place, one in found if one is not None]

    def _actuation(self, chain: Chain, cycle: LiveCycle) -> tuple[int, int | None] | None:
        """Return the instant of an actuation and the release of its origin; None if unknown."""
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
        origin = origin_of(hop, chain.source)
        return at_ns, None if origin is None else origin.released_ns - cycle.origin_ns
