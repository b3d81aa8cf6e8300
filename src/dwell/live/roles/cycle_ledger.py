"""LiveCycle: the messages about one cycle; Ledger: latency, jobs and evidence from them.

A job's instants travel with its output. If a cycle never arrives at a sink, its jobs are unknown,
unless a worker reports that a newer cycle replaced it. The ledger then assumes that the first
unconfirmed message between two nodes was lost.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

import msgspec
import numpy as np

from dwell.control import Evidence, Instants
from dwell.live.roles.loads import NodeLoad
from dwell.live.roles.offsets import UNBOUNDED_NS, Offsets
from dwell.live.wire.messages import (
    ACTUATED,
    BEHIND,
    CANCELLED,
    LATE,
    NOT_APPLIED,
    SAMPLED,
    STALE,
    Completion,
    Hop,
    Stamp,
)
from dwell.live.wire.wiring import lane_of
from dwell.model import Execution, Flow, Problem
from dwell.model.due_tasks import DueTasks
from dwell.model.fabric import accelerator_name
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints
from dwell.model.placement import Copy, Replicas
from dwell.record import Values

#: Whether the job belongs to the shadow; task and node.
JobName: TypeAlias = tuple[bool, str, str]
#: Task and node of a job.
Site: TypeAlias = tuple[str, str]
Jobs: TypeAlias = dict[JobName, Hop]

UNKNOWN = -1
#: Largest number of shadow completions kept per cycle.
MAX_SHADOWS = 16
#: Least share of a window in which a hook must have measured an accelerator.
HOOKED_SHARE = 0.5
#: Instant of a job or message in a cycle in which it is not due, or was cancelled.
NOT_DUE = -2
#: Outcomes of jobs that ended before a sink.
SHADOW, REPLACED = "shadow", "replaced"
#: Outcomes of messages that begin no job whose output counts.
WITHOUT_JOB = frozenset({SAMPLED, LATE, CANCELLED})


class Shift(msgspec.Struct, frozen=True, gc=False):
    """Shift from a node's clock to the stamper's, and the bound of its error."""

    by_ns: int
    bound_ns: int


class LiveCycle(msgspec.Struct, eq=False, gc=False):
    """One cycle of a live run.

    A controller keeps tens of thousands of cycles. They are in no reference cycle, so the garbage
    collector, which pauses the process, does not track them.

    Parameters
    ----------
    at_ns : int
        Release since the origin.
    origin_ns : int
        First release of the run, on the stamper's clock.
    heard : bool
        Whether a message with its stamp has arrived; if not, only its neighbours are known.
    idle : bool
        Whether no sink is due in it.

    Attributes
    ----------
    stamped_ns : int or None
        Arrival of its stamp, on the controller's clock.
    group_ns : int
        CPU time that the control group on the stamper's node had used at its release.
    reports : dict of str to Completion
        Completions by sink.
    heard_ns : dict of str to int
        Arrivals of the completions on the controller's clock, if known, by sink.
    arrivals : dict of (str, str, str) to Completion
        Reports of messages that have arrived where no job waits for them, and of cancelled jobs, by
        source, target and its node.
    replaced : dict of (str, str) to Completion
        Reports of jobs that a newer cycle replaced, by task and node.
    latency_ns : int
        `NEVER_NS` until all sinks have reported.
    parts_ns : tuple of int, or None
        Compute, queue, network.
    bound_ns : int
        Error bound of the latency, from the clocks.
    interval_ns : int or None
        Time from the arrival of its stamp to the arrival of its last completion, at the controller.
    stamper_interval_ns : int or None
        Time from its release to its last completion, on the stamper's clock alone.
    stamper_silences : int
        Silences that the stamper has reported with this time.
    told : bool
        Whether its latency is `stamper_interval_ns`, because not all sinks have reported here.
    deaf : bool
        Whether all messages of this cycle or of the next are missing: its completion may be lost.
    row : int
        Row in the record; -1 until the cycle is recorded.
    over_age : bool
        Whether the data of an actuation in it were too old, as known at the end of its window.
    acted_ns : tuple of int, or None
        Latency and data age at the actuation of the chain `objective.latency`.
    close_ns : int or None
        End of its window since the origin; None for a cycle outside windows.
    """

    run: int
    number: int
    term: int
    placement: str
    shadow: str
    at_ns: int
    origin_ns: int
    heard: bool
    idle: bool = False
    stamped_ns: int | None = None
    group_ns: int = UNKNOWN
    reports: dict[str, Completion] = {}
    heard_ns: dict[str, int] = {}
    shadows: tuple[Completion, ...] = ()
    arrivals: dict[tuple[str, str, str], Completion] = {}
    replaced: dict[Site, Completion] = {}
    latency_ns: int = NEVER_NS
    parts_ns: tuple[int, int, int] | None = None
    bound_ns: int = 0
    interval_ns: int | None = None
    stamper_interval_ns: int | None = None
    stamper_silences: int = 0
    told: bool = False
    deaf: bool = False
    row: int = -1
    window: int | None = None
    over_age: bool = False
    acted_ns: tuple[int, int] | None = None
    close_ns: int | None = None
    outcome: str = ""
    shifts: dict[str, Shift] = {}

    @classmethod
    def of(cls, stamp: Stamp, origin_ns: int, *, idle: bool = False) -> LiveCycle:
        """Return the cycle of a stamp."""
        at_ns = stamp.released_ns - origin_ns
        who = stamp.run, stamp.cycle, stamp.term, stamp.placement, stamp.shadow
        return cls(*who, at_ns, origin_ns, heard=True, idle=idle)

    @property
    def key(self) -> tuple[int, int]:
        """Run and cycle number, which order all cycles."""
        return self.run, self.number

    @property
    def hops(self) -> Iterator[Hop]:
        """Reported jobs of this cycle, not of its shadow; several sinks may report one job."""
        for done in (*self.replaced.values(), *self.reports.values()):
            yield from done.hops
        for done in self.arrivals.values():
            yield from _ended(done)

    @property
    def all_reports(self) -> Iterator[Completion]:
        """Reports with jobs of this cycle, not of its shadow."""
        yield from self.reports.values()
        yield from self.replaced.values()
        yield from self.arrivals.values()

    @property
    def segment(self) -> tuple[int, int, str]:
        """Run, term and placement; a migration changes them."""
        return self.run, self.term, self.placement

    def identify(self, stamp: Stamp) -> None:
        """Add the stamp to a cycle that was known only from its neighbours."""
        self.heard = True
        self.term, self.placement, self.shadow = stamp.term, stamp.placement, stamp.shadow
        if self.row < 0:
            self.at_ns = stamp.released_ns - self.origin_ns

    def take(self, completion: Completion, at_ns: int | None) -> bool:
        """Add a completion; return False if it is a copy."""
        if completion.outcome == SHADOW:
            new = len(self.shadows) < MAX_SHADOWS and completion not in self.shadows
            if new:
                self.shadows += (completion,)
            return new
        if completion.outcome in WITHOUT_JOB:
            source = next(iter(_arrived(completion)), "")
            key = source, completion.sink, completion.node
            return self.arrivals.setdefault(key, completion) is completion
        if completion.outcome == REPLACED:
            site = completion.sink, completion.node
            return self.replaced.setdefault(site, completion) is completion
        if completion.sink in self.reports:
            return False
        self.reports[completion.sink] = completion
        if at_ns is not None:
            self.heard_ns[completion.sink] = at_ns
        return True

    def heard_before(self, back_ns: int) -> None:
        """Shift the times of arrival after the controller's clock was set back."""
        if self.stamped_ns is not None:
            self.stamped_ns -= back_ns
        self.heard_ns = {sink: at_ns - back_ns for sink, at_ns in self.heard_ns.items()}

    @property
    def actuated(self) -> bool:
        """Whether all known reports say that a command was applied."""
        reports = self.reports.values()
        return bool(reports) and all(done.outcome == ACTUATED for done in reports)

    @property
    def late_copies(self) -> int:
        """Number of messages of its second copy to arrive that counted no more."""
        return sum(done.outcome == LATE for done in self.arrivals.values())

    @property
    def silences(self) -> int:
        """Number of applied commands of this cycle that found their actuator at rest."""
        reports = self.reports.values()
        known = sum(done.rested and done.outcome == ACTUATED for done in reports)
        return max(known, self.stamper_silences)

    def came_to(self, *outcomes: str) -> bool:
        """Whether a sink has reported one of these outcomes."""
        return any(done.outcome in outcomes for done in self.reports.values())

    @property
    def overtaken(self) -> bool:
        """Whether a sink's gate had passed the command of a later cycle."""
        return self.came_to(BEHIND)

    @property
    def untold(self) -> bool:
        """Whether it is unknown if the cycle has completed."""
        return self.deaf and not (self.reports or self.replaced or self.told or self.idle)

    def missed(self, deadline_ns: int) -> bool:
        """Whether it was later than D, unfinished at the end of its window, or not applied.

        A command that the gate found stale counts as missed, even if its latency is below D. So
        does a command whose data are older than a chain permits.
        """
        if self.untold or self.idle:
            return False
        if self.over_age or self.came_to(NOT_APPLIED, STALE):
            return True
        age_ns = NEVER_NS - 1 if self.close_ns is None else self.close_ns - self.at_ns
        return self.latency_ns > min(deadline_ns, age_ns)


