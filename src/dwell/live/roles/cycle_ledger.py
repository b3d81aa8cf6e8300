"""LiveCycle: the messages about one cycle; Ledger: its latency, jobs and evidence by them.

A job's instants travel with its output, so that of a cycle that never arrives nothing is told of
where it went: unless a worker has said that it replaced it by a newer one, the first message to
another node of which nothing is known is taken to have been lost.
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
from dwell.live.wire.messages import ACTUATED, NOT_APPLIED, STALE, Completion, Hop, Stamp
from dwell.live.wire.wiring import lane_of
from dwell.model import Execution, Problem
from dwell.model.fabric import accelerator_name
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints
from dwell.record import Values

#: Whether it is the shadow's; task and node.
JobName: TypeAlias = tuple[bool, str, str]
Jobs: TypeAlias = dict[JobName, Hop]

UNKNOWN = -1
#: Shadow completions remembered of one cycle.
MAX_SHADOWS = 16
#: Share of a window for which a hook has to have said how busy an accelerator was.
HOOKED_SHARE = 0.5
#: Outcomes of what came to its end before a sink.
SHADOW, REPLACED = "shadow", "replaced"


class Shift(msgspec.Struct, frozen=True, gc=False):
    """Shift from a node's clock to the stamper's, and the bound of its error."""

    by_ns: int
    bound_ns: int


class LiveCycle(msgspec.Struct, eq=False, gc=False):
    """One cycle of a live run.

    A controller remembers tens of thousands. The garbage collector, which stops everything, need
    not look at them: they are in no circle, and what they hold is none of its business either.

    Parameters
    ----------
    at_ns : int
        Release since the origin.
    origin_ns : int
        First release of the run, on the stamper's clock.
    heard : bool
        Whether its stamp is known, and not only its neighbours'.

    Attributes
    ----------
    stamped_ns : int or None
        When its stamp was heard, on the controller's clock.
    group_ns : int
        CPU time that the control group of the stamper's node had taken when it was released.
    reports : dict of str to Completion
        By sink.
    heard_ns : dict of str to int
        When they were heard, where that is known.
    replaced : dict of str to Completion
        By task where a newer cycle took its place.
    latency_ns : int
        `NEVER_NS` while it has not completed.
    parts_ns : tuple of int, or None
        Compute, queue, network.
    bound_ns : int
        Bound of the error of its latency, by the clocks.
    interval_ns : int or None
        From its stamp to its last completion, as both arrived at the controller.
    stamper_interval_ns : int or None
        From its release to its last completion, by the stamper's clock alone.
    told : bool
        Whether its latency is that, because its sinks' own words have not come here.
    deaf : bool
        Whether nothing was heard of it, or of the next one: it may have completed unheard.
    row : int
        In the record; -1 while it is in no closed window.
    close_ns : int or None
        Close of its window since the origin; None where it belongs to none.
    """

    run: int
    number: int
    term: int
    placement: str
    shadow: str
    at_ns: int
    origin_ns: int
    heard: bool
    stamped_ns: int | None = None
    group_ns: int = UNKNOWN
    reports: dict[str, Completion] = {}
    heard_ns: dict[str, int] = {}
    shadows: tuple[Completion, ...] = ()
    replaced: dict[str, Completion] = {}
    latency_ns: int = NEVER_NS
    parts_ns: tuple[int, int, int] | None = None
    bound_ns: int = 0
    interval_ns: int | None = None
    stamper_interval_ns: int | None = None
    told: bool = False
    deaf: bool = False
    row: int = -1
    window: int | None = None
    close_ns: int | None = None
    outcome: str = ""
    shifts: dict[str, Shift] = {}

    @classmethod
    def of(cls, stamp: Stamp, origin_ns: int) -> LiveCycle:
        """Return the cycle that a stamp is about."""
        at_ns = stamp.released_ns - origin_ns
        who = stamp.run, stamp.cycle, stamp.term, stamp.placement, stamp.shadow
        return cls(*who, at_ns, origin_ns, heard=True)

    @property
    def key(self) -> tuple[int, int]:
        """Its place among all cycles."""
        return self.run, self.number

    @property
    def hops(self) -> Iterator[Hop]:
        """All that was told of its own jobs; of one job by everybody downstream."""
        for done in (*self.replaced.values(), *self.reports.values()):
            yield from done.hops

    @property
    def segment(self) -> tuple[int, int, str]:
        """Run, term and placement, which a migration changes."""
        return self.run, self.term, self.placement

    def identify(self, stamp: Stamp) -> None:
        """Take in the stamp of a cycle that was known by its neighbours only."""
        self.heard = True
        self.term, self.placement, self.shadow = stamp.term, stamp.placement, stamp.shadow
        if self.row < 0:
            self.at_ns = stamp.released_ns - self.origin_ns

    def take(self, completion: Completion, at_ns: int | None) -> bool:
        """Take in a completion; False if it is a copy."""
        if completion.outcome == SHADOW:
            new = len(self.shadows) < MAX_SHADOWS and completion not in self.shadows
            if new:
                self.shadows += (completion,)
            return new
        if completion.outcome == REPLACED:
            return self.replaced.setdefault(completion.sink, completion) is completion
        if completion.sink in self.reports:
            return False
        self.reports[completion.sink] = completion
        if at_ns is not None:
            self.heard_ns[completion.sink] = at_ns
        return True

    def heard_before(self, back_ns: int) -> None:
        """Put what was heard back, with the controller's clock."""
        if self.stamped_ns is not None:
            self.stamped_ns -= back_ns
        self.heard_ns = {sink: at_ns - back_ns for sink, at_ns in self.heard_ns.items()}

    @property
    def actuated(self) -> bool:
        """Whether all its commands were applied, as far as is known."""
        reports = self.reports.values()
        return bool(reports) and all(done.outcome == ACTUATED for done in reports)

    @property
    def silences(self) -> int:
        """How often an actuator was at rest before it applied a command of this cycle."""
        return sum(done.rested and done.outcome == ACTUATED for done in self.reports.values())

    def came_to(self, *outcomes: str) -> bool:
        """Whether a sink has said that a command of it came to one of these."""
        return any(done.outcome in outcomes for done in self.reports.values())

    @property
    def untold(self) -> bool:
        """Whether nobody knows whether it has completed."""
        return self.deaf and not (self.reports or self.replaced or self.told)

    def missed(self, deadline_ns: int) -> bool:
        """Whether it was later than D, unfinished when its window closed, or not applied.

        Of one that the gate found stale the clocks may say something else.
        """
        if self.untold:
            return False
        if self.came_to(NOT_APPLIED, STALE):
            return True
        age_ns = NEVER_NS - 1 if self.close_ns is None else self.close_ns - self.at_ns
        return self.latency_ns > min(deadline_ns, age_ns)


