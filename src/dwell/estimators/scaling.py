"""Scaling: careful estimates from what the active placement was measured to take.

A job that a candidate runs where it runs now counts with its own work, as long as it would take
alone there; one that the candidate runs elsewhere counts with that times the known ratio of the two
nodes' compute times. A message that crosses the same link as now counts with its delay; on any
other link with the declared bound of that link. With these in the place of what is declared every
candidate is played (see `dwell.estimators.online`), and never counts as less than its bound. Of a
job that waited or was replaced the work is not known; it counts as the longest that is.

What is bounded
    The latency of each cycle as it would be *queue-free* under the candidate: the longest path of
    its execution times, each alone on a node without stress and quota, and of its messages, each
    alone on its link. So the bound holds, cycle by cycle on the same realisation, where every job
    of the window has completed and

    * ratios are true: exec there <= ratio * exec here in every cycle (a task with more threads than
      a node has cores takes threads / cores times as long there, which counts);
    * declared bounds hold: no message takes longer on a link that its flow does not use now,
      repeated attempts included, nor is one lost there;
    * a link that its flow does use is no worse for the message at the instant at which the
      candidate would send it. Where it is as it was declared, that is so.

    And so it does for the L95 and the V_D of the window's cycles, up to the censoring of L95 at
    ``problem.censor_ms``.

What is not
    Ratios that are not given are taken from the profile: its 95th percentile there over its median
    here. That is no bound on a cycle, only a cautious factor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import Fault, ProblemError
from dwell.estimators.evidence import Evidence
from dwell.estimators.measured import Message, Part, Site, cores_of, message_of
from dwell.estimators.online import Online
from dwell.estimators.paths import longest_path, order_statistic, steps_of
from dwell.estimators.spans import spans_of
from dwell.model.bounds import VALUE, shown
from dwell.model.pipeline import Flow
from dwell.model.placement import Placement
from dwell.model.problem import Problem
from dwell.model.qos import QoS
from dwell.model.semantics import nearest

Floats: TypeAlias = NDArray[np.float64]

NS_PER_MS = 1e6


class Scaling(Online):
    """Estimates upper bounds of QoS from the active placement alone.

    Parameters
    ----------
    ratios : mapping of (task, node, other node) to float, optional
        Compute time on the other node over that on the node; what is missing is the 95th percentile
        of the profile's there over its median here.
    bounds_ms : mapping of str to float, optional
        Largest delay of each link (``R1->E``), transmission not included, milliseconds; what is
        missing is the largest that the undisturbed cell shows.

    Raises
    ------
    ProblemError
        If a ratio or bound is negative or not finite, or is of something that does not exist.
    """

    FIRST_STEPS: ClassVar[int] = 2

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
        super().start(problem)
        self._references = self._playing.declared.references
        self._steps = steps_of(problem.pipeline)
        names = list(problem.pipeline.tasks)
        self._sources = [names.index(flow.source) for flow in problem.pipeline.flows]
        self._ratios = dict(self._given)
        #: Longest work of each task that is known, on the node that it was on.
        self._longest: dict[Site, float] = {}
        self._active: Placement | None = None
        #: Times of each cycle of the last window, milliseconds: of its jobs alone, of its messages.
        self._jobs, self._messages = np.empty((0, 0)), np.empty((0, 0))
        self._delays: Mapping[Part, Floats] = {}

    def _take_in(self, demands: Mapping[Part, Floats], evidence: Evidence) -> None:
        """Take in what the cycles of a window took; those of an earlier placement are left out."""
        newest = int(evidence.placement[-1])
        self._active = active = tuple(self.problem.candidates.values())[newest]
        rows = evidence.placement == newest
        cycles = self._meter.with_work(evidence.cycles, evidence.placement, self._threads).at(rows)
        work_ns = cycles.work_ns
        assert work_ns is not None
        alone_ms = np.where(work_ns >= 0, work_ns, np.nan) / self._cores(active) / NS_PER_MS
        for column, task in enumerate(self.problem.pipeline.tasks):
            alone_ms[:, column] = self._filled(Site(task, active[task]), alone_ms[:, column])
        limit_ns = evidence.close_ns - self._patience_ns
        self._jobs = alone_ms
        self._messages = spans_of(cycles, cycles.end_ns[:, self._sources], limit_ns).message_ms
        self._delays = {
            part: values.copy() for part, values in demands.items() if isinstance(part, Message)
        }
        self._has_changed = True

    def _cores(self, placement: Placement) -> Floats:
        """Cores that the job of each task has where nothing is in its way."""
        nodes = self.problem.fabric.nodes
        return np.array(
            [
                cores_of(nodes[placement[name]], task.on[placement[name]])
                for name, task in self.problem.pipeline.tasks.items()
            ]
        )

    def _filled(self, site: Site, alone_ms: Floats) -> Floats:
        """Let work that is not known be the longest that is."""
        known = alone_ms[np.isfinite(alone_ms)]
        if len(known):
            self._longest[site] = float(known.max())
        elif site not in self._longest:
            declared = self._references[site].values
            self._longest[site] = order_statistic(declared) if len(declared) else 0.0
        return np.where(np.isnan(alone_ms), self._longest[site], alone_ms)

    def _otherwise(self) -> dict[Part, Floats]:
        active = self._active
        if active is None:
            return {}
        found: dict[Part, Floats] = {}
        for placement in self.problem.candidates.values():
            for column, task in enumerate(self.problem.pipeline.tasks):
                site = Site(task, placement[task])
                if site not in found:
                    found[site] = self._executed(column, task, active, placement)
            for flow in self.problem.pipeline.flows:
                part = message_of(flow.source, flow.target, placement)
                if part is None or part in found:
                    continue
                is_active = part == message_of(flow.source, flow.target, active)
                if is_active and part in self._delays:
                    found[part] = self._delays[part]
                else:
                    found[part] = np.array([self._bound_ms(part)])
        return found

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics (see `Estimator`); by the profile before any window."""
        estimates = super().estimate(observed=observed, incumbent=incumbent, own=own)
        active = self._active
        if active is None:
            return estimates
        return {
            name: self._at_least(estimates[name], placement, active)
            for name, placement in self.problem.candidates.items()
        }

    def _at_least(self, qos: QoS, placement: Placement, active: Placement) -> QoS:
        """Let metrics be no less than those of the window's cycles, each queue-free."""
        pipeline = self.problem.pipeline
        executed = [
            self._executed(column, task, active, placement)
            for column, task in enumerate(pipeline.tasks)
        ]
        sent = [
            self._sent_ms(flow, self._messages[:, column], active, placement)
            for column, flow in enumerate(pipeline.flows)
        ]
        # To whole nanoseconds, as everything is timed.
        latency_ms = np.round(longest_path(self._steps, executed, sent), 6)
        missed = int(np.count_nonzero(latency_ms > pipeline.deadline_ms)) / len(latency_ms)
        bound_ms = order_statistic(latency_ms)
        return replace(
            qos,
            l95_ms=max(qos.l95_ms, min(bound_ms, self.problem.censor_ms)),
            violation_rate=max(qos.violation_rate, missed),
            cut_from_ms=max(qos.uncut_l95_ms, bound_ms),
        )

    def _executed(self, column: int, task: str, active: Placement, placement: Placement) -> Floats:
        """Bound the time of a task's job in each cycle."""
        here, there, alone_ms = active[task], placement[task], self._jobs[:, column]
        if here == there:
            return alone_ms
        ratio = self._ratio(task, here, there)
        if ratio in (0.0, math.inf):  # whatever it took here
            return np.full(len(alone_ms), ratio)
        return alone_ms * ratio

    def _sent_ms(
        self, flow: Flow, taken_ms: Floats, active: Placement, placement: Placement
    ) -> Floats | float:
        """Bound the time of a flow's message in each cycle."""
        part = message_of(flow.source, flow.target, placement)
        if part is None:
            return 0.0
        bound_ms = self._bound_ms(part) + self._meter.sending_ms(part)
        if part == message_of(flow.source, flow.target, active):
            return np.where(np.isnan(taken_ms), bound_ms, taken_ms)
        return bound_ms

    def _ratio(self, task: str, here: str, there: str) -> float:
        """Compute time there over that here; infinite where there is none here."""
        key = (task, here, there)
        if key not in self._ratios:
            usual = self._references[Site(task, here)].usual
            values = self._references[Site(task, there)].values
            longest = order_statistic(values) if len(values) else math.inf
            none = math.inf if longest > 0 else 0.0
            self._ratios[key] = longest / usual if 0 < usual < math.inf else none
        return self._ratios[key]

    def _bound_ms(self, part: Message) -> float:
        """Longest delay of a message on a link that its flow does not use now."""
        if part.link in self._bounds:
            return self._bounds[part.link]
        times = self._references[part].values
        finite = times[np.isfinite(times)]
        return float(finite.max()) if len(finite) else math.inf


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
