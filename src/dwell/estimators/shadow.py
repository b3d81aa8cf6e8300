"""Shadow: online emulation, the estimate from cycles also sent through each alternative.

A shadow shares with its cycle whatever runs on the same nodes, has jobs and messages of its own for
the rest, and stops before the sinks, whose commands would reach the actuator. What a sink would
have added is what the cycle's own sink took, where both run on one node; elsewhere, and where the
cycle never came to its sink, a time of the profile.

Cycles and shadows count as they do in a window's metrics: one that has not come to its end when the
window closes has missed, and counts with its age. Samples lose half their weight every half-life; a
candidate whose samples weigh less than `ENOUGH` is estimated by the profile.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import UNKNOWN, Evidence, Instants
from dwell.estimators.measured import groups
from dwell.estimators.paths import Step, steps_of
from dwell.estimators.prices import SEED
from dwell.estimators.profile import Profile, SampleCycles
from dwell.estimators.protocol import Support
from dwell.model.bounds import HALF_LIFE_WINDOWS
from dwell.model.instants import HORIZON_NS, NEVER_NS
from dwell.model.problem import Problem
from dwell.model.qos import QoS

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Truths: TypeAlias = NDArray[np.bool_]

#: Weight of the samples that an estimate needs. Their largest is then about the 91st percentile; a
#: fraction of 0.05 reaches it in the third window of 100 cycles, at a half-life of two.
ENOUGH = 10.0
#: Weight below which a sample is dropped, and how many samples are kept at most.
FORGOTTEN = 1e-3
LARGEST = 5000
#: Sample cycles of the profile from which a sink's times are taken.
SINK_SAMPLES = 1000

NS_PER_MS = 1e6


class _Samples:
    """Latencies of a candidate: what each counts as, whether it missed, or was unfinished."""

    __slots__ = ("age", "missed", "seen_ms", "unfinished", "weight")

    def __init__(self) -> None:
        self.seen_ms = self.weight = np.empty(0)
        self.missed = self.unfinished = np.empty(0, np.bool_)
        self.age = 0

    def decay(self, factor: float) -> None:
        """Let a window pass."""
        weight = self.weight * factor
        # They are in the order of their windows: the lightest come first.
        first = int(np.searchsorted(weight, FORGOTTEN, side="right"))
        self.weight = weight[first:]
        self.seen_ms, self.missed = self.seen_ms[first:], self.missed[first:]
        self.unfinished = self.unfinished[first:]
        self.age += 1

    def add(self, seen_ms: Floats, missed: Truths, unfinished: Truths) -> None:
        """Add the samples of a window; the oldest beyond `LARGEST` are dropped."""
        step = -(-len(seen_ms) // LARGEST)
        seen_ms, missed, unfinished = seen_ms[::step], missed[::step], unfinished[::step]
        ones = np.ones(len(seen_ms))
        self.seen_ms = np.concatenate((self.seen_ms, seen_ms))[-LARGEST:]
        self.missed = np.concatenate((self.missed, missed))[-LARGEST:]
        self.unfinished = np.concatenate((self.unfinished, unfinished))[-LARGEST:]
        self.weight = np.concatenate((self.weight, ones))[-LARGEST:]
        self.age = 0


class Shadow:
    """Estimates QoS of alternatives from shadow jobs, and from the profile until it has enough.

    Parameters
    ----------
    shadow_fraction : float, optional
        Share of the cycles sent through each alternative; the cell file's where None.
    half_life_windows : float, optional
        The cell file's where None.

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
    ) -> None:
        settings = problem.controller
        given = problem.shadow_fraction if shadow_fraction is None else shadow_fraction
        self.shadow_fraction = given
        half_life = settings.half_life_windows if half_life_windows is None else half_life_windows
        HALF_LIFE_WINDOWS.check("half_life_windows", half_life)
        self.decay = 0.5 ** (1 / half_life)
        self.start(problem)

    def __repr__(self) -> str:
        return f"Shadow(shadow_fraction={self.shadow_fraction:g})"

    def start(self, problem: Problem) -> None:
        """Forget all samples."""
        self.problem = problem
        self.profile = Profile(problem)
        self._sinks = [step for step in steps_of(problem.pipeline) if step.sink]
        self._sampled = SampleCycles(problem, SINK_SAMPLES, SEED)
        self._taken = 0
        self._placements = tuple(problem.candidates.values())
        self._diverging: dict[tuple[int, int], frozenset[str]] = {}
        self._deadline_ns = round(problem.pipeline.deadline_ms * NS_PER_MS)
        self._samples = {name: _Samples() for name in problem.candidates}
        # Candidates of one placement share its samples.
        self._named = [
            [self._samples[name] for name, other in problem.candidates.items() if other == placed]
            for placed in self._placements
        ]

    def learn(self, evidence: Evidence) -> None:
        """Take in the latencies that cycles and shadows of a window had."""
        for samples in self._samples.values():
            samples.decay(self.decay)
        for active, rows in groups(evidence.placement):
            cycles, release_ns = evidence.cycles.at(rows), evidence.release_ns[rows]
            age_ns = evidence.close_ns - release_ns
            self._add(active, self._latency_ns(cycles, release_ns), age_ns)
            if evidence.shadows is None:
                continue
            shadows = evidence.shadows.at(rows)
            for other, mine in groups(evidence.shadow_placement[rows]):
                if other >= 0 and self._tells(active, other):
                    latency_ns = self._through(
                        active, other, cycles.at(mine), shadows.at(mine), release_ns[mine]
                    )
                    self._add(other, latency_ns, age_ns[mine])

    def _tells(self, active: int, other: int) -> bool:
        """Whether shadows of one candidate through another say anything that is not known."""
        apart = self._apart(active, other)
        # A sink without inputs is never run: a pipeline of such sinks has no shadows at all.
        measured = [step for step in self._sinks if step.inputs or step.task not in apart]
        return bool(apart and measured)

    def _add(self, index: int, latency_ns: Ints, age_ns: Ints) -> None:
        """Add latencies of a window to a candidate, and to others of its placement."""
        missed = latency_ns > np.minimum(age_ns, self._deadline_ns)
        seen_ms = np.minimum(latency_ns, age_ns) / NS_PER_MS
        for samples in self._named[index]:
            samples.add(seen_ms, missed, latency_ns > age_ns)

    def _apart(self, active: int, other: int) -> frozenset[str]:
        """Tasks that shadows of cycles under one candidate through another have for themselves."""
        key = active, other
        if key not in self._diverging:
            placements = self._placements[active], self._placements[other]
            self._diverging[key] = self.problem.pipeline.diverging(*placements)
        return self._diverging[key]

    def _latency_ns(self, cycles: Instants, release_ns: Ints) -> Ints:
        """Latency of cycles; `NEVER_NS` where not all of their sinks have completed."""
        end_ns = _latest(cycles.end_ns[:, [step.column for step in self._sinks]])
        return np.where(end_ns >= 0, end_ns - release_ns, NEVER_NS)

    def _through(
        self, active: int, other: int, cycles: Instants, shadows: Instants, release_ns: Ints
    ) -> Ints:
        """Latency of shadows; `NEVER_NS` where not all of their last messages have arrived."""
        apart, latency_ns = self._apart(active, other), np.zeros(len(release_ns), np.int64)
        for step in self._sinks:
            end_ns = cycles.end_ns[:, step.column]
            ready_ns = end_ns
            if step.task in apart:
                ready_ns = release_ns + round(step.offset_ms * NS_PER_MS)
                if step.inputs:
                    arrived_ns = shadows.arrived_ns[:, [entry.column for entry in step.inputs]]
                    ready_ns = _latest(arrived_ns)
                executed_ns = self._executed_ns(step, active, other, cycles)
                end_ns = ready_ns + np.minimum(executed_ns, HORIZON_NS - ready_ns)
            done_ns = np.where(ready_ns >= 0, end_ns - release_ns, NEVER_NS)
            latency_ns = np.maximum(latency_ns, done_ns)
        return latency_ns

    def _executed_ns(self, step: Step, active: int, other: int, cycles: Instants) -> Ints:
        """Time that a sink would have taken: the cycle's own, or one of the profile's."""
        here, there = self._placements[active][step.task], self._placements[other][step.task]
        end_ns = cycles.end_ns[:, step.column]
        rows = (self._taken + np.arange(len(end_ns))) % SINK_SAMPLES
        self._taken += len(rows)
        times_ms = self._sampled.executed(step.task, there)[rows]
        usual_ns = np.rint(np.minimum(times_ms * NS_PER_MS, HORIZON_NS)).astype(np.int64)
        if here != there:
            return usual_ns
        return np.where(end_ns >= 0, end_ns - cycles.ready_ns[:, step.column], usual_ns)

    def support(self) -> dict[str, Support]:
        """Weight of the samples behind each candidate's estimate, and the age of the newest."""
        return {
            name: Support(float(samples.weight.sum()), samples.age)
            for name, samples in self._samples.items()
        }

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics (see `Estimator`)."""
        known = self.profile.estimate(observed=observed, incumbent=incumbent, own=own)
        return {name: self._measured(known[name], s) for name, s in self._samples.items()}

    def _measured(self, known: QoS, samples: _Samples) -> QoS:
        """L95 and V_D of a candidate's samples, by weight."""
        total = float(samples.weight.sum())
        if total < ENOUGH:
            return known
        # Of equal latencies those of unfinished cycles come last.
        order = np.lexsort((samples.unfinished, samples.seen_ms))
        reached = np.cumsum(samples.weight[order])
        # Sums of weights that are equal in theory differ by their rounding.
        rank = int(np.searchsorted(reached, 0.95 * total * (1 - 1e-12)))
        seen_ms = float(samples.seen_ms[order[rank]])
        l95_ms = min(seen_ms, self.problem.censor_ms)
        unfinished = float(samples.weight[samples.unfinished].sum())
        lost = samples.unfinished[order[rank]] and unfinished > 0.05 * total
        uncut_ms = math.inf if lost else seen_ms
        missed = float(samples.weight[samples.missed].sum()) / total
        return QoS(l95_ms, min(missed, 1.0), known.utilisation, uncut_ms)


def _latest(instants_ns: Ints) -> Ints:
    """The last of each row's instants, negative where one of them has not come."""
    if instants_ns.shape[1] == 1:
        return instants_ns[:, 0]
    return np.where((instants_ns < 0).any(axis=1), UNKNOWN, instants_ns.max(axis=1))
