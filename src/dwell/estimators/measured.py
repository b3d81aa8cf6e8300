"""Times and demands of each part in a window: a task on a node, or a flow on a link."""

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
from dwell.model.frozen import FrozenDict
from dwell.model.number_arrays import Floats, Ints
from dwell.model.pipeline import Execution, Pipeline
from dwell.model.placement import Copy, Placement, Replicas
from dwell.model.problem import Problem

Rows: TypeAlias = slice | Ints

EVERY = slice(None)
#: Cores that the cell's jobs used and that foreign threads used on a node, means over a window.
UsedCores: TypeAlias = tuple[float, float]
#: Used cores of a node that was not full.
NOT_FULL: UsedCores = 0.0, 0.0
#: Fewest foreign threads, in addition to bursts, that slow jobs down by interference.
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


def message_of(source: str, target: str, placement: Copy) -> Message | None:
    """Return the message of a flow under a placement; None if both tasks are on one node."""
    here, there = placement[source], placement[target]
    return Message(source, target, f"{here}->{there}") if here != there else None


def parts_of(pipeline: Pipeline, placement: Placement) -> Iterator[Part]:
    """Yield the parts of a cycle under a placement, of both copies if it has replicas."""
    yield from dict.fromkeys(
        part for copy in placement.copies for part in parts_of_copy(pipeline, copy)
    )


def parts_of_copy(pipeline: Pipeline, placement: Copy) -> Iterator[Part]:
    """Yield the parts of one copy of a cycle."""
    for name in pipeline.tasks:
        yield Site(name, placement[name])
    for flow in pipeline.flows:
        message = message_of(flow.source, flow.target, placement)
        if message is not None:
            yield message


def job_columns(problem: Problem, placement: Placement) -> list[Site | None]:
    """Return the site of each column of tasks in the evidence; None for no job.

    In a cell with replicas the tasks of the second copy follow the tasks of the first.
    """
    tasks = problem.pipeline.tasks
    sites: list[Site | None] = [Site(name, placement.first[name]) for name in tasks]
    if isinstance(placement, Replicas):
        doubled, second = placement.doubled, placement.second
        sites += [Site(name, second[name]) if name in doubled else None for name in tasks]
    elif problem.replicas:
        sites += [None] * len(sites)
    return sites


def message_columns(problem: Problem, placement: Placement) -> list[Message | None]:
    """Return the message of each column of flows in the evidence; None for none, or if held."""
    flows = problem.pipeline.flows
    messages = [message_of(flow.source, flow.target, placement.first) for flow in flows]
    if isinstance(placement, Replicas):
        # The evidence does not show when a held message was sent.
        doubled = {*placement.doubled}
        held = [placement.after_ms > 0 and flow.source not in doubled for flow in flows]
        messages += [
            message_of(flow.source, flow.target, placement.second)
            if not is_held and not doubled.isdisjoint((flow.source, flow.target))
            else None
            for flow, is_held in zip(flows, held, strict=True)
        ]
    elif problem.replicas:
        messages += [None] * len(messages)
    return messages


def patience_of(problem: Problem, parts: Iterable[Part]) -> list[int]:
    """Return the patience with each part (see `patience_ns`), nanoseconds."""
    rates, every = problem.pipeline.rates, problem.pipeline.message_rates
    return [
        patience_ns(problem, every[part[:2]] if isinstance(part, Message) else rates[part.task])
        for part in parts
    ]


