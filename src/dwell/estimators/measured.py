"""What a window showed of each part: a task on a node, or a flow on a link."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import UNKNOWN, Evidence, Instants
from dwell.estimators.slowdown import slowdown
from dwell.estimators.spans import patience_ns
from dwell.kernels.jobs import NodeJobs, WaitingJobs
from dwell.kernels.meter import CyclesLayout, PartTimes, WindowRows
from dwell.model.fabric import Node
from dwell.model.number_arrays import Floats, Ints
from dwell.model.pipeline import Execution, Pipeline
from dwell.model.placement import Placement
from dwell.model.problem import Problem

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
        self.parts = tuple(dict.fromkeys(part for parts in every for part in parts))
        self._number = {part: number for number, part in enumerate(self.parts)}
        self._times = PartTimes(len(self.parts))
        costs = [_cost(problem, part) for part in self.parts]
        self._cost, self._usual_cost = np.array(costs), np.array(costs)
        self._link, repeats = self._links()
        self._demands = PartTimes(len(self.parts), self._cost, self._link, repeats)
        nodes = problem.fabric.nodes
        #: Parts whose jobs need more of the core beside foreign threads, with their nodes.
        self._interfered = [
            (number, nodes[part.node])
            for number, part in enumerate(self.parts)
            if isinstance(part, Site) and nodes[part.node].interference > 1.0
        ]
        self._layouts: dict[int, CyclesLayout] = {}
        sharing = [node for node in nodes.values() if _shares_evenly(node, shared)]
        #: Nodes whose jobs share the cores evenly, with the most threads of their bursts.
        self._sharing = [(one.name, one.bursts.threads if one.bursts else 0) for one in sharing]
        self._waiting = WaitingJobs(
            [
                NodeJobs(cores_on(problem, one, partial(cores_of, one)), True, one.cores, one.spare)
                for one in sharing
            ],
            len(problem.pipeline.flows),
        )

    def times(self, evidence: Evidence) -> dict[Part, Floats]:
        """Times of every part that the window has any of, milliseconds, infinite where lost.

        They are overwritten by those of the next window.
        """
        self._take_apart(self._times, evidence, evidence.rows)
        return self._by_part(self._times)

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
        self.measure(evidence, foreign or {})
        return self._by_part(self._demands)

    def measure(self, evidence: Evidence, foreign: Mapping[str, float]) -> None:
        """Compute the demands of a window (see `demands`) without the mapping: `found` has them."""
        self._cost[:] = self._usual_cost
        for number, node in self._interfered:
            # What bursts cost is in the declared demands, too.
            if foreign.get(node.name, 0.0) - node.burst_threads >= BESIDE:
                self._cost[number] /= node.interference
        rows = evidence.rows
        if any(rows.unknown(evidence.close_ns - self._patience_ns)[1:]):
            rows = self._with_work(evidence, foreign).rows
        self._take_apart(self._demands, evidence, self._with_waits(rows, foreign))

    def _with_waits(self, rows: WindowRows, foreign: Mapping[str, float]) -> WindowRows:
        """Add what most jobs of a task waited for to their work.

        A job of a real system may wait for something that no cell declares: a device, the network,
        a lock. That wait is a part of its demand, wherever it runs. It shows if jobs took longer
        than their core time would have, stretched by what the cell's own jobs and foreign threads
        took meanwhile.
        """
        # Bursts may be on all the while that a job runs.
        threads = [foreign.get(name, 0.0) + most for name, most in self._sharing]
        return self._waiting.added(rows, threads)

    def waited_ns(self, evidence: Evidence, foreign: Mapping[str, float]) -> Ints:
        """Core time of own jobs with their waits, shape (n, tasks); see `demands`."""
        return self._with_waits(evidence.rows, foreign).columns(shadow=False)[4].copy()

    def _with_work(self, evidence: Evidence, foreign: Mapping[str, float]) -> Evidence:
        """Add the core time of jobs where it is not known."""
        cycles, shadows = evidence.cycles, evidence.shadows
        work_ns = self.work_ns(cycles, evidence.placement, foreign)
        cycles = replace(cycles, work_ns=work_ns)
        if shadows is not None:
            work_ns = self.work_ns(shadows, evidence.shadow_placement, foreign)
            shadows = replace(shadows, work_ns=work_ns)
        return evidence.with_instants(cycles, shadows)

    @property
    def found(self) -> PartTimes:
        """What `measure` has found in the last window."""
        return self._demands

    @property
    def found_parts(self) -> list[Part]:
        """The parts in `found`."""
        return [self.parts[number] for number in self._demands.numbers]

    def numbers(self, parts: Iterable[Part]) -> Ints:
        """Return the places of some parts in `parts`."""
        return np.array([self._number[part] for part in parts], np.int64)

    def set_rate(self, link: str, rate_mbps: float) -> None:
        """Let the messages of a link be sent at a rate, and wait for each other there."""
        number = list(self._problem.fabric.links).index(link)
        for i, part in enumerate(self.parts):
            if isinstance(part, Message) and part.link == link:
                self._usual_cost[i] = sending_ns(self._problem, part, rate_mbps)
                self._link[i] = number

    def delays(self, evidence: Evidence, link: str, rate_mbps: float) -> dict[Part, Floats]:
        """Demands of messages, of a link at some rate (see `demands`)."""
        usual, joins = self._usual_cost.copy(), self._link.copy()
        self.set_rate(link, rate_mbps)
        self._cost[:] = self._usual_cost
        self._take_apart(self._demands, evidence, evidence.rows)
        self._usual_cost[:], self._link[:] = usual, joins
        found = self._by_part(self._demands)
        return {part: values for part, values in found.items() if isinstance(part, Message)}

    def _take_apart(self, found: PartTimes, evidence: Evidence, rows: WindowRows) -> None:
        limit_ns = evidence.close_ns - self._patience_ns
        found.begin(rows, limit_ns)
        for active in evidence.rows.candidates(limit_ns):
            found.add(active, self._layout(active))

    def _by_part(self, found: PartTimes) -> dict[Part, Floats]:
        return {self.parts[number]: values for number, values in found.by_part().items()}

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
        names = [part.link if isinstance(part, Message) else "" for part in self.parts]
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
        return [-1 if part is None else self._number[part] for part in parts]


def _shares_evenly(node: Node, shared: Collection[str]) -> bool:
    return node.scheduler == "fair" and node.quota is None and node.name not in shared


def cores_on(problem: Problem, node: Node, cores: Callable[[Execution], float]) -> Floats:
    """Cores of each task's job on the CPU of a node, shape (candidates, tasks); else 0."""
    found = np.zeros((len(problem.candidates), len(problem.pipeline.tasks)))
    for row, placed in zip(found, problem.candidates.values(), strict=True):
        for column, (name, task) in enumerate(problem.pipeline.tasks.items()):
            execution = task.on[placed[name]]
            if placed[name] == node.name and execution.accelerator is None:
                row[column] = cores(execution)
    return found


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
    if not np.count_nonzero(codes != first):
        yield first, EVERY
        return
    for code in sorted(set(codes.tolist())):
        yield code, np.flatnonzero(codes == code)
