"""Scaling: conservative upper bounds from what the active placement was measured to take.

Cycle by cycle, a job that a candidate runs where it runs now counts with what it took; one that the
candidate runs elsewhere counts with that times the known ratio of the two nodes' compute times. A
message that crosses the same link as now counts with what it took; on any other link with the
declared bound of that link plus its transmission. What is not known of a cycle, because it was lost
or had not ended when the window closed, counts as infinite. L95 and V_D are those of the cycles so
bounded.

What is bounded
    The latency of each cycle as it would be *queue-free* under the candidate: the longest path of
    its execution times, each alone on a node without stress and quota, and of its messages, each
    alone on its link. What was measured holds queueing, contention and stress, waits for a worker,
    an accelerator or an earlier message of an `in_order` link, and is never less than that. So the
    bound holds, cycle by cycle on the same realisation, where

    * ratios are true: exec there <= ratio * exec here in every cycle (a task with more threads than
      a node has cores takes threads / cores times as long there, which counts);
    * declared bounds hold: no message takes longer on a link that its flow does not use now,
      repeated attempts included, nor is one lost there;
    * a link that its flow does use is no worse for the message at the instant at which the
      candidate would send it. Where it is as it was declared, that is so.

    And so it does for the L95 and the V_D of the window's cycles, up to the censoring of L95 at
    ``problem.censor_ms``.

What is not
    What the candidate would really show: its own queueing and contention, stress on nodes that are
    not in use and the utilisation are not in it.

    Ratios that are not given are taken from the profile: its 95th percentile there over its median
    here. That is no bound on a cycle, only a cautious factor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import Fault, ProblemError
from dwell.estimators.evidence import Evidence
from dwell.estimators.paths import longest_path, order_statistic, steps_of
from dwell.estimators.prices import SEED
from dwell.estimators.profile import Profile, SampleCycles
from dwell.estimators.spans import Spans, patience_ns, spans_of
from dwell.model.bounds import VALUE, shown
from dwell.model.pipeline import Flow
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS
from dwell.model.semantics import nearest

Floats: TypeAlias = NDArray[np.float64]

#: Sample cycles from which ratios and bounds are taken where none are given.
SAMPLES = 4000


class Scaling:
    """Estimates upper bounds of QoS from the active placement alone.

    Parameters
    ----------
    ratios : mapping of (task, node, other node) to float, optional
        Compute time on the other node over that on the node; what is missing is the 95th percentile
        of the profile's there over its median here.
    bounds_ms : mapping of str to float, optional
        Largest delay of each link (``R1->E``), transmission not included, milliseconds; what is
        missing is the largest in the profile's sample cycles.

    Raises
    ------
    ProblemError
        If a ratio or bound is negative or not finite, or is of something that does not exist.
    """

    def __init__(
        self,
        problem: Problem,
        ratios: Mapping[tuple[str, str, str], float] | None = None,
        bounds_ms: Mapping[str, float] | None = None,
    ) -> None:
        self._given, self._bounds = dict(ratios or {}), dict(bounds_ms or {})
        self.start(problem)

    def __repr__(self) -> str:
        return f"Scaling(ratios={self._given}, bounds_ms={self._bounds})"

    def start(self, problem: Problem) -> None:
        """Forget the last window."""
        faults = [*_unknown_ratios(self._given, problem), *_unknown_bounds(self._bounds, problem)]
        if faults:
            raise ProblemError(faults)
        self.problem = problem
        self.profile = Profile(problem)
        self._sampled = SampleCycles(problem, SAMPLES, SEED)
        self._steps = steps_of(problem.pipeline)
        names = list(problem.pipeline.tasks)
        self._sources = [names.index(flow.source) for flow in problem.pipeline.flows]
        self._ratios = dict(self._given)
        self._spans: Spans | None = None
        self._active: Placement | None = None

    def learn(self, evidence: Evidence) -> None:
        """Take in what the cycles of a window took; those of an earlier placement are left out."""
        newest = int(evidence.placement[-1])
        cycles = evidence.cycles.at(evidence.placement == newest)
        limit_ns = evidence.close_ns - patience_ns(self.problem)
        self._spans = spans_of(cycles, cycles.end_ns[:, self._sources], limit_ns)
        self._active = tuple(self.problem.candidates.values())[newest]

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
        pipeline = self.problem.pipeline
        executed = [
            self._executed(name, spans.job_ms[:, column], active, placement)
            for column, name in enumerate(pipeline.tasks)
        ]
        sent = [
            self._sent(flow, spans.message_ms[:, column], active, placement)
            for column, flow in enumerate(pipeline.flows)
        ]
        # To whole nanoseconds, as everything is timed.
        latency_ms = np.round(longest_path(self._steps, executed, sent), 6)
        missed = int(np.count_nonzero(latency_ms > pipeline.deadline_ms))
        l95_ms = order_statistic(latency_ms)
        bound_ms = self.problem.censor_ms
        return QoS(min(l95_ms, bound_ms), missed / len(latency_ms), known.utilisation, l95_ms)

    def _executed(
        self, task: str, taken_ms: Floats, active: Placement, placement: Placement
    ) -> Floats:
        """Bound the time of a task's job in each cycle."""
        here, there = active[task], placement[task]
        if here == there:
            return _or_infinite(taken_ms)
        ratio = self._ratio(task, here, there)
        if ratio in (0.0, math.inf):  # whatever it took here
            return np.full(len(taken_ms), ratio)
        return _or_infinite(taken_ms * ratio)

    def _sent(
        self, flow: Flow, taken_ms: Floats, active: Placement, placement: Placement
    ) -> Floats | float:
        """Bound the time of a flow's message in each cycle."""
        source, target = placement[flow.source], placement[flow.target]
        if source == target:
            return 0.0
        if (source, target) == (active[flow.source], active[flow.target]):
            return _or_infinite(taken_ms)
        return self._bound_ms(flow, placement)

    def _ratio(self, task: str, here: str, there: str) -> float:
        """Compute time there over that here; infinite where there is none here."""
        key = (task, here, there)
        if key not in self._ratios:
            usual = float(np.median(self._sampled.executed(task, here)))
            longest = order_statistic(self._sampled.executed(task, there))
            none = math.inf if longest > 0 else 0.0
            self._ratios[key] = longest / usual if usual > 0 else none
        return self._ratios[key]

    def _bound_ms(self, flow: Flow, placement: Placement) -> float:
        """Longest time that a flow's message takes on a link that it does not use now."""
        link = self.problem.fabric.links[f"{placement[flow.source]}->{placement[flow.target]}"]
        if link.name in self._bounds:
            return self._bounds[link.name] + 8 * flow.payload_bytes / (link.rate_mbps * 1e3)
        times = self._sampled.sent(flow, placement)
        finite = times[np.isfinite(times)]
        return float(finite.max()) if len(finite) else math.inf