class Meter:
    """Times and demands of parts, from the jobs and messages of a window.

    On the nodes in `shared`, jobs also wait for jobs of other cells, which the evidence lacks.
    """

    def __init__(self, problem: Problem, shared: Collection[str] = ()) -> None:
        self._problem, self._pipeline = problem, problem.pipeline
        self._shared = shared
        self._patience_ns = patience_ns(problem)
        self._placements = tuple(problem.candidates.values())
        every = (parts_of(problem.pipeline, placed) for placed in self._placements)
        self.parts = tuple(dict.fromkeys(part for parts in every for part in parts))
        self._number = {part: number for number, part in enumerate(self.parts)}
        more_ns = self._more_patience_ns()
        self._times = PartTimes(len(self.parts), more_ns=more_ns)
        costs = [_cost(problem, part) for part in self.parts]
        self._cost, self._usual_cost = np.array(costs), np.array(costs)
        self._link, repeats = self._links()
        self._demands = PartTimes(len(self.parts), self._cost, self._link, repeats, more_ns)
        nodes = problem.fabric.nodes
        #: Parts whose jobs need more core time next to foreign threads, with their nodes.
        self._interfered = [
            (number, nodes[part.node])
            for number, part in enumerate(self.parts)
            if isinstance(part, Site) and nodes[part.node].interference > 1.0
        ]
        self._layouts: dict[int, CyclesLayout] = {}
        #: Ends of the last two windows.
        self._ends_ns = 0, 0
        sharing = [node for node in nodes.values() if _shares_evenly(node, shared)]
        #: Nodes whose jobs share the cores evenly, with the most threads of their bursts.
        self._sharing = [(one.name, one.bursts.threads if one.bursts else 0) for one in sharing]
        self._waiting = WaitingJobs(
            [
                NodeJobs(cores, True, one.cores, one.spare, problem.pipeline.period_ns)
                for one in sharing
                for cores in [cores_on(problem, one, partial(cores_of, one))]
            ],
            len(message_columns(problem, self._placements[0])),
        )

    def times(self, evidence: Evidence) -> dict[Part, Floats]:
        """Return the times of each part in the window, milliseconds, infinite if lost.

        The next window overwrites the values.
        """
        self._take_apart(self._times, evidence, _rows_of)
        return self._by_part(self._times)

    def demands(
        self, evidence: Evidence, foreign: Mapping[str, float] | None = None
    ) -> dict[Part, Floats]:
        """Return the demands of each part in the window, milliseconds, infinite if lost.

        The demand of a job is its work: its time alone on its node, including waits that no job
        there causes. The demand of a message is its delay: its time on the way less the wait behind
        other messages of the cell and less its transmission at the rate of the link. A message that
        waited for a repeated message has the last delay of its link that is not longer than its
        time on the way. The next window overwrites the values.

        `foreign` is the number of foreign threads by node [default: 0]. If there are more than
        the bursts have, the core time of a job is divided by the node's `interference`. If the core
        time is unknown, it is estimated from the duration of the job.
        """
        self.measure(evidence, foreign or {})
        return self._by_part(self._demands)

    def measure(
        self,
        evidence: Evidence,
        foreign: Mapping[str, float],
        full: Mapping[str, UsedCores] = FrozenDict(),
    ) -> None:
        """Compute the demands of a window in `found`, without the mapping of `demands`.

        `full` has the used cores of each full node.
        """
        self._cost[:] = self._usual_cost
        for number, node in self._interfered:
            # The declared demands include the interference of bursts.
            if foreign.get(node.name, 0.0) - node.burst_threads >= BESIDE:
                self._cost[number] /= node.interference
        self._take_apart(self._demands, evidence, partial(self._worked, foreign, full))

    def _worked(
        self, foreign: Mapping[str, float], full: Mapping[str, UsedCores], evidence: Evidence
    ) -> WindowRows:
        """Return the instants with the work of all completed jobs; the next call overwrites it."""
        rows = evidence.rows
        if any(rows.unknown(evidence.close_ns - self._patience_ns)[1:]):
            rows = self._with_work(evidence, foreign).rows
        return self._with_waits(rows, foreign, full)

    def _with_waits(
        self, rows: WindowRows, foreign: Mapping[str, float], full: Mapping[str, UsedCores]
    ) -> WindowRows:
        """Add to the work of jobs the waits that most jobs of their task have in common.

        A job of a real system may wait for something that no cell declares: a device, the network,
        a lock. This wait is part of its demand on every node. Jobs have waited if they took longer
        than their core time explains, with the slowdown by own jobs and foreign threads.
        """
        # A burst may last as long as the job.
        threads = [foreign.get(name, 0.0) + most for name, most in self._sharing]
        own_cores = [full.get(name, NOT_FULL)[0] for name, _ in self._sharing]
        return self._waiting.added(rows, threads, own_cores)

    def waited_ns(
        self,
        evidence: Evidence,
        foreign: Mapping[str, float],
        full: Mapping[str, UsedCores] = FrozenDict(),
    ) -> Ints:
        """Return the core time of own jobs with their waits, nanoseconds, shape (n, tasks)."""
        return self._with_waits(evidence.rows, foreign, full).columns(shadow=False)[4].copy()

    def _with_work(self, evidence: Evidence, foreign: Mapping[str, float]) -> Evidence:
        """Add estimates of unknown core times."""
        cycles, shadows = evidence.cycles, evidence.shadows
        work_ns = self.work_ns(cycles, evidence.placement, foreign)
        cycles = replace(cycles, work_ns=work_ns)
        if shadows is not None:
            work_ns = self.work_ns(shadows, evidence.shadow_placement, foreign)
            shadows = replace(shadows, work_ns=work_ns)
        return evidence.with_instants(cycles, shadows)

    @property
    def found(self) -> PartTimes:
        """Demands of the last window (see `measure`)."""
        return self._demands

    @property
    def found_parts(self) -> list[Part]:
        """The parts in `found`."""
        return [self.parts[number] for number in self._demands.numbers]

    def numbers(self, parts: Iterable[Part]) -> Ints:
        """Return the indices of some parts in `parts`."""
        return np.array([self._number[part] for part in parts], np.int64)

    def set_rate(self, link: str, rate_mbps: float) -> None:
        """Set the rate of a link, at which its messages are sent and wait for each other."""
        number = list(self._problem.fabric.links).index(link)
        for i, part in enumerate(self.parts):
            if isinstance(part, Message) and part.link == link:
                self._usual_cost[i] = sending_ns(self._problem, part, rate_mbps)
                self._link[i] = number

    def delays(self, evidence: Evidence, link: str, rate_mbps: float) -> dict[Part, Floats]:
        """Return the demands of messages as if a link had some rate (see `demands`)."""
        usual, joins = self._usual_cost.copy(), self._link.copy()
        self.set_rate(link, rate_mbps)
        self._cost[:] = self._usual_cost
        self._take_apart(self._demands, evidence, _rows_of)
        self._usual_cost[:], self._link[:] = usual, joins
        found = self._by_part(self._demands)
        return {part: values for part, values in found.items() if isinstance(part, Message)}

    def _take_apart(
        self, found: PartTimes, evidence: Evidence, rows_of: Callable[[Evidence], WindowRows]
    ) -> None:
        close_ns, earlier = evidence.close_ns, evidence.earlier
        if close_ns != self._ends_ns[1]:
            self._ends_ns = self._ends_ns[1], close_ns
        limit_ns = close_ns - self._patience_ns
        if earlier is None:
            found.begin(rows_of(evidence), limit_ns)
        else:
            counted = self._ends_ns[0], close_ns - self._ends_ns[0]
            later = len(evidence.release_ns)
            found.begin(rows_of(earlier), limit_ns, later=later, counted=counted)
            self._add(found, earlier, limit_ns)
            found.go_on(rows_of(evidence))
        self._add(found, evidence, limit_ns)

    def _add(self, found: PartTimes, evidence: Evidence, limit_ns: int) -> None:
        for active in evidence.rows.candidates(limit_ns):
            found.add(active, self._layout(active))

    def _by_part(self, found: PartTimes) -> dict[Part, Floats]:
        return {self.parts[number]: values for number, values in found.by_part().items()}

    def work_ns(
        self, instants: Instants, placement: NDArray[np.integer], foreign: Mapping[str, float]
    ) -> Ints:
        """Return the core time of each job, nanoseconds, shape (n, tasks); -1 if unfinished.

        Unknown core times are estimated from the duration of the job. `placement` is the candidate
        of each cycle or shadow, shape (n,), -1 for none. For `foreign` see `demands`.
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
        """Return the average cores of each task's job next to foreign threads."""
        received = []
        for site in job_columns(self._problem, placement):
            if site is None:
                received.append(0.0)
                continue
            node = self._problem.fabric.nodes[site.node]
            execution = self._pipeline.tasks[site.task].on[site.node]
            cores = cores_of(node, execution)
            if execution.accelerator is None:
                cores /= slowdown(node, execution.threads, foreign.get(node.name, 0.0))
            received.append(cores)
        return np.array(received)

    def _links(self) -> tuple[Ints, Ints]:
        """Return by part the link on which it waits, else -1, and whether it waits for repeats.

        Messages wait on links with a rate, and on links that repeat lost messages and keep the
        order.
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

    def _more_patience_ns(self) -> Ints | None:
        """Return by part the patience beyond a part's of each cycle; None without rates."""
        if not self._pipeline.has_rates:
            return None
        patience = patience_of(self._problem, self.parts)
        return np.array(patience, np.int64) - self._patience_ns

    def _layout(self, active: int) -> CyclesLayout:
        """Return the parts of cycles under a candidate, and of their shadows."""
        if active not in self._layouts:
            pipeline, problem, here = self._pipeline, self._problem, self._placements[active]
            own = [*job_columns(problem, here), *message_columns(problem, here)]
            rows = [[-1 if part is None else self._number[part] for part in own]]
            shared = [[False] * len(message_columns(problem, here))]
            for there in self._placements:
                apart = pipeline.diverging(here, there.first)
                rows.append(self._columns(there.first, apart))
                columns = [flow.source not in apart for flow in pipeline.flows]
                shared.append([*columns, *[False] * (len(shared[0]) - len(columns))])
            self._layouts[active] = CyclesLayout(
                self._sources(here),
                np.array(rows, np.int64),
                np.array(shared, np.bool_).reshape(len(rows), -1),
            )
        return self._layouts[active]

    def _sources(self, placement: Placement) -> Ints:
        """Return the column of the sender of each column of flows."""
        names, flows = list(self._pipeline.tasks), self._pipeline.flows
        sources = [names.index(flow.source) for flow in flows]
        if self._problem.replicas:
            sources += [
                row + len(names) * isinstance(placement[names[row]], tuple) for row in sources
            ]
        return np.array(sources, np.int64)

    def _columns(self, placement: Copy, tasks: Collection[str]) -> list[int]:
        """Return the part of each task in `tasks`, then of each flow to them; -1 for others."""
        sites: list[Part | None] = [
            Site(name, placement[name]) if name in tasks else None for name in self._pipeline.tasks
        ]
        # No shadow gets the sampled messages of shared jobs.
        messages: list[Part | None] = [
            message_of(flow.source, flow.target, placement)
            if flow.target in tasks and (flow.source in tasks or not flow.sampled)
            else None
            for flow in self._pipeline.flows
        ]
        # A shadow has no second copies.
        found = [
            [*parts, *[None] * len(parts)] if self._problem.replicas else parts
            for parts in (sites, messages)
        ]
        return [-1 if part is None else self._number[part] for parts in found for part in parts]


