"""LiveEvidence: the instants of jobs and messages that are known at the end of some cycles.

If a cycle never arrives at a sink, its jobs are unknown, unless a worker reports that a newer cycle
replaced it. The first unconfirmed message between two nodes then counts as lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from dwell.control import NOT_DUE, Evidence, Instants
from dwell.live.roles.cycle_ledger import UNKNOWN, Ledger, LiveCycle, by_site, jobs_in
from dwell.live.wire.messages import Hop
from dwell.model import Flow, Problem
from dwell.model.number_arrays import Ints
from dwell.model.placement import Copy, Replicas

#: Fields of `Instants` with a column per task.
OF_TASKS = "ready_ns", "start_ns", "end_ns", "work_ns"

#: Fields of `Instants`: of several cycles, or of one cycle or shadow.
Known: TypeAlias = dict[str, Ints]


class LiveEvidence:
    """See the module; with replicas the second copies have columns of their own."""

    def __init__(self, problem: Problem, ledger: Ledger) -> None:
        self._pipeline, self._candidates = problem.pipeline, problem.candidates
        self._ledger = ledger
        self._codes = {name: code for code, name in enumerate(problem.candidates)}
        self._every = frozenset(problem.pipeline.tasks)
        self._has_copies = bool(problem.replicas)

    def known(
        self,
        cycles: Sequence[LiveCycle],
        release_ns: Ints,
        close_ns: int,
        *,
        shadows: bool,
        earlier: Sequence[LiveCycle] = (),
    ) -> Evidence:
        """Return the instants of a window's jobs and messages that are known at its end.

        `shadows` tells whether the result has the shadows' instants. `earlier` are the cycles of
        `Evidence.earlier`.
        """
        own, of_shadows = self._unknown(cycles), self._unknown(cycles)
        through = np.full(len(cycles), -1, np.int64)
        for row, cycle in enumerate(cycles):
            through[row] = self._codes.get(cycle.shadow, -1)
            self._enter_cycle(_row(own, row), _row(of_shadows, row), cycle)
        for known in (own, of_shadows):
            known["work_ns"][known["end_ns"] > close_ns] = UNKNOWN
            for name in ("ready_ns", "start_ns", "end_ns", "arrived_ns"):
                known[name][known[name] > close_ns] = UNKNOWN
        for row, cycle in enumerate(cycles):
            if cycle.at_ns + cycle.latency_ns <= close_ns:
                self._mark_cancelled(_row(own, row), cycle)
        before = None
        if earlier:
            before_ns = np.array([cycle.at_ns for cycle in earlier], np.int64)
            before = self.known(earlier, before_ns, close_ns, shadows=shadows)
        return Evidence.of(
            close_ns=close_ns,
            release_ns=release_ns,
            placement=np.array([self._codes[cycle.placement] for cycle in cycles], np.int64),
            cycles=Instants(**own),
            shadow_placement=through,
            shadows=Instants(**of_shadows) if shadows else None,
            # Agents run shadow jobs in the lowest scheduling class of the system.
            shadows_share=False,
            earlier=before,
        )

    def _unknown(self, cycles: Sequence[LiveCycle]) -> Known:
        """Return the fields of `Instants` of some cycles: unknown, or not due."""
        pipeline, copies = self._pipeline, 1 + self._has_copies
        rates = {key: [pipeline.rates[name] for name in pipeline.tasks] for key in OF_TASKS}
        rates["arrived_ns"] = [*pipeline.message_rates.values()]
        numbers = np.array([cycle.number for cycle in cycles], np.int64)[:, None]
        return {
            name: np.where(numbers % np.array(of * copies, np.int64) == 0, UNKNOWN, NOT_DUE)
            for name, of in rates.items()
        }

    def _enter_cycle(self, own: Known, of_shadow: Known, cycle: LiveCycle) -> None:
        """Enter all reports of a cycle and of its shadow."""
        ledger = self._ledger
        apart = ledger.routes.apart(cycle.placement, cycle.shadow)
        for report in cycle.shadows if cycle.shadow in self._codes else ():
            ledger.doubt(cycle, report)
            ran = ledger.ran(report)
            self._enter(of_shadow, cycle, ran, apart, shadow=True)
            # Jobs that the shadow shares with the cycle, whose own report may be missing.
            self._enter(own, cycle, ran, self._every - apart)
            if len(ran) < len(report.hops):
                self._enter_arrivals(of_shadow, cycle, report.hops[-1], ())
        for report in cycle.all_reports:
            ledger.doubt(cycle, report)
            jobs = jobs_in(report)
            self._enter(own, cycle, jobs, self._every)
            if len(jobs) < len(report.hops):
                self._enter_arrivals(own, cycle, report.hops[-1], report.hops)
        reported = cycle.deaf or cycle.reports or ledger.is_replaced(cycle) or cycle.told
        if cycle.heard and not (reported or cycle.idle):
            for copy in self._candidates[cycle.placement].copies:
                self._mark_lost(own, cycle, copy)

    def _enter(
        self,
        known: Known,
        cycle: LiveCycle,
        hops: Sequence[Hop],
        tasks: frozenset[str],
        *,
        shadow: bool = False,
    ) -> None:
        """Enter instants and work of jobs, and the instants of the messages that reached them."""
        ledger = self._ledger
        for hop in hops:
            is_known = hop.task in tasks
            ready_ns = ledger.instant_ns(cycle, hop.node, hop.arrived_ns) if is_known else None
            if ready_ns is None:
                continue
            column = self._column(cycle, hop.task, hop.node, shadow=shadow)
            shift_ns, has_ended = ready_ns - hop.arrived_ns, hop.ended_ns != UNKNOWN
            if has_ended and not hop.warmup:
                known["start_ns"][column] = max(hop.started_ns + shift_ns, 0)
                known["end_ns"][column] = max(hop.ended_ns + shift_ns, 0)
                known["work_ns"][column] = ledger.work_ns(hop)
            # A shadow's last messages arrive at a sink whose job never runs.
            if not hop.warmup and (has_ended or hop.task not in ledger.sinks):
                known["ready_ns"][column] = max(ready_ns, 0)
            self._enter_arrivals(known, cycle, hop, () if shadow else hops)

    def _enter_arrivals(
        self, known: Known, cycle: LiveCycle, hop: Hop, hops: Sequence[Hop]
    ) -> None:
        """Enter the instants of the messages that reached a job.

        `hops` are the senders' jobs, none for a shadow, which has one copy.
        """
        ledger, jobs = self._ledger, by_site(hops) if self._has_copies else {}
        for source, arrived_ns in hop.inputs:
            column = ledger.flows.get((source, hop.task))
            at_ns = ledger.instant_ns(cycle, hop.node, arrived_ns)
            if column is None or at_ns is None:
                continue
            if jobs:
                sender = ledger.sender(cycle, jobs, hop, source)
                ends = [(one.task, one.node) for one in (sender, hop) if one is not None]
                column += len(ledger.flows) * any(ledger.is_second(cycle, *end) for end in ends)
            known["arrived_ns"][column] = max(at_ns, 0)

    def _column(self, cycle: LiveCycle, task: str, node: str, *, shadow: bool = False) -> int:
        """Return the column of a job."""
        second = not shadow and self._ledger.is_second(cycle, task, node)
        return self._ledger.tasks[task] + len(self._ledger.tasks) * second

    def _flow_column(self, cycle: LiveCycle, flow: Flow, copy: Copy) -> int:
        """Return the column of a flow in a copy of a cycle."""
        flows, ends = self._ledger.flows, (flow.source, flow.target)
        second = any(self._ledger.is_second(cycle, task, copy[task]) for task in ends)
        return flows[ends] + len(flows) * second

    def _mark_lost(self, known: Known, cycle: LiveCycle, copy: Copy) -> None:
        """Mark the first unconfirmed message of a copy between two nodes as lost."""
        for flow in self._ledger.forward:
            column = self._flow_column(cycle, flow, copy)
            is_lost = known["arrived_ns"][column] < 0 and self._ledger.loses(flow, cycle)
            if copy[flow.source] != copy[flow.target] and is_lost:
                source = self._column(cycle, flow.source, copy[flow.source])
                known["arrived_ns"][column] = UNKNOWN
                if known["end_ns"][source] < 0:
                    known["end_ns"][source] = cycle.at_ns
                return

    def _mark_cancelled(self, known: Known, cycle: LiveCycle) -> None:
        """Mark what the slower copy of a cycle that is done has not done: it shows no loss.

        A copy without any report is lost, unless the cycle was done before its hold ended.
        """
        placed = self._candidates[cycle.placement]
        if not isinstance(placed, Replicas):
            return
        arrived = known["arrived_ns"]
        arrived[arrived == UNKNOWN] = NOT_DUE
        # A job that is ready has been replaced, and its copy lost.
        unknown = (known["end_ns"] == UNKNOWN) & (known["ready_ns"] == UNKNOWN)
        for name in OF_TASKS:
            known[name][unknown] = NOT_DUE
        heard = self._ledger.complete(cycle) and not cycle.deaf
        held_ns = 0, round(placed.after_ms * 1e6)
        for copy, after_ns in zip(placed.copies, held_ns, strict=True):
            # Both copies share the messages between tasks with one node.
            columns = [
                self._flow_column(cycle, flow, copy)
                for flow in self._ledger.forward
                if not {flow.source, flow.target}.isdisjoint(placed.doubled)
            ]
            if heard and cycle.latency_ns > after_ns and (arrived[columns] < 0).all():
                self._mark_lost(known, cycle, copy)


def _row(known: Known, row: int) -> Known:
    """Return a view of the fields of one cycle."""
    return {name: instants[row] for name, instants in known.items()}
