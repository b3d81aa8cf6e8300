"""Shadow: online emulation, the estimate from cycles also sent through each alternative.

A shadow shares with its cycle whatever runs on the same nodes, has jobs and messages of its own for
the rest, and stops before the sinks. Its latency is completed with the sinks' jobs of the cycle
itself. Samples lose half their weight every half-life; a candidate with samples for less than
`ENOUGH` whole ones is estimated by the profile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import stretches
from dwell.estimators.profile import Profile
from dwell.estimators.protocol import Support
from dwell.estimators.spans import Spans
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS

__all__ = ["Shadow"]

Floats: TypeAlias = NDArray[np.float64]

#: Weight of samples from which a 95th percentile is more than their maximum.
ENOUGH = 20.0
#: Weight below which a sample is dropped.
FORGOTTEN = 1e-3


class Shadow:
    """Estimates QoS of alternatives from shadow jobs, and from the profile until it has enough.

    Parameters
    ----------
    problem : Problem
    shadow_fraction : float, optional
        Share of the cycles sent through each alternative; the cell file's where None.
    half_life_windows : float, optional
        The cell file's where None.
    """

    def __init__(
        self,
        problem: Problem,
        shadow_fraction: float | None = None,
        half_life_windows: float | None = None,
    ) -> None:
        settings = problem.controller
        given = settings.shadow_fraction if shadow_fraction is None else shadow_fraction
        self.shadow_fraction = given
        half_life = settings.half_life_windows if half_life_windows is None else half_life_windows
        self.decay = 0.5 ** (1 / half_life)
        self.profile = Profile(problem)
        self.start(problem)

    def start(self, problem: Problem) -> None:
        """Forget all samples."""
        self.problem = problem
        none = np.empty(0)
        self._samples = dict.fromkeys(problem.candidates, none)
        self._weights = dict.fromkeys(problem.candidates, none)
        self._age = dict.fromkeys(problem.candidates, 0.0)

    def learn(self, evidence: Evidence) -> None:
        """Take in the latencies that cycles and shadows of a window had."""
        problem = self.problem
        for name in problem.candidates:
            weights = self._weights[name] * self.decay
            kept = weights > FORGOTTEN
            self._weights[name], self._samples[name] = weights[kept], self._samples[name][kept]
            self._age[name] += 1
        pieces = list(stretches(problem, evidence))
        own = pieces[0].spans
        for placement, rows, spans, tasks in pieces:
            latency_ms = _latency_ms(problem, placement, spans, own, tasks)[rows]
            latency_ms = latency_ms[~np.isnan(latency_ms)]
            if len(latency_ms) == 0:
                continue
            for name, placed in problem.candidates.items():
                if placed == placement:
                    self._add(name, latency_ms)

    def _add(self, name: str, latency_ms: Floats) -> None:
        weights = np.ones(len(latency_ms))
        self._samples[name] = np.concatenate((self._samples[name], latency_ms))
        self._weights[name] = np.concatenate((self._weights[name], weights))
        self._age[name] = 0.0

    def support(self) -> dict[str, Support]:
        """Weight of the samples behind each candidate's estimate, and the age of the newest."""
        return {
            name: Support(float(weights.sum()), self._age[name])
            for name, weights in self._weights.items()
        }

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics (see `Estimator`)."""
        known = self.profile.estimate(observed=observed, incumbent=incumbent, own=own)
        return {
            name: self._measured(name, known[name])
            if self._weights[name].sum() >= ENOUGH
            else known[name]
            for name in self.problem.candidates
        }

    def _measured(self, name: str, known: QoS) -> QoS:
        """L95 and V_D of a candidate's samples, by weight."""
        problem, weights = self.problem, self._weights[name]
        latency_ms = self._samples[name]
        missed = float(weights[latency_ms > problem.pipeline.deadline_ms].sum() / weights.sum())
        seen = np.minimum(_lost_as_ages(latency_ms, problem), problem.censor_ms)
        order = np.argsort(seen, kind="stable")
        reached = np.cumsum(weights[order]) >= 0.95 * weights.sum() * (1 - 1e-12)
        l95_ms = float(seen[order][np.argmax(reached)])
        return QoS(l95_ms, min(missed, 1.0), known.utilisation)


def _lost_as_ages(latency_ms: Floats, problem: Problem) -> Floats:
    """Let lost cycles count with ages spread evenly over a window, as a controller sees them."""
    lost = np.isinf(latency_ms)
    count = int(np.count_nonzero(lost))
    seen = latency_ms.copy()
    span_ms = problem.window_cycles * problem.pipeline.period_ms
    seen[lost] = (np.arange(count) + 0.5) / max(count, 1) * span_ms
    return seen


def _latency_ms(
    problem: Problem, placement: Placement, spans: Spans, own: Spans, tasks: frozenset[str]
) -> Floats:
    """Latency of every cycle of a window through a placement, NaN where it was not sent there.

    Parameters
    ----------
    spans : Spans
        Of the jobs and messages in `tasks`; all others, and the sinks' jobs, are the cycles' own.
    """
    pipeline = problem.pipeline
    columns = {name: i for i, name in enumerate(pipeline.tasks)}
    finish: dict[str, Floats] = {}
    for name in pipeline.topological():
        ready = np.full(len(own.job_ms), float(pipeline.tasks[name].offset_ms))
        for column, flow in enumerate(pipeline.flows):
            if flow.target != name:
                continue
            sent = spans if name in tasks else own
            crosses = placement[flow.source] != placement[name]
            taken = sent.message_ms[:, column] if crosses else np.zeros(len(ready))
            ready = _later(ready, finish[flow.source] + taken)
        mine = spans if name in tasks and pipeline.outputs(name) else own
        finish[name] = ready + mine.job_ms[:, columns[name]]
        if not pipeline.outputs(name):
            # Where the cycle itself never came to its sink, the shadow is complete without it.
            bare = np.isnan(own.job_ms[:, columns[name]])
            finish[name] = np.where(bare, ready, finish[name])
    sinks = [finish[name] for name in pipeline.tasks if not pipeline.outputs(name)]
    latency = sinks[0]
    for sink in sinks[1:]:
        latency = _later(latency, sink)
    return latency


def _later(first: Floats, second: Floats) -> Floats:
    """The later of two instants; a lost one (infinite) is later than one that is not known."""
    later: Floats = np.where(np.isinf(first) | np.isinf(second), np.inf, np.maximum(first, second))
    return later
