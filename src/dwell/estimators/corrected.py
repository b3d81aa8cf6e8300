"""Corrected: the profile, corrected online by what active and shadow jobs reveal.

For every *part* of a cycle (a task on a node, a flow on a link) a pool of times is kept. It begins
as the profile's; every window adds what it measured of the part, queueing and contention included,
whether by the cell's own jobs or by shadow jobs. QoS of a candidate is composed from the pools of
its parts: one draw of each, the longest path through the DAG, and the L95 and V_D of windows of
such cycles.

Change of regime
    Pools forget slowly (`MEMORY` half-lives), which keeps estimates calm; but a stressed node is
    another regime, not a gradual drift. Where the ranks of a window's new times in the pool lie
    almost wholly on one side (the Mann-Whitney statistic, DOI 10.1214/aoms/1177730491), the pool is
    dropped. Few new times are then filled up with the profile's, stretched (a job) or shifted (a
    message) to their median.

What nobody measured
    A part that no job went through, in a window in which another part of its node or link changed
    its regime, is corrected with it: the foreign threads that explain the slowdown of the longest
    job slow the other jobs of the node, and the extra delay and the losses of one message are those
    of the others on its link. A node of which nothing at all was measured is judged by its foreign
    load; where others have a part of a saturated node, that is only known to be at least what they
    got.

Age
    A part that was not measured for a windows is less and less known: each of its times is
    multiplied by a lognormal factor whose deviation grows with the square root of a. In the end
    (after `UNSEEN` half-lives) what was measured of it is forgotten, and the profile's times are
    what is left, so widened.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.cost import censored
from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Message, Meter, Part, Site, message_of
from dwell.estimators.paths import longest_path, seen_windows, steps_of
from dwell.estimators.pool import Pool, middle
from dwell.estimators.prices import SEED
from dwell.estimators.profile import Profile, SampleCycles
from dwell.estimators.protocol import Support
from dwell.estimators.slowdown import explaining_threads, slowdown
from dwell.model.bounds import HALF_LIFE_WINDOWS
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS

Floats: TypeAlias = NDArray[np.float64]

#: Half-lives after which a measured time gives way to newer ones, and after which a part that was
#: not measured any more is forgotten altogether: going back to look can cost dearly.
MEMORY = 6.0
UNSEEN = 60.0
#: How many of the profile's times a pool begins with.
PRIOR = 256
#: Deviation of the logarithm of a pool's times after one window without a new one.
WIDENING = 0.03
#: Cycles that a candidate's estimate is composed of: at least, and at most in one window.
COMPOSED = 1000
LONGEST_WINDOW = 10_000
#: Change of a node's foreign load that means another regime where nothing else was measured.
LOAD_STEP = 0.25
#: Half a nanosecond: sums of milliseconds that differ by less are equal.
ROUNDING_MS = 5e-7


@dataclass(slots=True)
class _Route:
    """The pools of a candidate's parts: by task, by flow (None on one node), and all of them."""

    jobs: list[Pool]
    messages: list[Pool | None]
    pools: list[Pool]


class _Maker:
    """Makes the pools of candidates, those that no candidate before has."""

    def __init__(self, problem: Problem, pools: dict[Part, Pool], draws: int, seed: int) -> None:
        self.pipeline, self.pools = problem.pipeline, pools
        self.sampled = SampleCycles(problem, PRIOR, seed)
        self.rng = np.random.default_rng(seed)
        self.places = (np.arange(draws) + 0.5) / draws

    def route(self, placement: Placement) -> _Route:
        """Return the pools of a candidate."""
        jobs: list[Pool] = []
        messages: list[Pool | None] = []
        for name in self.pipeline.tasks:
            site = Site(name, placement[name])
            if site not in self.pools:
                self.pools[site] = self.pool(self.sampled.executed(*site), additive=False)
            jobs.append(self.pools[site])
        for flow in self.pipeline.flows:
            message = message_of(flow.source, flow.target, placement)
            if message is not None and message not in self.pools:
                self.pools[message] = self.pool(self.sampled.sent(flow, placement), additive=True)
            messages.append(None if message is None else self.pools[message])
        return _Route(jobs, messages, [*jobs, *(pool for pool in messages if pool is not None)])

    def pool(self, prior: Floats, additive: bool) -> Pool:
        """Return the pool of a part, with pairings of its own."""
        places, normals = self.rng.permutation(self.places), self.rng.standard_normal
        # To whole nanoseconds, as everything is measured: equal times must be ties.
        return Pool(np.round(prior, 6), additive, places, normals(len(places)))


