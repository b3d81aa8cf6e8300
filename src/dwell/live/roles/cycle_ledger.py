"""LiveCycle: the messages about one cycle; Ledger: latency and jobs from them.

A job's instants travel with its output. If a cycle never arrives at a sink, its jobs are unknown,
unless a worker reports that a newer cycle replaced it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias

import msgspec

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
from dwell.live.wire.routing import Routes
from dwell.live.wire.wiring import lane_of
from dwell.model import Execution, Flow, Problem
from dwell.model.instants import NEVER_NS
from dwell.record import Values

#: Whether the job belongs to the shadow; task and node.
JobName: TypeAlias = tuple[bool, str, str]
#: Task and node of a job.
Site: TypeAlias = tuple[str, str]
Jobs: TypeAlias = dict[JobName, Hop]

UNKNOWN = -1
#: Largest number of shadow completions kept per cycle.
MAX_SHADOWS = 16
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
    idle: bool
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

    @property
    def key(self) -> tuple[int, int]:
        """Run and cycle number, which order all cycles."""
        return self.run, self.number

    @property
    def hops(self) -> Iterator[Hop]:
        """Reported jobs of this cycle, not of its shadow; several sinks may report one job."""
        for done in self.all_reports:
            yield from jobs_in(done)

    @property
    def all_reports(self) -> Iterator[Completion]:
        """Reports with jobs of this cycle, not of its shadow."""
        yield from self.replaced.values()
        yield from self.reports.values()
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
        self.routes = Routes(problem)
        self._pipeline, self._candidates, self._offsets = pipeline, problem.candidates, offsets
        self._stamper_node = problem.stamper_node
        self.tasks = {name: column for column, name in enumerate(pipeline.tasks)}
        self.flows = {(f.source, f.target): column for column, f in enumerate(pipeline.flows)}
        self._sampled = {(f.source, f.target) for f in pipeline.flows if f.sampled}
        self._has_copies = bool(problem.replicas)
        order = pipeline.topological()
        #: Flows in the order of their sources in the pipeline.
        self.forward = sorted(pipeline.flows, key=lambda flow: order.index(flow.source))

    def cycle_of(self, stamp: Stamp, origin_ns: int, *, heard: bool = True) -> LiveCycle:
        """Return the cycle of a stamp; without `heard`, of a stamp that its neighbours imply."""
        who = stamp.run, stamp.cycle, stamp.term, stamp.placement, stamp.shadow
        idle = not self.routes.due.sinks(stamp.cycle)
        return LiveCycle(*who, stamp.released_ns - origin_ns, origin_ns, heard, idle)

    def tells(self, completion: Completion) -> bool:
        """Whether a completion's task can have its outcome: before a sink any task, else a sink."""
        early = completion.outcome in {SHADOW, REPLACED, *WITHOUT_JOB}
        return completion.sink in (self.tasks if early else self.sinks)

    # ------------------------------------------------------------------------ latency

    def complete(self, cycle: LiveCycle) -> bool:
        """Whether every due sink has reported a cycle; false for an idle cycle."""
        return not cycle.idle and self.routes.due.sinks(cycle.number) <= cycle.reports.keys()

    def is_over(self, cycle: LiveCycle) -> bool:
        """Whether a cycle is complete or idle, and its sampled messages have arrived."""
        arrived = {(source, target) for source, target, _ in cycle.arrivals}
        sampled = {flow for flow in self._sampled if self.routes.due.runs(flow[0], cycle.number)}
        return (cycle.idle or self.complete(cycle)) and sampled <= arrived

    def is_replaced(self, cycle: LiveCycle) -> bool:
        """Whether a later cycle has replaced a job that a due sink waits for."""
        return any(self.routes.due.is_needed(task, cycle.number) for task, _ in cycle.replaced)

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
            self.doubt(cycle, done)
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

    def doubt(self, cycle: LiveCycle, done: Completion) -> None:
        """Mark the clocks as not compared if a cycle's instants are impossible with them.

        Jobs end after the release and before their report arrives, messages arrive after they are
        sent, and jobs end after they are ready. If instants contradict this by more than the error
        bounds, a clock was set after the last comparison.
        """
        known = [(done.node, done.done_ns)]
        hops = by_site(done.hops)
        for hop in hops.values():
            if hop.ended_ns != UNKNOWN:
                known.append((hop.node, hop.ended_ns))
                if hop.ended_ns < hop.arrived_ns:
                    self._disbelieve(cycle, hop.node)
            for source, arrived_ns in hop.inputs:
                sender = self.sender(cycle, hops, hop, source)
                is_flow = (source, hop.task) in self.flows
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

    def sender(
        self, cycle: LiveCycle, hops: Mapping[Site, Hop], hop: Hop, source: str
    ) -> Hop | None:
        """Return the job that sent an input of a job, of the same copy if there are two."""
        for copy in self._candidates[cycle.placement].copies:
            sender = hops.get((source, copy.get(source, "")))
            if sender is not None and copy.get(hop.task) == hop.node:
                return sender
        # A guessed or repeated stamp has sent the cycle through other nodes, too.
        return next((one for one in reversed([*hops.values()]) if one.task == source), None)

    def is_second(self, cycle: LiveCycle, task: str, node: str) -> bool:
        """Whether a job belongs to the second copy of a cycle alone."""
        placed = self._candidates[cycle.placement]
        second = placed.second
        return second is not None and second.get(task) == node != placed.first[task]

    def _split(self, cycle: LiveCycle, last: Completion) -> tuple[int, int, int] | None:
        """Split a latency into compute, queue and network along its critical path.

        The path runs backwards from the sink, to the input that arrived last at each job. Messages
        within a node count as queueing, and so do the ways to the first job and to the actuator.
        """
        hops = by_site(last.hops)
        hop = hops.pop((last.sink, last.node), None)
        if hop is None:
            return None
        compute_ns = network_ns = 0
        while hop is not None:
            compute_ns += max(hop.ended_ns - hop.started_ns, 0)
            source, arrived_ns = max(hop.inputs, key=lambda given: given[1], default=("", 0))
            sender = self.sender(cycle, hops, hop, source)
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

    def execution(self, hop: Hop) -> Execution | None:
        """Return the execution of a job's task on its node, or None."""
        task = self._pipeline.tasks.get(hop.task)
        return None if task is None else task.on.get(hop.node)

    def work_ns(self, hop: Hop) -> int:
        """CPU time of a job that has ended, or its time on an accelerator; else `UNKNOWN`."""
        execution = self.execution(hop)
        if execution is None or hop.ended_ns == UNKNOWN:
            return UNKNOWN
        if execution.accelerator is None:
            return hop.cpu_ns
        return max(hop.ended_ns - hop.started_ns, 0)

    def jobs(self, cycle: LiveCycle) -> list[Values]:
        """Return the rows of ``jobs`` for the known jobs of a cycle and its shadow."""
        jobs = self.known_jobs(cycle)
        order = sorted(jobs, key=lambda key: (key[0], self.tasks[key[1]]))
        rows = (self._job_values(cycle, jobs, key) for key in order)
        return [row for row in rows if row is not None]

    def known_jobs(self, cycle: LiveCycle) -> Jobs:
        """Return the known jobs of a cycle and its shadow."""
        jobs: Jobs = {}
        apart = self.routes.apart(cycle.placement, cycle.shadow)
        hops = [(hop, False) for hop in cycle.hops]
        ended = [hop for done in cycle.shadows for hop in self.ran(done)]
        hops += [(hop, hop.task in apart) for hop in ended]
        for hop, shadow in hops:
            if hop.task not in self.tasks or (shadow and hop.task in self.sinks):
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
        is_second = not shadow and self.is_second(cycle, hop.task, hop.node)
        ready_ns = self.instant_ns(cycle, hop.node, hop.arrived_ns)
        if ready_ns is None:
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
            **({"second": is_second} if self._has_copies else {}),
            **{name: ns if ended and ns != UNKNOWN else None for name, ns in counted_ns.items()},
        }

    # ----------------------------------------------------------------------- messages

    def ran(self, done: Completion) -> tuple[Hop, ...]:
        """Return the jobs of a shadow, without the arrival of its output at a sampling task."""
        sampled = any((source, done.sink) in self._sampled for source in _arrived(done))
        return done.hops[:-1] if sampled else done.hops

    def loses(self, flow: Flow, cycle: LiveCycle) -> bool:
        """Whether the loss of a flow's message loses a cycle."""
        return not flow.sampled and self.routes.due.is_needed(flow.target, cycle.number)

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
        for one in self.forward:
            if not (self.routes.due.sends(one, number) if of_shadow else self.loses(one, cycle)):
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

    def shadow_ends(self, cycle: LiveCycle) -> frozenset[str]:
        """Return the tasks that report the end of a cycle's shadow; none without a shadow."""
        apart = self.routes.apart(cycle.placement, cycle.shadow)
        return self.routes.due.shadow_ends(apart, cycle.number)

    def shadow_bytes(self, cycles: Iterable[LiveCycle]) -> tuple[int, int]:
        """Return the number of cycles with a shadow, and the bytes that shadows sent over links.

        Only messages of jobs that are known to have ended count.
        """
        sent = total = 0
        for cycle in cycles:
            if cycle.shadow not in self._candidates:
                continue
            sent += 1
            apart = self.routes.apart(cycle.placement, cycle.shadow)
            there = self._candidates[cycle.shadow].first
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


def by_site(hops: Iterable[Hop]) -> dict[Site, Hop]:
    """Return jobs by task and node."""
    return {(hop.task, hop.node): hop for hop in hops}


def jobs_in(done: Completion) -> Sequence[Hop]:
    """Return the jobs of a report, without the arrival of a message that has begun no job."""
    last = done.hops[-1] if done.hops else None
    is_arrival = last is not None and last.ended_ns == UNKNOWN and done.outcome in WITHOUT_JOB
    return done.hops[:-1] if is_arrival else done.hops


def _arrived(done: Completion) -> Iterator[str]:
    """Yield the sources of the messages at which a cycle or shadow has ended."""
    last = done.hops[-1] if done.hops else None
    if last is not None and last.task == done.sink:
        yield from (source for source, _ in last.inputs)