def told(cycles: Sequence[LiveCycle]) -> Sequence[LiveCycle]:
    """Return the cycles of a window whose outcome is known; all cycles if none is known.

    Idle cycles are left out.
    """
    counted = [cycle for cycle in cycles if not cycle.idle]
    return [cycle for cycle in counted if not cycle.untold] or counted


def violation_rate(cycles: Sequence[LiveCycle], deadline_ns: int) -> float:
    """Return V_D, the share of cycles that missed their deadline; NaN without cycles."""
    missed = sum(cycle.missed(deadline_ns) for cycle in cycles)
    return missed / len(cycles) if cycles else math.nan


class Ledger:
    """Converts reported instants to the stamper's clock and computes latencies and evidence."""

    def __init__(self, problem: Problem, offsets: Offsets) -> None:
        pipeline = problem.pipeline
        self.sinks = frozenset(pipeline.sinks)
        #: Tasks that run in each cycle.
        self.due = DueTasks(pipeline)
        self._pipeline, self._candidates, self._offsets = pipeline, problem.candidates, offsets
        self._stamper_node = problem.stamper_node
        self._nodes, self._resources = problem.fabric.nodes, problem.fabric.resources
        #: CPU and accelerator time by node.
        self.loads = {node: NodeLoad() for node in self._nodes}
        self._tasks = {name: column for column, name in enumerate(pipeline.tasks)}
        self._flows = {(f.source, f.target): column for column, f in enumerate(pipeline.flows)}
        self._sampled = {(f.source, f.target) for f in pipeline.flows if f.sampled}
        self._codes = {name: code for code, name in enumerate(problem.candidates)}
        self._every = frozenset(pipeline.tasks)
        #: Columns per task and flow in the evidence.
        self._copies = 2 if problem.replicas else 1
        order = pipeline.topological()
        self._forward = sorted(pipeline.flows, key=lambda flow: order.index(flow.source))
        self._apart: dict[tuple[str, str], frozenset[str]] = {}
        self._accelerated: dict[str, frozenset[str]] = {}

    def tells(self, completion: Completion) -> bool:
        """Whether a completion's task can have its outcome: before a sink any task, else a sink."""
        early = completion.outcome in {SHADOW, REPLACED, *WITHOUT_JOB}
        return completion.sink in (self._every if early else self.sinks)

    # ------------------------------------------------------------------------ latency

    def complete(self, cycle: LiveCycle) -> bool:
        """Whether every due sink has reported a cycle; false for an idle cycle."""
        return not cycle.idle and self.due.sinks(cycle.number) <= cycle.reports.keys()

    def is_over(self, cycle: LiveCycle) -> bool:
        """Whether a cycle is complete or idle, and its sampled messages have arrived."""
        arrived = {(source, target) for source, target, _ in cycle.arrivals}
        sampled = {flow for flow in self._sampled if self.due.runs(flow[0], cycle.number)}
        return (cycle.idle or self.complete(cycle)) and sampled <= arrived

    def is_replaced(self, cycle: LiveCycle) -> bool:
        """Whether a later cycle has replaced a job that a due sink waits for."""
        return any(self.due.is_needed(task, cycle.number) for task, _ in cycle.replaced)

    def settle(self, cycle: LiveCycle, *, most_ns: int | None = None) -> None:
        """Compute latency and parts of a complete cycle.

        The stamper receives completions too, and reports the interval that it measured. Reports of
        the sinks have precedence, even if they arrive later. If the clocks' error bound exceeds
        `most_ns`, the cycle is left for later, when the bound may be tighter.
        """
        if not self.complete(cycle):
            if cycle.stamper_interval_ns is not None and most_ns is None:
                cycle.latency_ns, cycle.told = cycle.stamper_interval_ns, True
            return
        if cycle.latency_ns < NEVER_NS and not cycle.told:
            return
        cycle.told = False
        reports = cycle.reports.values()
        for done in reports:
            self._doubt(cycle, done)
        ends = [(self._since_origin(cycle, done.node, done.done_ns), done) for done in reports]
        done_ns, last = max(ends, key=lambda pair: pair[0])
        if cycle.stamped_ns is not None and len(cycle.heard_ns) == len(reports):
            cycle.interval_ns = max(max(cycle.heard_ns.values()) - cycle.stamped_ns, 0)
        cycle.bound_ns = max(cycle.shifts[done.node].bound_ns for done in reports)
        if most_ns is not None and cycle.bound_ns > most_ns:
            cycle.shifts.clear()
            return
        if cycle.bound_ns < UNBOUNDED_NS:
            cycle.latency_ns = max(done_ns - cycle.at_ns, 0)
            cycle.parts_ns = self._split(cycle, last)
        else:
            # The clocks have not been compared, so only intervals of one clock are left.
            own_ns = (cycle.interval_ns, cycle.stamper_interval_ns, cycle.latency_ns)
            cycle.latency_ns = next(ns for ns in own_ns if ns is not None)

    def _since_origin(self, cycle: LiveCycle, node: str, instant_ns: int) -> int:
        """Convert an instant of a node's clock to the stamper's, since the origin.

        All instants of a cycle on a node get one shift: in this time clocks drift by microseconds.
        """
        shift = cycle.shifts.get(node)
        if shift is None:
            found = self._offsets.to_reference(node, instant_ns)
            shift = cycle.shifts[node] = Shift(found.instant_ns - instant_ns, found.bound_ns)
        return instant_ns + shift.by_ns - cycle.origin_ns

    def instant_ns(self, cycle: LiveCycle, node: str, instant_ns: int) -> int | None:
        """Convert an instant as `_since_origin`; None if the clocks have not been compared."""
        at_ns = self._since_origin(cycle, node, instant_ns)
        return at_ns if cycle.shifts[node].bound_ns < UNBOUNDED_NS else None

    def _doubt(self, cycle: LiveCycle, done: Completion) -> None:
        """Mark the clocks as not compared if a cycle's instants are impossible with them.

        Jobs end after the release and before their report arrives, messages arrive after they are
        sent, and jobs end after they are ready. If instants contradict this by more than the error
        bounds, a clock was set after the last comparison.
        """
        known = [(done.node, done.done_ns)]
        hops = _by_site(done.hops)
        for hop in hops.values():
            if hop.ended_ns != UNKNOWN:
                known.append((hop.node, hop.ended_ns))
                if hop.ended_ns < hop.arrived_ns:
                    self._disbelieve(cycle, hop.node)
            for source, arrived_ns in hop.inputs:
                sender = self._sender(cycle, hops, hop, source)
                is_flow = (source, hop.task) in self._flows
                if sender is None or sender.ended_ns == UNKNOWN or not is_flow:
                    continue
                if sender.node == hop.node:
                    if arrived_ns < sender.ended_ns:
                        self._disbelieve(cycle, hop.node)
                    continue
                sent, arrived = (
                    self._within(cycle, node, at_ns)
                    for node, at_ns in ((sender.node, sender.ended_ns), (hop.node, arrived_ns))
                )
                if arrived[1] < sent[0]:
                    self._disbelieve(cycle, sender.node, hop.node)
        latest_ns = NEVER_NS
        if cycle.reports.get(done.sink) is done and done.sink in cycle.heard_ns:
            heard_ns = cycle.heard_ns[done.sink]
            _, latest_ns = self._within(cycle, self._offsets.node, heard_ns)
        for node, instant_ns in known:
            from_ns, until_ns = self._within(cycle, node, instant_ns)
            if until_ns < cycle.at_ns or from_ns > latest_ns:
                self._disbelieve(cycle, node)

    def _within(self, cycle: LiveCycle, node: str, instant_ns: int) -> tuple[int, int]:
        """Earliest and latest true time of an instant of a node's clock, since the origin."""
        at_ns = self._since_origin(cycle, node, instant_ns)
        bound_ns = cycle.shifts[node].bound_ns
        return at_ns - bound_ns, at_ns + bound_ns

    def _disbelieve(self, cycle: LiveCycle, *nodes: str) -> None:
        for node in nodes:
            known = cycle.shifts.get(node)
            cycle.shifts[node] = Shift(0 if known is None else known.by_ns, UNBOUNDED_NS)

    def span_ns(self, node: str, first: LiveCycle, close_ns: int) -> tuple[int, int]:
        """Start and end of a window on a node's clock."""
        begin_ns, end_ns = (
            self._offsets.from_reference(node, first.origin_ns + at_ns).instant_ns
            for at_ns in (first.at_ns, close_ns)
        )
        return begin_ns, end_ns

    def _sender(
        self, cycle: LiveCycle, hops: Mapping[Site, Hop], hop: Hop, source: str
    ) -> Hop | None:
        """Return the job that sent an input of a job, of the same copy if there are two."""
        for copy in self._candidates[cycle.placement].copies:
            sender = hops.get((source, copy.get(source, "")))
            if sender is not None and copy.get(hop.task) == hop.node:
                return sender
        # A guessed or repeated stamp has sent the cycle through other nodes, too.
        return next((one for one in reversed([*hops.values()]) if one.task == source), None)

    def _is_second(self, cycle: LiveCycle, task: str, node: str) -> bool:
        """Whether a job belongs to the second copy of a cycle alone."""
        placed = self._candidates[cycle.placement]
        second = placed.second
        return second is not None and second.get(task) == node != placed.first[task]

    def _split(self, cycle: LiveCycle, last: Completion) -> tuple[int, int, int] | None:
        """Split a latency into compute, queue and network along its critical path.

        The path runs backwards from the sink, to the input that arrived last at each job. Messages
        within a node count as queueing, and so do the ways to the first job and to the actuator.
        """
        hops = _by_site(last.hops)
        hop = hops.pop((last.sink, last.node), None)
        if hop is None:
            return None
        compute_ns = network_ns = 0
        while hop is not None:
            compute_ns += max(hop.ended_ns - hop.started_ns, 0)
            source, arrived_ns = max(hop.inputs, key=lambda given: given[1], default=("", 0))
            sender = self._sender(cycle, hops, hop, source)
            if sender is not None:
                del hops[sender.task, sender.node]
            if sender is not None and sender.node != hop.node:
                network_ns += self._since_origin(cycle, hop.node, arrived_ns)
                network_ns -= self._since_origin(cycle, sender.node, sender.ended_ns)
            hop = sender
        # Small clock errors must not make a part negative or the sum wrong.
        compute_ns = min(compute_ns, cycle.latency_ns)
        network_ns = min(max(network_ns, 0), cycle.latency_ns - compute_ns)
        return compute_ns, cycle.latency_ns - compute_ns - network_ns, network_ns

    # --------------------------------------------------------------------------- jobs

    def core_ns(self, cycles: Sequence[LiveCycle], close_ns: int) -> Floats:
        """Core-nanoseconds of every resource in a window: all, own, shadows; shape (3, resources).

        A node's own work is the CPU time of its jobs, if jobs report it. Messages and beats of
        their processes do not count as own work, because no candidate's estimate contains them.
        The busy time of accelerators comes from a hook if their node has one kind of accelerator
        and the hook measured it long enough; otherwise from the cell's jobs. Unknown values are
        NaN.
        """
        jobs_ns = self.spent_ns(cycles)
        by_jobs = self.accelerator_ns(cycles) if len(self._resources) > len(self.loads) else {}
        used = np.zeros((3, len(self._resources)))
        hooked: dict[str, float] = {}
        for column, (node, load) in enumerate(self.loads.items()):
            begin_ns, end_ns = self.span_ns(node, cycles[0], close_ns)
            *counted_ns, busy_ns, told_ns = load.at(end_ns) - load.at(begin_ns)
            used[:, column] = counted_ns
            if jobs_ns:
                used[1, column] = jobs_ns[node]
            kinds = self._nodes[node].accelerators.items()
            if len(kinds) == 1 and told_ns >= HOOKED_SHARE * (end_ns - begin_ns):
                ((kind, count),) = kinds
                busy = count * (close_ns - cycles[0].at_ns) * busy_ns / told_ns
                hooked[accelerator_name(node, kind)] = busy
        for column, name in enumerate(self._resources):
            if column >= len(self.loads):
                own_ns, shadow_ns = by_jobs.get(name, (0.0, 0.0))
                busy_ns = hooked.get(name, own_ns + shadow_ns)
                used[:, column] = busy_ns, own_ns, shadow_ns
        return used

    def forget(self, before: LiveCycle) -> None:
        """Drop load reports that only earlier cycles need."""
        for node, load in self.loads.items():
            load.forget(self.span_ns(node, before, before.at_ns)[0])

    def spent_ns(self, cycles: Sequence[LiveCycle]) -> Counter[str]:
        """Return the reported CPU time of the cycles' jobs, by node.

        Tasks on an accelerator are left out: profiles do not count their CPU time as work.
        """
        spent = Counter[str]()
        for cycle in cycles:
            # Several sinks may report one job.
            for hop in {(hop.task, hop.node): hop for hop in cycle.hops}.values():
                execution = self._execution(hop)
                on_cpu = execution is not None and execution.accelerator is None
                if hop.cpu_ns != UNKNOWN and on_cpu:
                    spent[hop.node] += hop.cpu_ns
        return spent

    def accelerator_ns(self, cycles: Iterable[LiveCycle]) -> dict[str, tuple[float, float]]:
        """Return the time that jobs of the cycles, and of their shadows, used each accelerator.

        Waiting for the accelerator counts, as the time runs from start to end of the job. The
        first value is NaN for an accelerator of the placement for which no job reported a time.
        """
        own, shadow, placed = Counter[str](), Counter[str](), set[str]()
        for cycle in cycles:
            placed |= self._accelerators_of(cycle.placement)
            for (is_shadow, *_), hop in self._jobs(cycle).items():
                execution = self._execution(hop)
                if execution is None or execution.accelerator is None or hop.ended_ns == UNKNOWN:
                    continue
                spent = shadow if is_shadow else own
                spent[execution.resource(hop.node)] += self._work_ns(hop)
        return {
            name: (
                float(own[name]) if name in own or name not in placed else math.nan,
                shadow[name],
            )
            for name in {*own, *shadow, *placed}
        }

    def _accelerators_of(self, candidate: str) -> frozenset[str]:
        """Resource names of the accelerators that a candidate's tasks run on."""
        known = self._accelerated.get(candidate)
        if known is None:
            placed = self._candidates[candidate].sites
            executions = ((self._pipeline.tasks[task].on[node], node) for task, node in placed)
            names = (one.resource(node) for one, node in executions if one.accelerator is not None)
            known = self._accelerated[candidate] = frozenset(names)
        return known

    def _execution(self, hop: Hop) -> Execution | None:
        """Return the execution of a job's task on its node, or None."""
        task = self._pipeline.tasks.get(hop.task)
        return None if task is None else task.on.get(hop.node)

    def _work_ns(self, hop: Hop) -> int:
        """CPU time of a job that has ended, or its time on an accelerator; else `UNKNOWN`."""
        execution = self._execution(hop)
        if execution is None or hop.ended_ns == UNKNOWN:
            return UNKNOWN
        if execution.accelerator is None:
            return hop.cpu_ns
        return max(hop.ended_ns - hop.started_ns, 0)

    def jobs(self, cycle: LiveCycle) -> list[Values]:
        """Return the rows of ``jobs`` for the known jobs of a cycle and its shadow."""
        jobs = self._jobs(cycle)
        order = sorted(jobs, key=lambda key: (key[0], self._tasks[key[1]]))
        rows = (self._job_values(cycle, jobs, key) for key in order)
        return [row for row in rows if row is not None]

    def _jobs(self, cycle: LiveCycle) -> Jobs:
        """Jobs of a cycle and its shadow."""
        jobs: Jobs = {}
        apart = self._diverging(cycle) if cycle.shadow in self._codes else frozenset[str]()
        hops = [(hop, False) for hop in cycle.hops]
        ended = [hop for done in cycle.shadows for hop in self._ran(done)]
        hops += [(hop, hop.task in apart) for hop in ended]
        for hop, shadow in hops:
            if hop.task not in self._tasks or (shadow and hop.task in self.sinks):
                continue
            known = jobs.get((shadow, hop.task, hop.node))
            if known is None or known.ended_ns == UNKNOWN:
                jobs[shadow, hop.task, hop.node] = hop
        return jobs

    def _handover_ns(self, cycle: LiveCycle, jobs: Jobs, hop: Hop, *, shadow: bool) -> int:
        """CPU time of a node's control group between the release or the previous job, and a job."""
        flows = self._pipeline.inputs(hop.task)
        before_ns = UNKNOWN
        if not flows and hop.node == self._stamper_node:
            before_ns = cycle.group_ns
        elif len(flows) == 1 and (shadow, flows[0].source, hop.node) in jobs:
            before_ns = jobs[shadow, flows[0].source, hop.node].group_ns[1]
        return _between(before_ns, hop.group_ns[0])

    def _ending_ns(self, cycle: LiveCycle, hop: Hop) -> int:
        """CPU time of a node's control group between a sink's job and the hand-over to the sink."""
        done = cycle.reports.get(hop.task)
        if done is None or done.node != hop.node:
            return UNKNOWN
        return _between(hop.group_ns[1], done.group_ns)

    def _job_values(self, cycle: LiveCycle, jobs: Jobs, key: JobName) -> Values | None:
        hop, shadow = jobs[key], key[0]
        is_second = not shadow and self._is_second(cycle, hop.task, hop.node)
        ready_ns = self._since_origin(cycle, hop.node, hop.arrived_ns)
        if cycle.shifts[hop.node].bound_ns >= UNBOUNDED_NS:
            return None
        if not self._pipeline.inputs(hop.task):
            # The stamp may have arrived before the cycle began.
            offset_ns = round(self._pipeline.tasks[hop.task].offset_ms * 1e6)
            ready_ns = max(ready_ns, cycle.at_ns + offset_ns)
        ended = hop.ended_ns != UNKNOWN
        start_ns = max(self._since_origin(cycle, hop.node, hop.started_ns), ready_ns)
        counted_ns = {
            "cpu_ns": hop.cpu_ns,
            "others_ns": hop.others_ns,
            "handover_ns": self._handover_ns(cycle, jobs, hop, shadow=shadow),
            "ending_ns": UNKNOWN if shadow else self._ending_ns(cycle, hop),
        }
        return {
            "cycle": cycle.row,
            "task": hop.task,
            "node": hop.node,
            "ready_ns": ready_ns,
            "start_ns": start_ns if ended else None,
            "end_ns": (
                max(self._since_origin(cycle, hop.node, hop.ended_ns), start_ns) if ended else None
            ),
            "outcome": "done" if ended else "replaced",
            "shadow": shadow,
            **({"second": is_second} if self._copies > 1 else {}),
            **{name: ns if ended and ns != UNKNOWN else None for name, ns in counted_ns.items()},
        }

    # ----------------------------------------------------------------------- evidence

    def evidence(
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
        known, of_shadows = self._unknown(len(cycles)), self._unknown(len(cycles))
        for tables in (known, of_shadows):
            self._mark_not_due(tables, cycles)
        through = np.full(len(cycles), -1, np.int64)
        for row, cycle in enumerate(cycles):
            if cycle.shadow in self._codes:
                through[row] = self._codes[cycle.shadow]
                apart = self._diverging(cycle)
                for report in cycle.shadows:
                    self._doubt(cycle, report)
                    ran = self._ran(report)
                    self._enter(of_shadows, row, cycle, ran, apart, shadow=True)
                    # Jobs that the shadow shares with the cycle, whose own report may be missing.
                    self._enter(known, row, cycle, ran, self._every - apart)
                    if len(ran) < len(report.hops):
                        self._enter_arrivals(of_shadows, row, cycle, report.hops[-1], ())
            for report in (*cycle.replaced.values(), *cycle.reports.values()):
                self._doubt(cycle, report)
                self._enter(known, row, cycle, report.hops, self._every)
            for report in cycle.arrivals.values():
                self._doubt(cycle, report)
                self._enter(known, row, cycle, _ended(report), self._every)
                if report.hops and report.hops[-1].ended_ns == UNKNOWN:
                    self._enter_arrivals(known, row, cycle, report.hops[-1], report.hops)
            reported = cycle.deaf or cycle.reports or self.is_replaced(cycle) or cycle.told
            if cycle.heard and not (reported or cycle.idle):
                for copy in self._candidates[cycle.placement].copies:
                    self._mark_lost(known, row, cycle, copy)
        for tables in (known, of_shadows):
            tables["work_ns"][tables["end_ns"] > close_ns] = UNKNOWN
            for name in ("ready_ns", "start_ns", "end_ns", "arrived_ns"):
                tables[name][tables[name] > close_ns] = UNKNOWN
        for row, cycle in enumerate(cycles):
            if cycle.at_ns + cycle.latency_ns <= close_ns:
                self._mark_cancelled(known, row, cycle)
        before = None
        if earlier:
            before_ns = np.array([cycle.at_ns for cycle in earlier], np.int64)
            before = self.evidence(earlier, before_ns, close_ns, shadows=shadows)
        return Evidence.of(
            close_ns=close_ns,
            release_ns=release_ns,
            placement=np.array([self._codes[cycle.placement] for cycle in cycles], np.int64),
            cycles=Instants(**known),
            shadow_placement=through,
            shadows=Instants(**of_shadows) if shadows else None,
            # Agents run shadow jobs in the lowest scheduling class of the system.
            shadows_share=False,
            earlier=before,
        )

    def _unknown(self, cycles: int) -> dict[str, Ints]:
        """Return the fields of `Instants`, filled with `UNKNOWN`."""
        of_tasks, of_flows = (self._copies * len(of) for of in (self._tasks, self._flows))
        columns = dict.fromkeys(("ready_ns", "start_ns", "end_ns", "work_ns"), of_tasks)
        columns["arrived_ns"] = of_flows
        return {name: np.full((cycles, n), UNKNOWN, np.int64) for name, n in columns.items()}

    def _mark_not_due(self, known: Mapping[str, Ints], cycles: Sequence[LiveCycle]) -> None:
        """Mark the jobs and messages of cycles, or shadows, in which they are not due."""
        if not self._pipeline.has_rates:
            return
        numbers = np.array([cycle.number for cycle in cycles], np.int64)
        of_tasks = np.array([self.due.rates[name] for name in self._tasks])
        of_flows = np.array([*self._pipeline.message_rates.values()])
        for name, instants in known.items():
            rates = of_flows if name == "arrived_ns" else of_tasks
            instants[numbers[:, None] % rates != 0] = NOT_DUE

    def _enter(
        self,
        known: Mapping[str, Ints],
        row: int,
        cycle: LiveCycle,
        hops: Iterable[Hop],
        apart: frozenset[str],
        *,
        shadow: bool = False,
    ) -> None:
        """Enter instants and work of jobs, and the instants of the messages that reached them."""
        hops = tuple(hops)
        for hop in hops:
            column = self._tasks.get(hop.task)
            if column is None or hop.task not in apart:
                continue
            if not shadow:
                column += len(self._tasks) * self._is_second(cycle, hop.task, hop.node)
            ready_ns = self._since_origin(cycle, hop.node, hop.arrived_ns)
            if cycle.shifts[hop.node].bound_ns >= UNBOUNDED_NS:
                continue
            shift_ns = ready_ns - hop.arrived_ns
            if hop.ended_ns != UNKNOWN and not hop.warmup:
                known["start_ns"][row, column] = max(hop.started_ns + shift_ns, 0)
                known["end_ns"][row, column] = max(hop.ended_ns + shift_ns, 0)
                known["work_ns"][row, column] = self._work_ns(hop)
            # A shadow's last messages arrive at a sink whose job never runs.
            if not hop.warmup and (hop.ended_ns != UNKNOWN or hop.task not in self.sinks):
                known["ready_ns"][row, column] = max(ready_ns, 0)
            self._enter_arrivals(known, row, cycle, hop, () if shadow else hops)

    def _enter_arrivals(
        self,
        known: Mapping[str, Ints],
        row: int,
        cycle: LiveCycle,
        hop: Hop,
        hops: Sequence[Hop],
    ) -> None:
        """Enter the instants of the messages that reached a job.

        `hops` are the senders' jobs, none for a shadow, which has one copy.
        """
        for source, arrived_ns in hop.inputs:
            flow = self._flows.get((source, hop.task))
            if flow is not None and self._copies > 1 and hops:
                sender = self._sender(cycle, _by_site(hops), hop, source)
                ends = [one for one in (sender, hop) if one is not None]
                is_second = any(self._is_second(cycle, one.task, one.node) for one in ends)
                flow += len(self._flows) * is_second
            at_ns = self._since_origin(cycle, hop.node, arrived_ns)
            if flow is not None and cycle.shifts[hop.node].bound_ns < UNBOUNDED_NS:
                known["arrived_ns"][row, flow] = max(at_ns, 0)

    def _ran(self, done: Completion) -> tuple[Hop, ...]:
        """Return the jobs of a shadow, without the arrival of its output at a sampling task."""
        sampled = any((source, done.sink) in self._sampled for source in _arrived(done))
        return done.hops[:-1] if sampled else done.hops

    def _mark_lost(self, known: Mapping[str, Ints], row: int, cycle: LiveCycle, copy: Copy) -> None:
        """Mark the first unconfirmed message of a copy between two nodes as lost."""
        for flow in self._forward:
            column = self._flow_column(cycle, flow, copy)
            is_lost = known["arrived_ns"][row, column] < 0
            if copy[flow.source] != copy[flow.target] and is_lost and self._loses(flow, cycle):
                source, node = self._tasks[flow.source], copy[flow.source]
                source += len(self._tasks) * self._is_second(cycle, flow.source, node)
                known["arrived_ns"][row, column] = UNKNOWN
                if known["end_ns"][row, source] < 0:
                    known["end_ns"][row, source] = cycle.at_ns
                return

    def _flow_column(self, cycle: LiveCycle, flow: Flow, copy: Copy) -> int:
        """Return the column of a flow in a copy of a cycle."""
        ends = ((task, copy[task]) for task in (flow.source, flow.target))
        is_second = any(self._is_second(cycle, *end) for end in ends)
        return self._flows[flow.source, flow.target] + len(self._flows) * is_second

    def _mark_cancelled(self, known: Mapping[str, Ints], row: int, cycle: LiveCycle) -> None:
        """Mark what the slower copy of a cycle that is done has not done: it shows no loss.

        A copy without any report is lost, unless the cycle was done before its hold ended.
        """
        placed = self._candidates[cycle.placement]
        if not isinstance(placed, Replicas):
            return
        arrived = known["arrived_ns"][row]
        arrived[arrived == UNKNOWN] = NOT_DUE
        # A job that is ready has been replaced, and its copy lost.
        unknown = (known["end_ns"][row] == UNKNOWN) & (known["ready_ns"][row] == UNKNOWN)
        for name in ("ready_ns", "start_ns", "end_ns", "work_ns"):
            known[name][row][unknown] = NOT_DUE
        held_ns = 0, round(placed.after_ms * 1e6)
        for copy, after_ns in zip(placed.copies, held_ns, strict=True):
            flows = (flow for flow in self._forward if not self._is_shared(placed, flow))
            columns = [self._flow_column(cycle, flow, copy) for flow in flows]
            heard = self.complete(cycle) and not cycle.deaf
            if heard and cycle.latency_ns > after_ns and (arrived[columns] < 0).all():
                self._mark_lost(known, row, cycle, copy)

    def _is_shared(self, placed: Replicas, flow: Flow) -> bool:
        """Whether both copies share a flow's message."""
        return {flow.source, flow.target}.isdisjoint(placed.doubled)

    def _loses(self, flow: Flow, cycle: LiveCycle) -> bool:
        """Whether the loss of a flow's message loses a cycle."""
        return not flow.sampled and self.due.is_needed(flow.target, cycle.number)

    def unreached(self, cycle: LiveCycle, through: str) -> tuple[str, str] | None:
        """Return source and target of the first unconfirmed message between two nodes.

        Images have precedence: beats share the lane of small messages and do not test the lane of
        images. A task whose inputs were replaced sends nothing. `through` is the cycle's placement,
        or the candidate of its shadow.
        """
        nodes = self._candidates[through].first
        hops = [*cycle.hops, *(hop for done in cycle.shadows for hop in done.hops)]
        there = {
            (source, hop.task)
            for hop in hops
            if nodes[hop.task] == hop.node
            for source, _ in hop.inputs
        }
        idle = {hop.task for hop in hops if hop.ended_ns == UNKNOWN and nodes[hop.task] == hop.node}
        missing = []
        of_shadow, number = through != cycle.placement, cycle.number
        for one in self._forward:
            if not (self.due.sends(one, number) if of_shadow else self._loses(one, cycle)):
                continue
            if one.source in idle:
                idle.add(one.target)
            elif nodes[one.source] != nodes[one.target] and (one.source, one.target) not in there:
                missing.append(one)
        images = (flow for flow in missing if lane_of(flow.payload_bytes) == "images")
        flow = next(images, None) or next(iter(missing), None)
        if flow is None:
            return None
        source, target = (f"{task}@{nodes[task]}" for task in (flow.source, flow.target))
        return source, target

    def _diverging(self, cycle: LiveCycle) -> frozenset[str]:
        """Tasks that a cycle does not share with its shadow."""
        pair = cycle.placement, cycle.shadow
        if pair not in self._apart:
            here, there = (self._candidates[name] for name in pair)
            self._apart[pair] = self._pipeline.diverging(here, there.first)
        return self._apart[pair]

    def shadow_ends(self, cycle: LiveCycle) -> frozenset[str]:
        """Return the tasks that report the end of a cycle's shadow; none without a shadow."""
        if cycle.shadow not in self._codes:
            return frozenset()
        return self.due.shadow_ends(self._diverging(cycle), cycle.number)

    def shadow_bytes(self, cycles: Iterable[LiveCycle]) -> tuple[int, int]:
        """Return the number of cycles with a shadow, and the bytes that shadows sent over links.

        Only messages of jobs that are known to have ended count.
        """
        sent = total = 0
        for cycle in cycles:
            if cycle.shadow not in self._codes:
                continue
            sent += 1
            apart, there = self._diverging(cycle), self._candidates[cycle.shadow].first
            hops = [hop for report in cycle.shadows for hop in report.hops]
            ended = {hop.task for hop in hops if hop.ended_ns != UNKNOWN}
            total += sum(
                flow.payload_bytes
                for flow in self._pipeline.flows
                if flow.target in apart
                and flow.source in ended
                and there[flow.source] != there[flow.target]
            )
        return sent, total


def _between(before_ns: int, after_ns: int) -> int:
    """Difference of two counts; `UNKNOWN` if one is unknown or the counter has restarted."""
    known = UNKNOWN not in (before_ns, after_ns) and after_ns >= before_ns
    return after_ns - before_ns if known else UNKNOWN


def _by_site(hops: Iterable[Hop]) -> dict[Site, Hop]:
    """Return jobs by task and node."""
    return {(hop.task, hop.node): hop for hop in hops}


def _ended(done: Completion) -> Sequence[Hop]:
    """Return the jobs of a report of `WITHOUT_JOB` that have ended."""
    is_arrival = done.hops and done.hops[-1].ended_ns == UNKNOWN
    return done.hops[:-1] if is_arrival else done.hops


def _arrived(done: Completion) -> Iterator[str]:
    """Yield the sources of the messages at which a cycle or shadow has ended."""
    last = done.hops[-1] if done.hops else None
    if last is not None and last.task == done.sink:
        yield from (source for source, _ in last.inputs)
