"""Scaling: conservative upper bounds from what the active placement was measured to take.

Cycle by cycle, a job that a candidate runs where it runs now counts with what it took; one that the
candidate runs elsewhere counts with that times the known ratio of the two nodes' compute times. A
message on the link that it crosses now counts with what it took; on any other link with the
declared bound of that link plus its transmission. What is not known of a cycle, because it was
lost, counts as infinite. L95 and V_D are those of the cycles so bounded.

A job's measured time holds its queueing and contention, so it is never less than its execution
time: with ratios that are true (exec there <= ratio * exec here, in every cycle) and bounds that
hold, the bound on each cycle's latency holds on the same realisation, and so does the one on the
queue-free L95. With ratios of a distribution it holds in distribution only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import PATIENCE
from dwell.estimators.paths import longest_path, order_statistic
from dwell.estimators.profile import SEED, Profile, SampleCycles
from dwell.estimators.spans import Spans, measure
from dwell.model.pipeline import Flow
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS

__all__ = ["Scaling"]

Floats: TypeAlias = NDArray[np.float64]

#: Sample cycles from which ratios and bounds are taken where none are given.
SAMPLES = 4000


class Scaling:
    """Estimates upper bounds of QoS from the active placement alone.

    Parameters
    ----------
    problem : Problem
    ratios : mapping of (task, node, other node) to float, optional
        Compute time on the other node over that on the node; what is missing is the 95th percentile
        of the profile's there over its median here.
    bounds_ms : mapping of str to float, optional
        Largest delay of each link (``R1->E``), transmission not included, milliseconds; what is
        missing is the largest in the profile's sample cycles.
    """

    def __init__(
        self,
        problem: Problem,
        ratios: Mapping[tuple[str, str, str], float] | None = None,
        bounds_ms: Mapping[str, float] | None = None,
    ) -> None:
        self.profile = Profile(problem)
        self._given, self._bounds = dict(ratios or {}), dict(bounds_ms or {})
        self.start(problem)

    def start(self, problem: Problem) -> None:
        """Forget the last window."""
        self.problem = problem
        self._sampled = SampleCycles(problem, SAMPLES, SEED)
        self._ratios = dict(self._given)
        self._spans: Spans | None = None
        self._active: Placement | None = None

    def learn(self, evidence: Evidence) -> None:
        """Take in what the cycles of a window took; those of an earlier placement are left out."""
        pipeline = self.problem.pipeline
        own, _ = measure(evidence, pipeline, PATIENCE * pipeline.period_ms)
        newest = evidence.placement == evidence.placement[-1]
        self._spans = Spans(own.job_ms[newest], own.message_ms[newest])
        self._active = tuple(self.problem.candidates.values())[int(evidence.placement[-1])]

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Bound every candidate's metrics (see `Estimator`); by the profile before any window."""
        known = self.profile.estimate(observed=observed, incumbent=incumbent, own=own)
        spans, active = self._spans, self._active
        if spans is None or active is None:
            return known
        return {
            name: self._bounded(placement, known[name], spans, active)
            for name, placement in self.problem.candidates.items()
        }

    def _bounded(self, placement: Placement, known: QoS, spans: Spans, active: Placement) -> QoS:
        problem = self.problem
        columns = {name: i for i, name in enumerate(problem.pipeline.tasks)}
        order = {flow: i for i, flow in enumerate(problem.pipeline.flows)}

        def executed(task: str) -> Floats:
            here, there = active[task], placement[task]
            taken = spans.job_ms[:, columns[task]]
            ratio = 1.0 if here == there else self._ratio(task, here, there)
            bounded: Floats = np.where(np.isnan(taken), np.inf, taken * ratio)
            return bounded

        def sent(flow: Flow) -> Floats:
            source, target = placement[flow.source], placement[flow.target]
            if source == target:
                return np.zeros(len(spans.job_ms))
            if (source, target) != (active[flow.source], active[flow.target]):
                return np.full(len(spans.job_ms), self._bound_ms(flow, placement))
            taken = spans.message_ms[:, order[flow]]
            bounded: Floats = np.where(np.isnan(taken), np.inf, taken)
            return bounded

        latency_ms = longest_path(problem.pipeline, executed, sent)
        missed = np.count_nonzero(latency_ms > problem.pipeline.deadline_ms)
        l95_ms = min(order_statistic(latency_ms), problem.censor_ms)
        return QoS(l95_ms, missed / len(latency_ms), known.utilisation)

    def _ratio(self, task: str, here: str, there: str) -> float:
        key = (task, here, there)
        if key not in self._ratios:
            mine = self._sampled.executed(task, here)
            other = self._sampled.executed(task, there)
            self._ratios[key] = order_statistic(other) / max(float(np.median(mine)), 1e-9)
        return self._ratios[key]

    def _bound_ms(self, flow: Flow, placement: Placement) -> float:
        link = self.problem.fabric.links[f"{placement[flow.source]}->{placement[flow.target]}"]
        if link.name in self._bounds:
            return self._bounds[link.name] + 8 * flow.payload_bytes / (link.rate_mbps * 1e3)
        times = self._sampled.sent(flow, placement)
        finite = times[np.isfinite(times)]
        return float(finite.max()) if len(finite) else self.problem.censor_ms