class Corrected:
    """Estimates QoS from the profile's times, corrected by what every window measured.

    Parameters
    ----------
    shadow_fraction : float, optional
        Share of the cycles sent through each alternative; the cell file's where None. 0 learns
        from the active placement alone.
    half_life_windows : float, optional
        The cell file's where None; see `MEMORY` and `UNSEEN`.
    seed : int
        Seed of the profile's sample cycles and of the pairing of draws.

    Attributes
    ----------
    regimes : int
        Changes of regime seen since the start.

    Raises
    ------
    ProblemError
        If `half_life_windows` is out of its range.
    """

    def __init__(
        self,
        problem: Problem,
        shadow_fraction: float | None = None,
        half_life_windows: float | None = None,
        seed: int = SEED,
    ) -> None:
        settings = problem.controller
        given = problem.shadow_fraction if shadow_fraction is None else shadow_fraction
        self.shadow_fraction = given
        half_life = settings.half_life_windows if half_life_windows is None else half_life_windows
        HALF_LIFE_WINDOWS.check("half_life_windows", half_life)
        self.memory = MEMORY * half_life
        self.unseen = UNSEEN * half_life
        self.seed = seed
        self.start(problem)

    def __repr__(self) -> str:
        return f"Corrected(shadow_fraction={self.shadow_fraction:g}, regimes={self.regimes})"

    def start(self, problem: Problem) -> None:
        """Forget everything but the profile."""
        self.problem = problem
        self.profile = Profile(problem)
        self.regimes, self._window = 0, 0
        self._steps = steps_of(problem.pipeline)
        self._meter = Meter(problem)
        self._pools: dict[Part, Pool] = {}
        self._row = min(problem.window_cycles, LONGEST_WINDOW)
        rows = -(-COMPOSED // self._row)
        make = _Maker(problem, self._pools, rows * self._row, self.seed)
        self._routes = {name: make.route(placed) for name, placed in problem.candidates.items()}
        # A lost cycle counts with its age at the close of its window: W to 1 periods.
        places = np.tile((np.arange(self._row) + 0.5) / self._row, rows)
        ages = 1 + np.floor(places * problem.window_cycles)
        self._age_ms = ages * problem.pipeline.period_ms
        #: Least and most foreign load that each node's windows agree with.
        self._foreign = dict.fromkeys(problem.fabric.nodes, (0.0, 0.0))
        self._seen: frozenset[str] = frozenset()
        self._forgotten: frozenset[Part] = frozenset()

    def learn(self, evidence: Evidence) -> None:
        """Take in what a window measured of each part."""
        self._window += 1
        measured = self._meter.times(evidence)
        tested, changed = set(), set()
        for part, times in measured.items():
            verdict = self._pools[part].learn(times, self._window, self.memory)
            if verdict is not None:
                tested.add(part)
            if verdict:
                changed.add(part)
        self.regimes += len(changed)
        self._forgotten = frozenset(self._forget())
        self._seen = frozenset(_place(part) for part in measured)
        places = {_place(part) for part in changed}
        if not places and not self._forgotten:
            return
        for part in self._pools:
            here = _place(part)
            if part not in tested and (here in places or part in self._forgotten):
                others = [other for other in measured if _place(other) == here and other != part]
                # What has too few times to be tested may still show the regime before.
                self._correct(part, [other for other in others if other in tested] or others)

    def support(self) -> dict[str, Support]:
        """Support of each candidate's estimate: that of its weakest part."""
        return {
            name: Support(
                min([pool.measured for pool in route.pools]),
                self._window - min([pool.last for pool in route.pools]),
            )
            for name, route in self._routes.items()
        }

    def deviation(self) -> dict[str, float]:
        """Deviation of the logarithm by which the stalest part of each candidate is widened."""
        return {
            name: max(self._widening(pool) for pool in route.pools)
            for name, route in self._routes.items()
        }

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics (see `Estimator`)."""
        known = self.profile.estimate(observed=observed, incumbent=incumbent, own=own)
        self._judge_by_load(observed, own)
        for pool in self._pools.values():
            pool.draw(self._widening(pool))
        return {name: self._composed(route, known[name]) for name, route in self._routes.items()}

    def _composed(self, route: _Route, known: QoS) -> QoS:
        """L95 and V_D of cycles composed from the pools of a candidate's parts."""
        problem = self.problem
        latency_ms = longest_path(
            self._steps,
            [pool.drawn for pool in route.jobs],
            [0.0 if pool is None else pool.drawn for pool in route.messages],
        )
        late = latency_ms > problem.pipeline.deadline_ms + ROUNDING_MS
        l95_ms, uncut_ms = seen_windows(latency_ms, self._row, self._age_ms, problem.censor_ms)
        missed = int(np.count_nonzero(late)) / len(latency_ms)
        return QoS(l95_ms, missed, known.utilisation, uncut_ms)

    def _widening(self, pool: Pool) -> float:
        """Deviation of the logarithm of a pool's times, from the windows since it was measured."""
        age = min(self._window - pool.last, self.unseen)
        return WIDENING * math.sqrt(age) if age > 0 else 0.0

    def _forget(self) -> Iterator[Part]:
        """Let parts of which nothing was learnt for long be what the profile says."""
        for part, pool in self._pools.items():
            if pool.touched and self._window - pool.touched >= max(self.unseen, 1.0):
                pool.reset()
                yield part

    def _correct(self, part: Part, witnesses: Iterable[Part]) -> None:
        """Correct a part that nobody measured by those of its node or link that were."""
        if isinstance(part, Message):
            known = [w for w in witnesses if self._pools[w].usual < math.inf]
            if known:
                surest = max(known, key=lambda w: self._pools[w].measured)
                pool = self._pools[part]
                pool.replace(_delayed(pool.prior, self._pools[surest]), self._window)
            return
        threads = self._foreign_threads([w for w in witnesses if isinstance(w, Site)])
        if threads is not None:
            self._slow(part, threads)

    def _foreign_threads(self, sites: Iterable[Site]) -> float | None:
        """Foreign threads that explain how much slower a node's longest job is than its profile.

        The longest, because queueing adds to all jobs alike and would pass for a great slowdown of
        a short one. None where there is no such job on the CPU, or all of its jobs are lost.
        """
        pools = {s: self._pools[s] for s in sites if self._on_cpu(s) and self._pools[s].usual > 0}
        if not pools:
            return None
        longest = max(pools, key=lambda site: pools[site].usual)
        slowed = middle(pools[longest].ordered) / pools[longest].usual
        if not slowed < math.inf:
            return None
        node = self.problem.fabric.nodes[longest.node]
        return explaining_threads(node, self._threads(longest), slowed)

    def _slow(self, site: Site, foreign_threads: float) -> None:
        """Set a site's times to its profile's, slowed by foreign threads."""
        if self._on_cpu(site):
            node, pool = self.problem.fabric.nodes[site.node], self._pools[site]
            slowed = slowdown(node, self._threads(site), foreign_threads)
            pool.replace(pool.prior * slowed, self._window)

    def _on_cpu(self, site: Site) -> bool:
        return self.problem.pipeline.tasks[site.task].on[site.node].accelerator is None

    def _threads(self, site: Site) -> int:
        return self.problem.pipeline.tasks[site.task].on[site.node].threads

    def _judge_by_load(self, observed: QoS, own: Mapping[str, float]) -> None:
        """Judge by its foreign load a node of which nothing was measured in this window."""
        for name, node in self.problem.fabric.nodes.items():
            used = observed.utilisation[name]
            least = max(used - own[name], 0.0)
            hidden = censored(used, own[name])
            most = math.inf if hidden else least
            before_least, before_most = self._foreign[name]
            changed = least - before_most > LOAD_STEP or before_least - most > LOAD_STEP
            # What was known before says more than a full node that agrees with it.
            if changed or (name in self._seen and not hidden):
                self._foreign[name] = (least, most)
            if name in self._seen or not (changed or self._forgotten):
                continue
            least, most = self._foreign[name]
            # A saturated node hides how many there are: at least one for each core.
            foreign = least if most < math.inf else 1.0
            threads = foreign * node.capacity
            for part in self._pools:
                judged = changed or (part in self._forgotten and foreign > LOAD_STEP)
                if judged and isinstance(part, Site) and part.node == name:
                    self._slow(part, threads)


def _place(part: Part) -> str:
    """The node or link that a part is on."""
    return part.node if isinstance(part, Site) else part.link


def _delayed(prior: Floats, witness: Pool) -> Floats:
    """The profile's times of a message, with the extra delay and the losses of another one."""
    extra_ms = max(middle(witness.ordered) - witness.usual, 0.0)
    times = prior + extra_ms
    lost = np.isinf(witness.ordered).mean() - np.isinf(prior).mean()
    if lost > 0:
        times[np.flatnonzero(np.isfinite(times))[: round(lost * len(times))]] = np.inf
    return times
