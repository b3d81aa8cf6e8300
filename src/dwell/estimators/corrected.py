"""Corrected: the profile, corrected online by what active and shadow jobs reveal.

For every *part* of a cycle (a task on a node, a flow on a link) a pool of times is kept. It begins
as the profile's; every window adds what it measured of the part, queueing and contention included,
whether by the cell's own jobs or by shadow jobs. QoS of a candidate is composed from the pools of
its parts: one draw of each, the longest path through the DAG, and the L95 and V_D of windows of
such cycles.

Change of regime
    Pools forget slowly (`MEMORY` half-lives), which keeps estimates calm; but a stressed node is
    another regime, not a gradual drift. Where the ranks of a window's new times in the pool lie
    almost wholly on one side (the probability that a new time exceeds an old one is beyond
    `SHIFT`, the Mann-Whitney statistic, DOI 10.1214/aoms/1177730491), the pool is dropped. Few new
    times are then filled up with the profile's, stretched (a job) or shifted (a message) to their
    median.

What nobody measured
    A part that no job went through, in the window in which another part of its node or link changed
    its regime, is corrected with it: the foreign threads that explain a job's slowdown slow the
    other jobs of the node as they would under processor sharing, and the extra delay of one message
    is that of the others on its link. A node of which nothing at all was measured is judged by its
    foreign load.

Age
    A pool that got nothing new for a windows is widened: each of its times is multiplied by a
    lognormal factor whose deviation grows with the square root of a. Its estimate becomes one of a
    node or link about which less and less is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Message, Part, Site, measured_parts, parts_of
from dwell.estimators.paths import longest_path, seen_windows
from dwell.estimators.profile import SEED, Profile, SampleCycles
from dwell.estimators.protocol import Support
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS

__all__ = ["Corrected"]

Floats: TypeAlias = NDArray[np.float64]

#: Half-lives after which a measured time is forgotten.
MEMORY = 6.0
#: Most times that a pool holds, and how many of the profile's it begins with.
LARGEST = 400
PRIOR = 256
#: P(new > old) outside [1 - SHIFT, SHIFT], with at least LEAST new times, is another regime.
SHIFT = 0.85
LEAST = 2
LEAST_DEVIATIONS = 2.2
#: New times below which the profile's shape is added to them.
ENOUGH = 12
#: Deviation of the logarithm of a pool's times after one window without a new one.
WIDENING = 0.03
#: Cycles that a candidate's estimate is composed of, at least.
COMPOSED = 1000
#: Change of a node's foreign load that means another regime where nothing else was measured.
LOAD_STEP = 0.25
SATURATED = 0.95


@dataclass(slots=True)
class _Pool:
    """Times of one part in its present regime, ascending in `ordered`."""

    prior: Floats
    times: Floats
    window: Floats
    ordered: Floats
    last: int = 0
    foreign: float = 0.0

    @classmethod
    def of(cls, prior: Floats) -> _Pool:
        ordered = np.sort(prior[np.isfinite(prior)])
        return cls(ordered, ordered, np.zeros(len(ordered)), ordered)

    def replace(self, times: Floats, window: int) -> None:
        self.times, self.window = times, np.full(len(times), float(window))
        self.ordered = np.sort(times)

    def add(self, times: Floats, window: int, memory: float) -> None:
        kept = self.window > window - memory
        now = np.full(len(times), float(window))
        self.times = np.concatenate((self.times[kept], times))[-LARGEST:]
        self.window = np.concatenate((self.window[kept], now))[-LARGEST:]
        self.ordered = np.sort(self.times)

    def shifted(self, times: Floats) -> bool:
        """Whether new times are of another regime than the old ones."""
        new, old = len(times), len(self.ordered)
        below = np.searchsorted(self.ordered, times, "left")
        above = np.searchsorted(self.ordered, times, "right")
        exceeds = float((below + above).mean()) / (2 * old)
        deviations = abs(exceeds - 0.5) / np.sqrt((1 / new + 1 / old) / 12)
        beyond = not 1 - SHIFT <= exceeds <= SHIFT
        return bool(new >= LEAST and deviations > LEAST_DEVIATIONS and beyond)


class Corrected:
    """Estimates QoS from the profile's times, corrected by what every window measured.

    Parameters
    ----------
    problem : Problem
    shadow_fraction : float, optional
        Share of the cycles sent through each alternative; the cell file's where None. 0 learns
        from the active placement alone.
    half_life_windows : float, optional
        The cell file's where None; times are forgotten after `MEMORY` of them.
    seed : int
        Of the profile's sample cycles and of how draws are paired.

    Attributes
    ----------
    regimes : int
        Changes of regime seen since the start.
    """

    def __init__(
        self,
        problem: Problem,
        shadow_fraction: float | None = None,
        half_life_windows: float | None = None,
        seed: int = SEED,
    ) -> None:
        settings = problem.controller
        given = settings.shadow_fraction if shadow_fraction is None else shadow_fraction
        self.shadow_fraction = given
        half_life = settings.half_life_windows if half_life_windows is None else half_life_windows
        self.memory = MEMORY * half_life
        self.seed = seed
        self.profile = Profile(problem)
        self.start(problem)

    def start(self, problem: Problem) -> None:
        """Forget everything but the profile."""
        self.problem = problem
        self.regimes, self._window = 0, 0
        sampled = SampleCycles(problem, PRIOR, self.seed)
        windows = -(-COMPOSED // problem.window_cycles)
        count = windows * problem.window_cycles
        rng = np.random.default_rng(self.seed)
        places = (np.arange(count) + 0.5) / count
        self._pools: dict[Part, _Pool] = {}
        self._places: dict[Part, Floats] = {}
        self._normals: dict[Part, Floats] = {}
        for placement in problem.candidates.values():
            for part in parts_of(problem.pipeline, placement):
                if part in self._pools:
                    continue
                self._pools[part] = _Pool.of(_sampled(sampled, part, placement, problem))
                self._places[part] = rng.permutation(places)
                self._normals[part] = rng.standard_normal(count)
        span_ms = problem.window_cycles * problem.pipeline.period_ms
        self._age_ms = rng.permutation(places) * span_ms
        self._fresh: dict[Part, Floats] = {}

    def learn(self, evidence: Evidence) -> None:
        """Take in what a window measured of each part."""
        self._window += 1
        self._fresh = measured_parts(self.problem, evidence)
        changed: list[Part] = []
        for part, times in self._fresh.items():
            pool = self._pools[part]
            pool.last = self._window
            if pool.shifted(times):
                changed.append(part)
                pool.replace(_filled_up(pool.prior, times, part), self._window)
            else:
                pool.add(times, self._window, self.memory)
        self.regimes += len(changed)
        for part in changed:
            self._correct_others(part)

    def support(self) -> dict[str, Support]:
        """How much stands behind each candidate's estimate: that of its weakest part."""
        found = {}
        for name, placement in self.problem.candidates.items():
            pools = [self._pools[part] for part in parts_of(self.problem.pipeline, placement)]
            found[name] = Support(
                min(int(np.count_nonzero(pool.window)) for pool in pools),
                float(max(self._window - pool.last for pool in pools)),
            )
        return found

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics (see `Estimator`)."""
        known = self.profile.estimate(observed=observed, incumbent=incumbent, own=own)
        self._judge_by_load(observed, own)
        draws: dict[Part, Floats] = {}
        return {
            name: self._composed(placement, known[name], draws)
            for name, placement in self.problem.candidates.items()
        }

    def _composed(self, placement: Placement, known: QoS, draws: dict[Part, Floats]) -> QoS:
        """L95 and V_D of cycles composed from the pools of a candidate's parts."""
        problem = self.problem

        def drawn(part: Part) -> Floats:
            if part not in draws:
                draws[part] = self._drawn(part)
            return draws[part]

        latency_ms = longest_path(
            problem.pipeline,
            lambda task: drawn(Site(task, placement[task])),
            lambda flow: (
                drawn(
                    Message(
                        flow.source,
                        flow.target,
                        f"{placement[flow.source]}->{placement[flow.target]}",
                    )
                )
                if placement[flow.source] != placement[flow.target]
                else np.zeros(len(self._age_ms))
            ),
        )
        missed = np.count_nonzero(latency_ms > problem.pipeline.deadline_ms)
        l95_ms = seen_windows(latency_ms, problem.window_cycles, self._age_ms, problem.censor_ms)
        return QoS(l95_ms, missed / len(latency_ms), known.utilisation)

    def _drawn(self, part: Part) -> Floats:
        """Draw times of a part from its pool, wider the older it is."""
        pool = self._pools[part]
        times = pool.ordered[(self._places[part] * len(pool.ordered)).astype(np.int64)]
        age = self._window - pool.last
        if age > 0:
            times = times * np.exp(WIDENING * np.sqrt(age) * self._normals[part])
        return times

    def _correct_others(self, changed: Part) -> None:
        """Correct what nobody measured by a part of the same node or link that changed."""
        for part, pool in self._pools.items():
            if part in self._fresh:
                continue
            if isinstance(part, Message) and isinstance(changed, Message):
                if part.link == changed.link:
                    extra = np.median(self._pools[changed].ordered)
                    extra -= np.median(self._pools[changed].prior)
                    pool.replace(pool.prior + max(float(extra), 0.0), self._window)
            elif isinstance(part, Site) and isinstance(changed, Site) and part.node == changed.node:
                threads = self._foreign_threads(changed)
                if threads is not None:
                    self._slow(part, threads)

    def _foreign_threads(self, site: Site) -> float | None:
        """Foreign threads that explain how much slower a site is than its profile."""
        pool = self._pools[site]
        node = self.problem.fabric.nodes[site.node]
        execution = self.problem.pipeline.tasks[site.task].on[site.node]
        if execution.accelerator is not None:
            return None
        slowdown = float(np.median(pool.ordered) / max(np.median(pool.prior), 1e-9))
        if not np.isfinite(slowdown):
            return None
        if node.scheduler != "fair":
            return max(slowdown - 1.0, 0.0) * node.cores
        held = max(execution.threads, node.cores)
        return max(slowdown * held - execution.threads, 0.0) if slowdown > 1.0 else 0.0

    def _slow(self, site: Site, threads: float) -> None:
        """Set a site's times to its profile's, slowed by foreign threads."""
        node = self.problem.fabric.nodes[site.node]
        execution = self.problem.pipeline.tasks[site.task].on[site.node]
        if execution.accelerator is not None:
            return
        if node.scheduler == "fair":
            held = max(execution.threads, node.cores)
            slowdown = max(1.0, (execution.threads + threads) / held)
        else:
            slowdown = (node.cores + threads) / node.cores
        pool = self._pools[site]
        pool.replace(pool.prior * slowdown, self._window)

    def _judge_by_load(self, observed: QoS, own: Mapping[str, float]) -> None:
        """Judge by its foreign load a node of which nothing was measured in this window."""
        seen = {part.node for part in self._fresh if isinstance(part, Site)}
        for name, node in self.problem.fabric.nodes.items():
            foreign = max(observed.utilisation[name] - own[name], 0.0)
            # What a saturated node's load hides: at least one thread a core.
            threads = node.cores if foreign > SATURATED else foreign * node.capacity
            for part, pool in self._pools.items():
                if not isinstance(part, Site) or part.node != name:
                    continue
                if name not in seen and abs(foreign - pool.foreign) > LOAD_STEP:
                    self._slow(part, threads)
                elif name not in seen:
                    continue
                pool.foreign = foreign


def _sampled(sampled: SampleCycles, part: Part, placement: Placement, problem: Problem) -> Floats:
    """Times of a part in the profile's sample cycles."""
    if isinstance(part, Site):
        return sampled.executed(part.task, part.node)
    flow = next(
        flow
        for flow in problem.pipeline.flows
        if (flow.source, flow.target) == (part.source, part.target)
    )
    return sampled.sent(flow, placement)


def _filled_up(prior: Floats, times: Floats, part: Part) -> Floats:
    """New times, and where they are few the profile's moved to their median."""
    finite = times[np.isfinite(times)]
    if len(times) >= ENOUGH or len(finite) == 0:
        return times
    new, old = float(np.median(finite)), float(np.median(prior))
    if isinstance(part, Site):
        moved = prior * (new / max(old, 1e-9))
    else:
        moved = np.maximum(prior + (new - old), 0.0)
    return np.concatenate((times, moved[:: max(len(moved) // ENOUGH, 1)]))