def _shares_evenly(node: Node, shared: Collection[str]) -> bool:
    return node.scheduler == "fair" and node.quota is None and node.name not in shared


def cores_on(problem: Problem, node: Node, cores: Callable[[Execution], float]) -> Floats:
    """Return the cores of each task's job on a node, shape (candidates, columns); 0 elsewhere."""
    found = [
        [
            cores(execution)
            if site is not None
            and site.node == node.name
            and (execution := problem.pipeline.tasks[site.task].on[site.node]).accelerator is None
            else 0.0
            for site in job_columns(problem, placed)
        ]
        for placed in problem.candidates.values()
    ]
    return np.array(found, np.float64)


def cores_of(node: Node, execution: Execution) -> float:
    """Return the cores of a job on an idle node; 1, a place, on an accelerator."""
    return float(min(execution.threads, node.cores)) if execution.accelerator is None else 1.0


def _cost(problem: Problem, part: Part) -> float:
    """Return the time of a job alone per core time, or the nanoseconds to send a message."""
    if isinstance(part, Message):
        return sending_ns(problem, part)
    node = problem.fabric.nodes[part.node]
    return 1.0 / cores_of(node, problem.pipeline.tasks[part.task].on[part.node])


def sending_ns(problem: Problem, message: Message, rate_mbps: float | None = None) -> float:
    """Return the nanoseconds to send a message at a rate [default: its link's]."""
    bytes_of = {(flow.source, flow.target): flow.payload_bytes for flow in problem.pipeline.flows}
    if rate_mbps is None:
        rate_mbps = problem.fabric.links[message.link].rate_mbps
    return float(round(8e3 * bytes_of[message.source, message.target] / rate_mbps))


def _rows_of(evidence: Evidence) -> WindowRows:
    return evidence.rows


def groups(codes: NDArray[np.integer]) -> Iterator[tuple[int, Rows]]:
    """Yield every code with its rows; if there is only one code, its rows are a slice."""
    first = int(codes[0])
    if not np.count_nonzero(codes != first):
        yield first, EVERY
        return
    for code in sorted(set(codes.tolist())):
        yield code, np.flatnonzero(codes == code)
