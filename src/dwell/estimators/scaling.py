"""Scaling: estimates of all candidates from measurements of the active placement.

Scaling sends no shadow jobs. If a task takes longer than declared on its node, it assumes the same
factor on every other node. A *ratio* is the compute time of a task on another node over its time on
this node, in every cycle. A *bound* is the largest delay of an unused link. They replace declared
values when candidates are simulated (see `dwell.estimators.online`).

Bounds
    If all ratios and bounds of a candidate are given, its estimates are at least L95 and V_D of its
    *queue-free* window. The latency of a cycle is then the longest path of execution times, each
    alone on a node without stress and quota, and of messages, each alone on its link. The estimates
    are upper bounds of the true queue-free values, cycle by cycle on the same realisation, if every
    job of the window has completed and

    * ratios are true: exec there <= ratio * exec here in every cycle (a task with more threads than
      a node has cores takes threads / cores times as long there, which counts);
    * bounds are true: on a link that its flow does not use now every message arrives within the
      bound, repeated attempts included;
    * a link that its flow uses now is no worse for the message when the candidate would send it. A
      link with its declared behaviour meets this condition.

    The work of a job that waited or was replaced is unknown; it counts as the longest known work.
    L95 is cut at ``problem.censor_ms``. With several rates a cycle has the sinks that are due in
    it, and tasks behind sampled flows are on no path.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from dwell.errors import Fault, ProblemError
from dwell.estimators.evidence import NOT_DUE, Evidence
from dwell.estimators.learning import Learning
from dwell.estimators.measured import Message, Part, Site, cores_of, message_of, sending_ns
from dwell.estimators.paths import longest_path, steps_of
from dwell.estimators.spans import NS_PER_MS, patience_ns, spans_ms
from dwell.model.bounds import VALUE, shown
from dwell.model.number_arrays import Floats
from dwell.model.order_statistic import percentile
from dwell.model.placement import Copy
from dwell.model.problem import Problem
from dwell.model.qos import QoS
from dwell.model.semantics import nearest


class Scaling(Learning):
    """Estimates QoS from the active placement alone.

    Parameters
    ----------
    ratios : mapping of (task, node, other node) to float, optional
        Compute time on the other node over the time on the node [default: as declared].
    bounds_ms : mapping of str to float, optional
        Largest delay of each link (``R1->E``) without transmission, milliseconds [default: as
        declared].

    Raises
    ------
    ProblemError
        If a ratio or bound is negative or not finite, or names an unknown task, node or link.
    """

    MEMORY: ClassVar[float] = 1.0
    UNSEEN: ClassVar[float] = math.inf

    def __init__(
        self,
        problem: Problem,
        ratios: Mapping[tuple[str, str, str], float] | None = None,
        bounds_ms: Mapping[str, float] | None = None,
    ) -> None:
        self._ratios, self._bounds = dict(ratios or {}), dict(bounds_ms or {})
        super().__init__(problem, shadow_fraction=0.0)

    def __repr__(self) -> str:
        return f"Scaling(ratios={self._ratios}, bounds_ms={self._bounds})"

    def start(self, problem: Problem) -> None:
        """Forget all windows."""
        faults = [*_unknown_ratios(self._ratios, problem), *_unknown_bounds(self._bounds, problem)]
        if faults:
            raise ProblemError(faults)
        super().start(problem)
        self._steps = steps_of(problem.pipeline)
        names = list(problem.pipeline.tasks)
        self._sources = [names.index(flow.source) for flow in problem.pipeline.flows]
        every = problem.pipeline.message_rates.values()
        self._message_patience_ns = np.array([patience_ns(problem, rate) for rate in every])
        rates = problem.pipeline.sink_rates
        #: Tasks on waited ways to a sink; the latency of a cycle does not depend on the others.
        self._on_path = {name for name in names if rates[name]}
        #: Longest known time of each task, alone on its node, milliseconds.
        self._longest: dict[Site, float] = {}
        self._active: Copy | None = None
        #: Times of jobs (each alone) and of messages in the last window, milliseconds, by cycle.
        self._jobs, self._messages = np.empty((0, 0)), np.empty((0, 0))
        #: Whether each task is due in each cycle of the last window.
        self._is_due = np.empty((0, 0), np.bool_)

    def _take_in(self, evidence: Evidence) -> None:
        super()._take_in(evidence)
        newest = int(evidence.placement[-1])
        active = tuple(self.problem.candidates.values())[newest].first
        self._has_changed |= active != self._active
        self._active = active
        if self._ratios or self._bounds:
            self._has_grown = True
            self._keep_cycles(evidence, newest)

    def _keep_cycles(self, evidence: Evidence, newest: int) -> None:
        """Keep the times of the cycles under the newest placement, of their first copies."""
        tasks, flows = len(self.problem.pipeline.tasks), len(self.problem.pipeline.flows)
        active = tuple(self.problem.candidates.values())[newest].first
        rows = evidence.placement == newest
        cycles = evidence.cycles.at(rows)
        work_ns = self._meter.work_ns(evidence.cycles, evidence.placement, self._threads)[rows]
        cores = [
            cores_of(self.problem.fabric.nodes[active[name]], task.on[active[name]])
            for name, task in self.problem.pipeline.tasks.items()
        ]
        work_ns = work_ns[:, :tasks]
        alone_ms = np.where(work_ns >= 0, work_ns, np.nan) / cores / NS_PER_MS
        for column, task in enumerate(self.problem.pipeline.tasks):
            alone_ms[:, column] = self._filled(Site(task, active[task]), alone_ms[:, column])
        limit_ns = evidence.close_ns - self._message_patience_ns
        self._jobs, self._is_due = alone_ms, cycles.end_ns[:, :tasks] != NOT_DUE
        sent_ns = cycles.end_ns[:, self._sources]
        self._messages = spans_ms(sent_ns, cycles.arrived_ns[:, :flows], limit_ns)

    def _filled(self, site: Site, alone_ms: Floats) -> Floats:
        """Replace unknown times by the longest known time, or by the declared 95th percentile."""
        known = alone_ms[np.isfinite(alone_ms)]
        if len(known):
            self._longest[site] = float(known.max())
        elif site not in self._longest:
            declared = self._pools[site].reference.values
            self._longest[site] = percentile(declared, 95) if len(declared) else 0.0
        return np.where(np.isnan(alone_ms), self._longest[site], alone_ms)

    def _correct(self, changed: Sequence[Part], measured: frozenset[Part]) -> None:
        sites = [part for part in changed if isinstance(part, Site)]
        # The site with the most samples is last and overrides the others.
        for site in sorted(sites, key=lambda site: (self._pools[site].measured, site)):
            for other, pool in self._pools.items():
                if isinstance(other, Site) and other.task == site.task and other not in measured:
                    pool.follow(self._pools[site], self._window)

    def _otherwise(self) -> dict[Part, Floats]:
        found = super()._otherwise()
        active = self._active
        if active is None or not len(self._jobs):
            return found
        columns = list(self.problem.pipeline.tasks)
        for (task, here, there), ratio in self._ratios.items():
            if here == active[task] != there:
                found[Site(task, there)] = self._jobs[:, columns.index(task)] * ratio
        for part in self._pools:
            if not isinstance(part, Message) or part.link not in self._bounds:
                continue
            if part != message_of(part.source, part.target, active):
                found[part] = np.array([self._bounds[part.link]])
        return found

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate every candidate's metrics (see `Estimator`)."""
        estimates = super().estimate(observed=observed, incumbent=incumbent, own=own)
        # The latency of a cycle bounds no data age.
        has_path = self.problem.objective.latency is None
        if self._active is not None and len(self._jobs) and has_path:
            # The other copy may be faster than the first one.
            for name, placement in self.problem.plain_candidates.items():
                estimates[name] = self._at_least(estimates[name], placement.first, self._active)
        return estimates

    def _at_least(self, qos: QoS, placement: Copy, active: Copy) -> QoS:
        """Raise metrics to at least the metrics of the window's cycles without queues."""
        pipeline, columns = self.problem.pipeline, list(self.problem.pipeline.tasks)
        executed = [
            self._executed(column, task, active, placement)
            for column, task in enumerate(pipeline.tasks)
        ]
        sent = [
            self._sent_ms(
                message_of(flow.source, flow.target, placement),
                message_of(flow.source, flow.target, active),
                self._messages[:, column],
            )
            if flow.target in self._on_path and not flow.sampled
            else 0.0
            for column, flow in enumerate(pipeline.flows)
        ]
        known = [times for times in executed if times is not None]
        on_the_way = [times for times in sent if times is not None]
        if len(known) < len(executed) or len(on_the_way) < len(sent):
            return qos
        # Rounded to nanoseconds, like all times.
        latency_ms = np.round(longest_path(self._steps, known, on_the_way, self._is_due), 6)
        sinks = [columns.index(name) for name in pipeline.sinks]
        latency_ms = latency_ms[self._is_due[:, sinks].any(axis=1)]
        if not len(latency_ms):
            return qos
        missed = int(np.count_nonzero(latency_ms > pipeline.deadline_ms)) / len(latency_ms)
        bound_ms = percentile(latency_ms, 95)
        return replace(
            qos,
            l95_ms=max(qos.l95_ms, min(bound_ms, self.problem.censor_ms)),
            violation_rate=max(qos.violation_rate, missed),
            cut_from_ms=max(qos.uncut_l95_ms, bound_ms),
        )

    def _executed(self, column: int, task: str, active: Copy, placement: Copy) -> Floats | None:
        """Return a bound on the time of a task's job in each cycle; None if unknown."""
        here, there, alone_ms = active[task], placement[task], self._jobs[:, column]
        if here == there or task not in self._on_path:
            return alone_ms
        ratio = self._ratios.get((task, here, there))
        return None if ratio is None else alone_ms * ratio

    def _sent_ms(
        self, part: Message | None, active: Message | None, taken_ms: Floats
    ) -> Floats | float | None:
        """Return a bound on the time of a flow's message in each cycle; None if unknown."""
        if part is None:
            return 0.0
        bound_ms = self._bounds.get(part.link)
        if bound_ms is not None:
            bound_ms += sending_ns(self.problem, part) / NS_PER_MS
        if part != active:
            return bound_ms
        known = taken_ms[np.isfinite(taken_ms)]
        # Unknown times get the bound of the link, else the longest known time.
        most = bound_ms if bound_ms is not None else float(known.max()) if len(known) else math.inf
        return np.where(np.isnan(taken_ms), most, taken_ms)


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
