"""What a window showed of each part: a task on a node, or a flow on a link."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import UNKNOWN, Evidence, Instants
from dwell.estimators.slowdown import slowdown
from dwell.estimators.spans import patience_ns
from dwell.estimators.waits import alone_with_waits
from dwell.kernels.meter import CyclesLayout, PartTimes
from dwell.model.fabric import Node
from dwell.model.pipeline import Execution, Pipeline
from dwell.model.placement import Placement
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Rows: TypeAlias = slice | Ints

EVERY = slice(None)
#: So many foreign threads are some.
BESIDE = 0.5


class Site(NamedTuple):
    """A task on one of its nodes."""

    task: str
    node: str


class Message(NamedTuple):
    """A flow on a link."""

    source: str
    target: str
    link: str


Part: TypeAlias = Site | Message


def message_of(source: str, target: str, placement: Placement) -> Message | None:
    """Return the message of a flow under a placement; None on one node."""
    here, there = placement[source], placement[target]
    return Message(source, target, f"{here}->{there}") if here != there else None


def parts_of(pipeline: Pipeline, placement: Placement) -> Iterator[Part]:
    """Every part that a cycle goes through under a placement."""
    for name in pipeline.tasks:
        yield Site(name, placement[name])
    for flow in pipeline.flows:
        message = message_of(flow.source, flow.target, placement)
        if message is not None:
            yield message


class Meter:
    """Takes windows apart into what they show of the parts that jobs and messages went through.

    Parameters
    ----------
    shared : collection of str
        Nodes on which jobs run beside others that are not in the evidence, and wait for them.
    """

    def __init__(self, problem: Problem, shared: Collection[str] = ()) -> None:
        self._problem, self._pipeline = problem, problem.pipeline
        self._shared = shared
        self._patience_ns = patience_ns(problem)
        names = list(problem.pipeline.tasks)
        self._sources = np.array([names.index(f.source) for f in problem.pipeline.flows], np.int64)
        self._placements = tuple(problem.candidates.values())
        every = (parts_of(problem.pipeline, placed) for placed in self._placements)
        self._parts = tuple(dict.fromkeys(part for parts in every for part in parts))
        self._times = PartTimes(len(self._parts))
        costs = [_cost(problem, part) for part in self._parts]
        self._cost, self._usual_cost = np.array(costs), np.array(costs)
        self._link, repeats = self._links()
        self._demands = PartTimes(len(self._parts), self._cost, self._link, repeats)
        nodes = problem.fabric.nodes
        #: Parts whose jobs need more of the core beside foreign threads, with their nodes.
        self._interfered = [
            (number, nodes[part.node])
            for number, part in enumerate(self._parts)
            if isinstance(part, Site) and nodes[part.node].interference > 1.0
        ]
        self._layouts: dict[int, CyclesLayout] = {}
        self._sharing = [self._sharing_of(placed) for placed in self._placements]

    def times(self, evidence: Evidence) -> dict[Part, Floats]:
        """Times of every part that the window has any of, milliseconds, infinite where lost.

        They are overwritten by those of the next window.
        """
        return self._take_apart(self._times, evidence)

    def demands(
        self, evidence: Evidence, foreign: Mapping[str, float] | None = None
    ) -> dict[Part, Floats]:
        """Demands of every part that the window has any of, milliseconds, infinite where lost.

        The demand of a job is its work: how long it takes alone on its node, with the waits that no
        job there causes. The demand of a message is its delay: the time on the way less the wait
        behind other messages of the cell, and less its transmission at the rate of the link. A
        message that waited for a repeated message counts with the last delay of its link that is
        not longer than its time on the way. The next window overwrites the values.

        Parameters
        ----------
        foreign : mapping of str to float, optional
            Foreign threads beside which jobs ran, by node; 0 for what is not in it. What core time
            a job received is divided by the node's `interference` where there are some beyond
            those of bursts. Where it is not known, it is told from how long the job took.
        """
        foreign = foreign or {}
        self._cost[:] = self._usual_cost
        for number, node in self._interfered:
            # What bursts cost is in the declared demands, too.
            if foreign.get(node.name, 0.0) - node.burst_threads >= BESIDE:
                self._cost[number] /= node.interference
        cycles, shadows = evidence.cycles, evidence.shadows
        work_ns = self.work_ns(cycles, evidence.placement, foreign)
        work_ns = self._with_waits(cycles, evidence.placement, work_ns, foreign)
        told = replace(evidence, cycles=replace(cycles, work_ns=work_ns))
        if shadows is not None:
            work_ns = self.work_ns(shadows, evidence.shadow_placement, foreign)
            told = replace(told, shadows=replace(shadows, work_ns=work_ns))
        return self._take_apart(self._demands, told)

    def set_rate(self, link: str, rate_mbps: float) -> None:
        """Let the messages of a link be sent at a rate, and wait for each other there."""
        number = list(self._problem.fabric.links).index(link)
        for i, part in enumerate(self._parts):
            if isinstance(part, Message) and part.link == link:
                self._usual_cost[i] = sending_ns(self._problem, part, rate_mbps)
                self._link[i] = number

    def delays(self, evidence: Evidence, link: str, rate_mbps: float) -> dict[Part, Floats]:
        """Demands of messages, of a link at some rate (see `demands`)."""
        usual, joins = self._usual_cost.copy(), self._link.copy()
        self.set_rate(link, rate_mbps)
        self._cost[:] = self._usual_cost
        found = self._take_apart(self._demands, evidence)
        self._usual_cost[:], self._link[:] = usual, joins
        return {part: values for part, values in found.items() if isinstance(part, Message)}

    def _take_apart(self, found: PartTimes, evidence: Evidence) -> dict[Part, Floats]:
        limit_ns = evidence.close_ns - self._patience_ns
        own = _columns_of(evidence.placement, evidence.cycles)
        sent = None
        if evidence.shadows is not None:
            sent = _columns_of(evidence.shadow_placement, evidence.shadows)
        found.begin(own, sent, limit_ns)
        for active, _ in groups(evidence.placement):
            found.add(active, self._layout(active))
        return {self._parts[part]: values for part, values in found.by_part().items()}

    def work_ns(
        self, instants: Instants, placement: NDArray[np.integer], foreign: Mapping[str, float]
    ) -> Ints:
        """Core time of each job: where it is not known, told by how long the job took.

        Parameters
        ----------
        placement : int array, shape (n,)
            Candidate that each cycle, or shadow, went through; -1 for none.
        foreign : mapping of str to float
            As in `demands`.

        Returns
        -------
        int64 array, shape (n, tasks)
            -1 for a job that has not completed.
        """
        ended, known_ns = instants.end_ns >= 0, instants.work_ns
        if known_ns is not None and not (ended & (known_ns < 0)).any():
            return known_ns
        begun_ns = instants.ready_ns if instants.start_ns is None else instants.start_ns
        begun_ns = np.where(begun_ns >= 0, begun_ns, instants.ready_ns)
        work_ns = np.full_like(instants.end_ns, UNKNOWN)
        for code, rows in groups(placement):
            if code >= 0:
                cores = self._cores_received(self._placements[code], foreign)
                taken_ns = instants.end_ns[rows] - begun_ns[rows]
                work_ns[rows] = np.rint(taken_ns * cores)
        work_ns[~ended | (begun_ns < 0)] = UNKNOWN
        return work_ns if known_ns is None else np.where(known_ns >= 0, known_ns, work_ns)

    def _with_waits(
        self,
        cycles: Instants,
        placement: NDArray[np.integer],
        work_ns: Ints,
        foreign: Mapping[str, float],
    ) -> Ints:
        """Add what most jobs of a task waited for to their work (see `dwell.estimators.waits`)."""
        if cycles.start_ns is None:
            return work_ns
        # Most windows are of one placement, and in most of those nobody waits.
        known = (work_ns > 0) & (cycles.start_ns >= 0) & (cycles.end_ns >= 0)
        found = work_ns
        for code, rows in groups(placement):
            for name, tasks in self._sharing[code].items():
                node = self._problem.fabric.nodes[name]
                jobs = {}
                for task, cores in tasks:
                    mine = known[rows, task]
                    if mine.any():
                        columns = (cycles.start_ns, cycles.end_ns, work_ns)
                        begun, ended, work = (of[rows, task][mine].astype(float) for of in columns)
                        jobs[task] = begun, ended, work / cores, cores
                # Bursts may be on all the while that a job runs.
                most = foreign.get(name, 0.0) + (node.bursts.threads if node.bursts else 0.0)
                for task, alone_ns in alone_with_waits(node, most, jobs).items():
                    found = found.copy() if found is work_ns else found
                    column = found[rows, task]
                    column[known[rows, task]] = np.rint(alone_ns * jobs[task][3])
                    found[rows, task] = column
        return found

    def _sharing_of(self, placement: Placement) -> dict[str, list[tuple[int, float]]]:
        """Tasks on the CPU of each node whose jobs share its cores evenly, with their cores."""
        nodes = self._problem.fabric.nodes
        sharing: dict[str, list[tuple[int, float]]] = {}
        for column, (name, task) in enumerate(self._pipeline.tasks.items()):
            node, execution = nodes[placement[name]], task.on[placement[name]]
            is_even = node.scheduler == "fair" and node.quota is None
            if is_even and execution.accelerator is None and node.name not in self._shared:
                sharing.setdefault(node.name, []).append((column, cores_of(node, execution)))
        return sharing

    def _cores_received(self, placement: Placement, foreign: Mapping[str, float]) -> Floats:
        """Cores that the job of each task has in the mean beside foreign threads."""
        received = []
        for name, task in self._pipeline.tasks.items():
            node, execution = self._problem.fabric.nodes[placement[name]], task.on[placement[name]]
            cores = cores_of(node, execution)
            if execution.accelerator is None:
                cores /= slowdown(node, execution.threads, foreign.get(node.name, 0.0))
            received.append(cores)
        return np.array(received)

    def _links(self) -> tuple[Ints, Ints]:
        """By part: the number of the link on which it waits, else -1; whether for repeats, 1 or 0.

        Messages wait on links that have a rate, or repeat what is lost and keep the order.
        """
        links = self._problem.fabric.links.values()
        repeating = [one.name for one in links if one.in_order and one.retransmit_ms is not None]
        number = {
            one.name: place
            for place, one in enumerate(links)
            if one.rate_mbps < np.inf or one.name in repeating
        }
        names = [part.link if isinstance(part, Message) else "" for part in self._parts]
        waits = np.array([number.get(name, -1) for name in names], np.int64)
        return waits, np.array([name in repeating for name in names], np.int64)

    def _layout(self, active: int) -> CyclesLayout:
        """Return what cycles under a candidate, and their shadows, have for themselves."""
        if active not in self._layouts:
            pipeline, here = self._pipeline, self._placements[active]
            ways = [(here, frozenset(pipeline.tasks))]
            ways += [(there, pipeline.diverging(here, there)) for there in self._placements]
            shared = [[flow.source not in own for flow in pipeline.flows] for _, own in ways]
            self._layouts[active] = CyclesLayout(
                self._sources,
                np.array([self._columns(*way) for way in ways], np.int64),
                np.array(shared, np.bool_).reshape(len(ways), -1),
            )
        return self._layouts[active]

    def _columns(self, placement: Placement, tasks: Collection[str]) -> list[int]:
        """Number of the part of each task, then of each flow, that some tasks go through."""
        parts: list[Part | None] = [
            Site(name, placement[name]) if name in tasks else None for name in self._pipeline.tasks
        ]
        parts += [
            message_of(flow.source, flow.target, placement) if flow.target in tasks else None
            for flow in self._pipeline.flows
        ]
        return [-1 if part is None else self._parts.index(part) for part in parts]


def _columns_of(
    placement: NDArray[np.integer], instants: Instants
) -> tuple[NDArray[np.integer], ...]:
    work_ns = instants.ready_ns if instants.work_ns is None else instants.work_ns
    return placement, instants.ready_ns, instants.end_ns, instants.arrived_ns, work_ns


def cores_of(node: Node, execution: Execution) -> float:
    """Cores that a job has while nothing is in its way; of an accelerator one place."""
    return float(min(execution.threads, node.cores)) if execution.accelerator is None else 1.0


def _cost(problem: Problem, part: Part) -> float:
    """Time of a job alone over its core time; of a message, nanoseconds to send it."""
    if isinstance(part, Message):
        return sending_ns(problem, part)
    node = problem.fabric.nodes[part.node]
    return 1.0 / cores_of(node, problem.pipeline.tasks[part.task].on[part.node])


def sending_ns(problem: Problem, message: Message, rate_mbps: float | None = None) -> float:
    """Time to send a message, nanoseconds, at a rate or, where None, the link's own."""
    bytes_of = {(flow.source, flow.target): flow.payload_bytes for flow in problem.pipeline.flows}
    if rate_mbps is None:
        rate_mbps = problem.fabric.links[message.link].rate_mbps
    return float(round(8e3 * bytes_of[message.source, message.target] / rate_mbps))


def groups(codes: NDArray[np.integer]) -> Iterator[tuple[int, Rows]]:
    """Yield every code with the rows that have it; all rows as a slice where there is but one."""
    first = int(codes[0])
    if (codes == first).all():
        yield first, EVERY
        return
    for code in sorted(set(codes.tolist())):
        yield code, np.flatnonzero(codes == code)