def _or_infinite(times_ms: Floats) -> Floats:
    """Let what is not known be infinite."""
    return np.where(np.isnan(times_ms), math.inf, times_ms)


def _unknown_ratios(
    ratios: Mapping[tuple[str, str, str], float], problem: Problem
) -> Iterator[Fault]:
    sites = [(name, node) for name, task in problem.pipeline.tasks.items() for node in task.on]
    known = ", ".join(f"{task} on {node}" for task, node in sites)
    for key, ratio in ratios.items():
        path = f"ratios[{', '.join(map(repr, key))}]"
        task, here, there = key
        if not {(task, here), (task, there)} <= set(sites):
            yield Fault(path, f"is of no task on two of its nodes (known: {known})")
        elif not VALUE.holds(ratio):
            yield Fault(path, f"{shown(ratio)} is not allowed; it must be {VALUE}")


def _unknown_bounds(bounds_ms: Mapping[str, float], problem: Problem) -> Iterator[Fault]:
    links = problem.fabric.links
    for name, bound_ms in bounds_ms.items():
        path = f"bounds_ms[{name!r}]"
        if name not in links:
            yield Fault(path, f"is of no link; {nearest(name, links)}")
        elif not VALUE.holds(bound_ms):
            yield Fault(path, f"{shown(bound_ms)} is not allowed; it must be {VALUE}")
