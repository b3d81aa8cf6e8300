"""Learning: estimators that keep measured values of every part of a cycle."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import ClassVar, Self

import numpy as np

from dwell.estimators.evidence import Evidence
from dwell.estimators.link_rates import Rate, better_rate
from dwell.estimators.measured import Message, Part, sending_ns
from dwell.estimators.online import Online
from dwell.estimators.pool import Pool, least_deviations, share_error
from dwell.estimators.prices import SEED
from dwell.estimators.protocol import Support
from dwell.estimators.shadow_price import fraction_of
from dwell.estimators.slow_processes import unseen_error
from dwell.kernels.pools import ADDED, GROWN, PoolRows
from dwell.model.controller_settings import HALF_LIFE_WINDOWS
from dwell.model.number_arrays import Floats
from dwell.model.problem import Problem

#: Standard deviation of the logarithm of a price, one window after a changed part was measured.
WIDENING = 0.03
#: A link is faster than its rate if messages take less than this share of their sending time.
EARLY = 0.9


class Learning(Online):
    """Base of the estimators that keep a pool of values per part.

    `shadow_fraction` is the share of cycles sent through each alternative [default: the cell
    file's]. If the file sets `auto`, the share depends on the active candidate
    (`dwell.estimators.shadow_price`). `half_life_windows` is the unit of `MEMORY` and `UNSEEN`
    [default: the cell file's]; a value outside its range raises `ProblemError`.
    """

    #: Half-lives until newer values replace a measured value, and until a part without new
    #: measurements has its declared values again.
    MEMORY: ClassVar[float]
    UNSEEN: ClassVar[float]
    states_errors = True

    def __init__(
        self,
        problem: Problem,
        shadow_fraction: float | None = None,
        half_life_windows: float | None = None,
        seed: int = SEED,
    ) -> None:
        settings, self._given_fraction = problem.controller, shadow_fraction
        half_life = settings.half_life_windows if half_life_windows is None else half_life_windows
        HALF_LIFE_WINDOWS.check("half_life_windows", half_life)
        #: In decisions.
        decisions = half_life * problem.decisions_per_window
        self.memory, self.unseen = self.MEMORY * decisions, self.UNSEEN * decisions
        self.seed = seed
        self.start(problem)

    @classmethod
    def from_problem(cls, problem: Problem) -> Self:
        """Make the estimator with the settings of ``problem.controller``."""
        return cls(problem)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(shadow_fraction={self.shadow_fraction}, regimes={self.regimes})"
        )

    def start(self, problem: Problem) -> None:
        """Forget everything but the profile."""
        given = self._given_fraction
        self.shadow_fraction = fraction_of(problem) if given is None else given
        super().start(problem)
        #: Number of decisions learnt from.
        self._window = 0
        #: Links with changed delays, each with the decision of the last change.
        self._doubts: dict[str, int] = {}
        self._pools = {
            part: Pool(reference, isinstance(part, Message))
            for part, reference in self._player.declared.references.items()
        }
        groups = list(map(self._meter.numbers, self._parts.values()))
        padded = np.full((len(groups), max(map(len, groups))), -1)
        for row, numbers in zip(padded, groups, strict=True):
            row[: len(numbers)] = numbers
        self._rows = PoolRows([self._pools[part].rows for part in self._meter.parts], padded)

    def _take_in(self, evidence: Evidence) -> None:
        self._window += 1
        cycles = len(evidence.release_ns)
        changed = self._learn(cycles)
        # Without a change the names of the measured parts are unnecessary.
        measured = self._meter.found_parts if changed or self._doubts else []
        for pool in map(self._pools.__getitem__, self._otherwise_parts()):
            if pool.touched and self._window - pool.touched >= max(self.unseen, 1.0):
                pool.reset()
                self._has_changed = True
        links = self._links_of_other_rates(measured, changed, evidence)
        if links:
            of = [part for part in self._pools if isinstance(part, Message) and part.link in links]
            for part in of:
                self._pools[part].reset()
            self._meter.measure(evidence, self._threads, self._full)
            measured = self._meter.found_parts
            changed = [part for part in changed if part not in of]
            changed += self._learn(cycles, [part for part in of if part in measured])
            self._has_changed = True
        self._regimes += len(changed) + len(links)
        if changed:
            self._has_changed = True
            self._correct(changed, frozenset(measured))

    def _learn(self, cycles: int, only: Sequence[Part] | None = None) -> list[Part]:
        """Add values to the pools of their parts, or of some; return the changed parts."""
        changed = []
        # Number of comparisons of a part with its reference in one window of the cell.
        tests = len(self._pools) * max(self.problem.window_cycles / cycles, 1.0)
        least = least_deviations(tests)
        # Most pools have their declared values and need no decision.
        when = self._window, self.memory, cycles
        found, parts = self._meter.found, None if only is None else self._meter.numbers(only)
        for number, why in self._rows.learn(found, *when, least, parts):
            if why == GROWN:
                self._has_grown = True
                continue
            part = self._meter.parts[number]
            pool = self._pools[part]
            if why == ADDED:
                has_changed = pool.has_left(self._window, cycles, least)
            else:
                has_changed = pool.learn(found.values(number), *when, tests)
            if has_changed:
                changed.append(part)
            self._has_grown |= not pool.is_declared
        return changed

    def _links_of_other_rates(
        self, measured: Sequence[Part], changed: Sequence[Part], evidence: Evidence
    ) -> set[str]:
        """Set the rates of links whose messages show a new rate, and return the links."""
        links = set()
        for part in changed:
            if isinstance(part, Message):
                self._doubts[part.link] = self._window
        for link, since in self._doubts.items():
            after = self._window - since
            parts = [p for p in measured if isinstance(p, Message) and p.link == link]
            declared, now = self.problem.fabric.links[link].rate_mbps, self._rates.get(link)
            found = None
            if now is not None and self._is_faster(evidence, parts, now.mbps):
                found = Rate(declared)
            # Try after 0, 1, 2, 4, ... decisions.
            elif not after & (after - 1) and not all(self._pools[p].is_declared for p in parts):
                found = self._better_rate(link, parts, evidence)
            if found is not None:
                links.add(link)
                self._rates[link] = found
                self._meter.set_rate(link, found.mbps)
                if found.mbps == declared:
                    del self._rates[link]
        return links

    def _is_faster(self, evidence: Evidence, parts: Sequence[Message], mbps: float) -> bool:
        """Return whether messages of any part were faster than a rate allows."""
        times = self._meter.times(evidence)
        least = [(times[part], sending_ns(self.problem, part, mbps) / 1e6) for part in parts]
        return any(float(np.median(taken)) < EARLY * ms for taken, ms in least)

    def _better_rate(self, link: str, parts: Sequence[Message], evidence: Evidence) -> Rate | None:
        """Return a rate that explains the messages of a link better than its current rate."""
        references = {part: self._pools[part].reference for part in parts}
        references = {part: one for part, one in references.items() if one.usual < math.inf}
        if not references:
            return None

        def extra_ms(mbps: float) -> Floats:
            delays = self._meter.delays(evidence, link, mbps)
            extra = []
            for part, reference in references.items():
                late = (delays[part] > 0) | (reference.ordered[0] == 0)
                extra.append(np.where(late, delays[part] - reference.usual, np.nan))
            every: Floats = np.concatenate(extra)
            arrived: Floats = every[every != math.inf]
            return arrived

        known = np.concatenate([one.values - one.usual for one in references.values()])
        deviation_ms = float(np.abs(known[np.isfinite(known)]).mean())
        declared = self.problem.fabric.links[link].rate_mbps
        now = self._rates.get(link, Rate(declared)).mbps
        return better_rate(extra_ms, now, declared, deviation_ms)

    def _correct(self, changed: Sequence[Part], measured: frozenset[Part]) -> None:
        """Correct unmeasured parts by the changes of measured parts."""

    def _otherwise_parts(self) -> list[Part]:
        return [self._meter.parts[number] for number in self._rows.others()]

    def _otherwise(self) -> dict[Part, Floats]:
        return {part: self._pools[part].held for part in self._otherwise_parts()}

    def support(self) -> dict[str, Support]:
        """Return the support of each candidate's estimate: the support of its weakest part."""
        self._take_in_pending()
        now, every = self._window, self.problem.decisions_per_window
        return {
            name: Support(samples, (now - last) / every)
            for name, (samples, last) in zip(self._parts, self._rows.weakest(), strict=True)
        }

    def _widening(self, pool: Pool) -> float:
        """Return the deviation of the logarithm of a price due to the age of measurements."""
        if pool.is_declared:
            return 0.0
        return WIDENING * math.sqrt(max(self._windows_since(pool.last), 0))

    def _windows_since(self, decision: int) -> float:
        """Return the number of windows since a decision."""
        return (self._window - decision) / self.problem.decisions_per_window

    def _known_error(self, name: str, rate: float, parts: Collection[Part]) -> tuple[float, float]:
        sent_ms = [
            sending_ns(self.problem, part, found.mbps) / 1e6 * found.error
            for part in (parts if self._rates else ())
            if isinstance(part, Message) and (found := self._rates.get(part.link)) is not None
        ]
        measured = [pool for part in parts if not (pool := self._pools[part]).is_declared]
        if not measured:
            return math.hypot(*sent_ms), 0.0
        l95_ms = math.hypot(*(pool.error_ms for pool in measured), *sent_ms)
        lost = [
            share_error(share, max(pool.measured, 1)) for pool in measured if (share := pool.lost)
        ]
        if lost:
            l95_ms = math.hypot(l95_ms, self._player.tail_error_ms(name, math.hypot(*lost)))
        widened = max(map(self._widening, measured)) * self._player.played(name).l95_ms
        count = max(min(pool.measured for pool in measured), 1)
        return math.hypot(l95_ms, widened), unseen_error(rate, count)