def told(cycles: Sequence[LiveCycle]) -> Sequence[LiveCycle]:
    """Return the cycles of a window whose end is known; all where there are none."""
    return [cycle for cycle in cycles if not cycle.untold] or cycles


def violation_rate(cycles: Sequence[LiveCycle], deadline_ns: int) -> float:
    """V_D: share of cycles that missed."""
    return sum(cycle.missed(deadline_ns) for cycle in cycles) / len(cycles)


class Ledger:
    """Puts what messages say of cycles on the stamper's clock, and adds it up."""

    def __init__(self, problem: Problem, offsets: Offsets) -> None:
        pipeline = problem.pipeline
        self.sinks = frozenset(name for name in pipeline.tasks if not pipeline.outputs(name))
        self._pipeline, self._candidates, self._offsets = pipeline, problem.candidates, offsets
        self._stamper_node = problem.stamper_node
        self._nodes, self._resources = problem.fabric.nodes, problem.fabric.resources
        #: By node.
        self.loads = {node: NodeLoad() for node in self._nodes}
        self._tasks = {name: column for column, name in enumerate(pipeline.tasks)}
        self._flows = {(f.source, f.target): column for column, f in enumerate(pipeline.flows)}
        self._codes = {name: code for code, name in enumerate(problem.candidates)}
        self._every = frozenset(pipeline.tasks)
        order = pipeline.topological()
        self._forward = sorted(pipeline.flows, key=lambda flow: order.index(flow.source))
        self._apart: dict[tuple[str, str], frozenset[str]] = {}
        self._accelerated: dict[str, frozenset[str]] = {}

    def tells(self, completion: Completion) -> bool:
        """Whether a completion is about a task that can say so."""
        early = completion.outcome in {SHADOW, REPLACED}
        return completion.sink in (self._every if early else self.sinks)

    # ------------------------------------------------------------------------ latency

    def complete(self, cycle: LiveCycle) -> bool:
        """Whether every sink has reported a cycle."""
        return len(cycle.reports) == len(self.sinks)

    def settle(self, cycle: LiveCycle, *, most_ns: int | None = None) -> None:
        """Work out latency and parts of a cycle that is complete.

        Completions have a second way to the controller: the stamper hears them, and says so. What
        the sinks say themselves counts more, whenever it comes.

        Parameters
        ----------
        most_ns : int, optional
            Leave it for later where the clocks' bound is above that; the bound may tighten.
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
            # Clocks have not been compared: what one alone shows is all there is.
            own_ns = (cycle.interval_ns, cycle.stamper_interval_ns, cycle.latency_ns)
            cycle.latency_ns = next(ns for ns in own_ns if ns is not None)

    def _since_origin(self, cycle: LiveCycle, node: str, instant_ns: int) -> int:
        """Put an instant of a node's clock on the stamper's, since the origin.

        All instants of a cycle on a node are moved alike: clocks part by microseconds in that time.
        """
        shift = cycle.shifts.get(node)
        if shift is None:
            found = self._offsets.to_reference(node, instant_ns)
            shift = cycle.shifts[node] = Shift(found.instant_ns - instant_ns, found.bound_ns)
        return instant_ns + shift.by_ns - cycle.origin_ns

    def _doubt(self, cycle: LiveCycle, done: Completion) -> None:
        """Take clocks for not compared by which a cycle's instants cannot be.

        Nothing of a cycle ends before its release, or after that was heard; no message arrives
        before it was sent, and no job ends before it is ready. Where that is so, beyond the bounds,
        a clock has been set since it was compared last.
        """
        known = [(done.node, done.done_ns)]
        hops = {hop.task: hop for hop in done.hops}
        for hop in hops.values():
            if hop.ended_ns != UNKNOWN:
                known.append((hop.node, hop.ended_ns))
                if hop.ended_ns < hop.arrived_ns:
                    self._disbelieve(cycle, hop.node)
            for source, arrived_ns in hop.inputs:
                sender = hops.get(source)
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
        """Earliest and latest that an instant of a node's clock can have been, since the origin."""
        at_ns = self._since_origin(cycle, node, instant_ns)
        bound_ns = cycle.shifts[node].bound_ns
        return at_ns - bound_ns, at_ns + bound_ns

    def _disbelieve(self, cycle: LiveCycle, *nodes: str) -> None:
        for node in nodes:
            known = cycle.shifts.get(node)
            cycle.shifts[node] = Shift(0 if known is None else known.by_ns, UNBOUNDED_NS)

    def span_ns(self, node: str, first: LiveCycle, close_ns: int) -> tuple[int, int]:
        """Begin and end of a window on a node's clock."""
        begin_ns, end_ns = (
            self._offsets.from_reference(node, first.origin_ns + at_ns).instant_ns
            for at_ns in (first.at_ns, close_ns)
        )
        return begin_ns, end_ns

    def _split(self, cycle: LiveCycle, last: Completion) -> tuple[int, int, int] | None:
        """Part a latency into compute, queue and network along its critical path.

        Going back from the sink, each job waited for the input that came last. What messages take
        on one node counts as queueing, as do the ways to the first job and to the actuator.
        """
        hops = {hop.task: hop for hop in last.hops}
        hop = hops.pop(last.sink, None)
        if hop is None:
            return None
        compute_ns = network_ns = 0
        while hop is not None:
            compute_ns += max(hop.ended_ns - hop.started_ns, 0)
            source, arrived_ns = max(hop.inputs, key=lambda given: given[1], default=("", 0))
            sender = hops.pop(source, None)
            if sender is not None and sender.node != hop.node:
                network_ns += self._since_origin(cycle, hop.node, arrived_ns)
                network_ns -= self._since_origin(cycle, sender.node, sender.ended_ns)
            hop = sender
        # Clocks that are a little off must not make a part negative, or the sum wrong.
        compute_ns = min(compute_ns, cycle.latency_ns)
        network_ns = min(max(network_ns, 0), cycle.latency_ns - compute_ns)
        return compute_ns, cycle.latency_ns - compute_ns - network_ns, network_ns

    # --------------------------------------------------------------------------- jobs

    def core_ns(self, cycles: Sequence[LiveCycle], close_ns: int) -> Floats:
        """Core-nanoseconds of every resource in a window, shape (3, resources).

        A node's own work is what its jobs took, where any tell: what their processes take beside
        that, messages and beats, is in no candidate's own work, and would be missing from the
        estimates of all. Accelerators are as busy as a hook says, where their node has one kind of
        them; elsewhere as busy as the cell's jobs keep them. NaN where none of these is known.
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
        """Drop the reports of loads that only earlier cycles need."""
        for node, load in self.loads.items():
            load.forget(self.span_ns(node, before, before.at_ns)[0])

    def spent_ns(self, cycles: Sequence[LiveCycle]) -> Counter[str]:
        """CPU time that the jobs of some cycles took, by node; of those that told it.

        Nothing of tasks on an accelerator, whose CPU time is no work of theirs to a profile.
        """
        spent = Counter[str]()
        for cycle in cycles:
            # What several sinks tell of is one job.
            for hop in {(hop.task, hop.node): hop for hop in cycle.hops}.values():
                execution = self._execution(hop)
                on_cpu = execution is not None and execution.accelerator is None
                if hop.cpu_ns != UNKNOWN and on_cpu:
                    spent[hop.node] += hop.cpu_ns
        return spent

    def accelerator_ns(self, cycles: Iterable[LiveCycle]) -> dict[str, tuple[float, float]]:
        """Time that the jobs of some cycles, and of their shadows, had accelerators.

        It is that from their start to their end, waiting for the accelerator included. By resource,
        of those that they can have used; of the cycles' own NaN where none of them told it.
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
        """Names of the kinds of accelerators that a candidate's tasks run on."""
        known = self._accelerated.get(candidate)
        if known is None:
            placed = self._candidates[candidate].items()
            executions = ((self._pipeline.tasks[task].on[node], node) for task, node in placed)
            names = (one.resource(node) for one, node in executions if one.accelerator is not None)
            known = self._accelerated[candidate] = frozenset(names)
        return known

    def _execution(self, hop: Hop) -> Execution | None:
        """Execution of a job; None where its task does not run there."""
        task = self._pipeline.tasks.get(hop.task)
        return None if task is None else task.on.get(hop.node)

    def _work_ns(self, hop: Hop) -> int:
        """CPU time of a job that has ended, or the time that it had an accelerator."""
        execution = self._execution(hop)
        if execution is None or hop.ended_ns == UNKNOWN:
            return UNKNOWN
        if execution.accelerator is None:
            return hop.cpu_ns
        return max(hop.ended_ns - hop.started_ns, 0)

    def jobs(self, cycle: LiveCycle) -> list[Values]:
        """Return rows of ``jobs``: all known to have become ready for a cycle or its shadow."""
        jobs = self._jobs(cycle)
        order = sorted(jobs, key=lambda key: (key[0], self._tasks[key[1]]))
        rows = (self._job_values(cycle, jobs, key) for key in order)
        return [row for row in rows if row is not None]

    def _jobs(self, cycle: LiveCycle) -> Jobs:
        """Jobs of a cycle and its shadow."""
        jobs: Jobs = {}
        apart = self._diverging(cycle) if cycle.shadow in self._codes else frozenset[str]()
        hops = [(hop, False) for hop in cycle.hops]
        hops += [(hop, hop.task in apart) for done in cycle.shadows for hop in done.hops]
        for hop, shadow in hops:
            if hop.task not in self._tasks or (shadow and hop.task in self.sinks):
                continue
            known = jobs.get((shadow, hop.task, hop.node))
            if known is None or known.ended_ns == UNKNOWN:
                jobs[shadow, hop.task, hop.node] = hop
        return jobs

    def _handover_ns(self, cycle: LiveCycle, jobs: Jobs, hop: Hop, *, shadow: bool) -> int:
        """CPU time that a node took between a release, or its job before, and a job of it."""
        flows = self._pipeline.inputs(hop.task)
        before_ns = UNKNOWN
        if not flows and hop.node == self._stamper_node:
            before_ns = cycle.group_ns
        elif len(flows) == 1 and (shadow, flows[0].source, hop.node) in jobs:
            before_ns = jobs[shadow, flows[0].source, hop.node].group_ns[1]
        return _between(before_ns, hop.group_ns[0])

    def _ending_ns(self, cycle: LiveCycle, hop: Hop) -> int:
        """CPU time that a node took between the job of a sink on it and the command's hand-over."""
        done = cycle.reports.get(hop.task)
        if done is None or done.node != hop.node:
            return UNKNOWN
        return _between(hop.group_ns[1], done.group_ns)

    def _job_values(self, cycle: LiveCycle, jobs: Jobs, key: JobName) -> Values | None:
        hop, shadow = jobs[key], key[0]
        ready_ns = self._since_origin(cycle, hop.node, hop.arrived_ns)
        if cycle.shifts[hop.node].bound_ns >= UNBOUNDED_NS:
            return None
        if not self._pipeline.inputs(hop.task):
            # Its stamp may have been there before the cycle began.
            offset_ns = round(self._pipeline.tasks[hop.task].offset_ms * 1e6)
            ready_ns = max(ready_ns, cycle.at_ns + offset_ns)
        ended = hop.ended_ns != UNKNOWN
        start_ns = max(self._since_origin(cycle, hop.node, hop.started_ns), ready_ns)
        counted_ns = {
            "cpu_ns": hop.cpu_ns,
            "others_ns": hop.others_ns,
            "outside_ns": hop.outside_ns,
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
            **{name: ns if ended and ns != UNKNOWN else None for name, ns in counted_ns.items()},
        }

    # ----------------------------------------------------------------------- evidence

    def evidence(
        self, cycles: Sequence[LiveCycle], release_ns: Ints, close_ns: int, *, shadows: bool
    ) -> Evidence:
        """Return the instants of a window's jobs and messages, as known at its close.

        Parameters
        ----------
        shadows : bool
            Whether cycles may have been sent through alternatives.
        """
        known, of_shadows = self._unknown(len(cycles)), self._unknown(len(cycles))
        through = np.full(len(cycles), -1, np.int64)
        for row, cycle in enumerate(cycles):
            if cycle.shadow in self._codes:
                through[row] = self._codes[cycle.shadow]
                apart = self._diverging(cycle)
                for report in cycle.shadows:
                    self._doubt(cycle, report)
                    self._enter(of_shadows, row, cycle, report.hops, apart)
                    # What both went through, should the cycle itself not have come so far.
                    self._enter(known, row, cycle, report.hops, self._every - apart)
            for report in (*cycle.replaced.values(), *cycle.reports.values()):
                self._doubt(cycle, report)
                self._enter(known, row, cycle, report.hops, self._every)
            if cycle.heard and not (cycle.deaf or cycle.reports or cycle.replaced or cycle.told):
                self._mark_lost(known, row, cycle)
        for tables in (known, of_shadows):
            tables["work_ns"][tables["end_ns"] > close_ns] = UNKNOWN
            for name in ("ready_ns", "start_ns", "end_ns", "arrived_ns"):
                tables[name][tables[name] > close_ns] = UNKNOWN
        return Evidence(
            close_ns=close_ns,
            release_ns=release_ns,
            placement=np.array([self._codes[cycle.placement] for cycle in cycles], np.int64),
            cycles=Instants(**known),
            shadow_placement=through,
            shadows=Instants(**of_shadows) if shadows else None,
            # Agents put shadow jobs into the system's lowest scheduling class.
            shadows_share=False,
        )

    def _unknown(self, cycles: int) -> dict[str, Ints]:
        """Return what `Instants` are made of, with nothing known."""
        columns = dict.fromkeys(("ready_ns", "start_ns", "end_ns", "work_ns"), len(self._tasks))
        columns["arrived_ns"] = len(self._flows)
        return {name: np.full((cycles, n), UNKNOWN, np.int64) for name, n in columns.items()}

    def _enter(
        self,
        known: Mapping[str, Ints],
        row: int,
        cycle: LiveCycle,
        hops: Iterable[Hop],
        apart: frozenset[str],
    ) -> None:
        """Enter instants and work of jobs, and the instants of the messages that reached them."""
        for hop in hops:
            column = self._tasks.get(hop.task)
            if column is None or hop.task not in apart:
                continue
            ready_ns = self._since_origin(cycle, hop.node, hop.arrived_ns)
            if cycle.shifts[hop.node].bound_ns >= UNBOUNDED_NS:
                continue
            shift_ns = ready_ns - hop.arrived_ns
            if hop.ended_ns != UNKNOWN and not hop.warmup:
                known["start_ns"][row, column] = max(hop.started_ns + shift_ns, 0)
                known["end_ns"][row, column] = max(hop.ended_ns + shift_ns, 0)
                known["work_ns"][row, column] = self._work_ns(hop)
            # Where a shadow stops, its last messages arrive for a job that never runs.
            if not hop.warmup and (hop.ended_ns != UNKNOWN or hop.task not in self.sinks):
                known["ready_ns"][row, column] = max(ready_ns, 0)
            for source, arrived_ns in hop.inputs:
                flow = self._flows.get((source, hop.task))
                if flow is not None:
                    known["arrived_ns"][row, flow] = max(arrived_ns + shift_ns, 0)

    def _mark_lost(self, known: Mapping[str, Ints], row: int, cycle: LiveCycle) -> None:
        """Take the first message to another node that is not known to have arrived as lost."""
        nodes = self._candidates[cycle.placement]
        for flow in self._forward:
            column = self._flows[flow.source, flow.target]
            if nodes[flow.source] != nodes[flow.target] and known["arrived_ns"][row, column] < 0:
                source = self._tasks[flow.source]
                if known["end_ns"][row, source] < 0:
                    known["end_ns"][row, source] = cycle.at_ns
                return

    def unreached(self, cycle: LiveCycle, through: str) -> tuple[str, str] | None:
        """Return source and target of the first message that is not known to have arrived.

        Only those to other nodes count, and an image before all others: beats, which small messages
        share their lane with, say nothing of it. A task whose inputs were replaced sends nothing.

        Parameters
        ----------
        through : str
            Its placement, or the candidate that its shadow goes through.
        """
        nodes = self._candidates[through]
        hops = [*cycle.hops, *(hop for done in cycle.shadows for hop in done.hops)]
        there = {
            (source, hop.task)
            for hop in hops
            if nodes[hop.task] == hop.node
            for source, _ in hop.inputs
        }
        idle = {hop.task for hop in hops if hop.ended_ns == UNKNOWN and nodes[hop.task] == hop.node}
        missing = []
        for one in self._forward:
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
            self._apart[pair] = self._pipeline.diverging(here, there)
        return self._apart[pair]

    def shadow_bytes(self, cycles: Iterable[LiveCycle]) -> tuple[int, int]:
        """Cycles that were sent through an alternative, and the bytes that this put on links.

        Only the messages that are known to have been sent are counted.
        """
        sent = total = 0
        for cycle in cycles:
            if cycle.shadow not in self._codes:
                continue
            sent += 1
            apart, there = self._diverging(cycle), self._candidates[cycle.shadow]
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
    """Difference of two counts; `UNKNOWN` where one of them is, or the counter began anew."""
    known = UNKNOWN not in (before_ns, after_ns) and after_ns >= before_ns
    return after_ns - before_ns if known else UNKNOWN
