"""A second, slow simulator of the page docs/background/simulator.md, for one cell, on SimPy.

It shares no code with the kernels and is written to be compared with the page, sentence by
sentence: every node looks at all of its jobs after every event, remaining work is an exact
fraction, a link is a SimPy process that takes messages out of a queue. What the page leaves open is
read as the comments marked "Reading:" say.

Out of its scope: `close_grace_ms`, shadow jobs, fleets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import simpy

from dwell.model import Execution, Flow, Node, Placement, Problem, Task
from dwell.sim.realisation import LinkSegment, NodeChange, Realisation

__all__ = [
    "CycleResult",
    "JobResult",
    "Result",
    "Split",
    "attempt_uniform",
    "simulate",
    "transmission_ns",
]

COMPLETION, ARRIVAL, START, REPEAT, DISTURBANCE, RESTART, CLOSE, RELEASE = range(1, 9)
MASK = 2**64 - 1
NEAR_NS = 1000


# --------------------------------------------------------------------------- what comes out


@dataclass(frozen=True)
class Split:
    """Parts of a latency, along one path from a release to the last sink."""

    compute_ns: int
    queue_ns: int
    network_ns: int


@dataclass(frozen=True)
class CycleResult:
    """What became of a cycle; it has a latency and its parts only if it is done.

    There is more than one way to split a latency where inputs of a job arrive at the same instant,
    or sinks complete at the same instant: either may be called the last.
    """

    outcome: str
    latency_ns: int | None = None
    splits: frozenset[Split] = frozenset()


@dataclass(frozen=True)
class JobResult:
    """One execution of a task: it exists from the instant at which all its inputs are there.

    `end_ns` is its completion, or the instant at which it was lost.
    """

    node: str
    ready_ns: int
    start_ns: int | None
    end_ns: int | None
    outcome: str


@dataclass(frozen=True)
class Result:
    """The record of a run.

    `busy` holds per node, for the first release and for the close of every window, the integral of
    min(c, K' + s) since time 0, in core-nanoseconds. `closest_ns` is the least distance, below a
    microsecond, of two events that have nothing to do with each other (see `closest_unrelated`);
    None where there is no such pair.
    """

    cycles: tuple[CycleResult, ...]
    jobs: Mapping[tuple[int, str], JobResult]
    busy: Mapping[str, tuple[Fraction, ...]]
    closest_ns: int | None


# ------------------------------------------------------------------------------- small rules


def attempt_uniform(key: int, cycle: int, attempt: int) -> float:
    """Uniform number in [0, 1) that decides whether an attempt is lost (splitmix64)."""
    z = (key + (cycle + 1) * 0x9E3779B97F4A7C15 + (attempt + 1) * 0xD1B54A32D192ED03) & MASK
    z ^= z >> 30
    z = (z * 0xBF58476D1CE4E5B9) & MASK
    z ^= z >> 27
    z = (z * 0x94D049BB133111EB) & MASK
    z ^= z >> 31
    return (z >> 11) * 2.0**-53


def transmission_ns(payload_bytes: int, rate_mbps: float) -> int:
    """Time that a message takes on a link, nanoseconds."""
    return 0 if math.isinf(rate_mbps) else round(payload_bytes * 8000 / rate_mbps)


def nanoseconds(ms: float) -> int:
    return round(ms * 1e6)


# ---------------------------------------------------------------------------- things that move


@dataclass(eq=False)
class Job:
    """A job that is ready, or further."""

    cycle: int
    task: Task
    index: int
    execution: Execution
    node: str
    ready: int
    left: Fraction
    senders: tuple[Job, ...]
    start: int | None = None
    started_by: int = -1
    end: int | None = None
    outcome: str = "in_flight"
    cores: int = 0
    due: int | None = None

    @property
    def readiness(self) -> tuple[int, int, int]:
        return self.ready, self.cycle, self.index


@dataclass(eq=False)
class Message:
    """What a completed job sends along a flow, on a link."""

    cycle: int
    flow: Flow
    hop: int
    sender: Job
    sent_at: int
    sent_by: int
    attempt: int = 0


@dataclass(eq=False)
class Pool:
    """The workers of a task on a node, and the input before them."""

    task: Task
    idle: int
    waiting: list[Job] = field(default_factory=list)
    restart: int = 0


@dataclass(frozen=True)
class LogEntry:
    """An event that happened: when, and what caused it.

    `anchor` is the completion from which its instant follows by whole numbers of the input alone;
    -1 where it follows from the input without any completion.
    """

    time: int
    cause: int
    anchor: int


class At(simpy.Event):
    """A SimPy event that calls a function, in the page's order among those of its instant."""

    def __init__(
        self, env: simpy.Environment, delay: int, order: int, action: Callable[[], None]
    ) -> None:
        super().__init__(env)
        self._ok = True
        self._value = None
        assert self.callbacks is not None
        self.callbacks.append(lambda _event: action())
        # SimPy's own priorities are 0 and 1; the orders start above them.
        env.schedule(self, priority=order, delay=delay)  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------- a node


class NodeState:
    """A node: its runnable jobs, who of them runs, and how fast."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.foreign = 0
        self.down = False
        self.jobs: list[Job] = []
        self.served: dict[str, list[Job]] = {kind: [] for kind in node.accelerators}
        self.busy = Fraction(0)
        self.since = 0
        self.period = self.quota = self.left = 0
        if node.quota is not None:
            self.period = nanoseconds(node.quota.period_ms)
            self.quota = self.left = round(node.quota.cpu * self.period)
        self.empty_at: int | None = None

    @property
    def stopped(self) -> bool:
        """Whether the quota is used up."""
        return self.quota > 0 and self.left <= 0

    @property
    def rate(self) -> int:
        """Cores that are busy."""
        if self.down or self.stopped:
            return 0
        return min(self.node.cores, self.threads + self.foreign)

    @property
    def running(self) -> list[Job]:
        if self.node.scheduler == "fair":
            return self.jobs
        return [job for job in self.jobs if job.cores > 0]

    @property
    def threads(self) -> int:
        """K'."""
        if self.node.scheduler == "fair":
            return sum(job.execution.threads for job in self.jobs)
        return sum(job.cores for job in self.jobs)

    @property
    def speed(self) -> Fraction:
        if self.stopped:
            return Fraction(0)
        c, s = self.node.cores, self.foreign
        if self.node.scheduler == "fair":
            return min(Fraction(1), Fraction(c, max(1, self.threads + s)))
        return Fraction(c, c + s)

    def advance(self, now: int) -> None:
        """Let the time since the last change pass."""
        elapsed = now - self.since
        self.since = now
        speed, rate = self.speed, self.rate
        for job in self.running:
            job.left -= speed * elapsed
        for jobs in self.served.values():
            for job in jobs:
                job.left -= elapsed * (job.cores > 0)
        self.busy += rate * elapsed
        self.left -= rate * elapsed

    def runnable(self, job: Job) -> list[Job]:
        """Jobs among which this one runs: the CPU's, or those of its accelerator."""
        kind = job.execution.accelerator
        return self.jobs if kind is None else self.served[kind]

    def give_out(self) -> None:
        """Give out the cores, and the places on the accelerators."""
        c = self.node.cores
        if self.node.scheduler == "fair":
            for job in self.jobs:
                job.cores = min(job.execution.threads, c)
        elif self.node.scheduler == "fifo":
            hold_in_order(sorted(self.jobs, key=lambda job: job.readiness), c)
        else:
            for job in self.jobs:
                job.cores = 0
            # Reading: as under fifo, the first that does not fit ends the round.
            by_priority = sorted(self.jobs, key=lambda job: (-job.task.priority, job.readiness))
            hold_in_order(by_priority, c)
        for kind, jobs in self.served.items():
            in_order = sorted(jobs, key=lambda job: job.readiness)
            hold_in_order(in_order, self.node.accelerators[kind], width=1)

    def due(self, job: Job, now: int) -> int | None:
        """First whole nanosecond at which the job will have its execution time, as things are."""
        if job.start is not None and job.left <= 0:
            return now
        if job.cores == 0:
            return None
        speed = self.speed if job.execution.accelerator is None else Fraction(1)
        if speed == 0:
            return None
        return now + math.ceil(job.left / speed)


def hold_in_order(jobs: Sequence[Job], cores: int, width: int | None = None) -> None:
    """Give cores to those that hold none, in order, until one does not fit."""
    free = cores - sum(job.cores for job in jobs)
    for job in jobs:
        if job.cores > 0:
            continue
        needed = width or min(job.execution.threads, cores)
        if needed > free:
            break
        job.cores = needed
        free -= needed


# -------------------------------------------------------------------------------------- the run


class Simulation:
    """One run of one cell."""

    def __init__(self, problem: Problem, real: Realisation, stamps: Sequence[str]) -> None:
        self.env = simpy.Environment()
        self.problem = problem
        self.pipeline = problem.pipeline
        self.real = real
        self.release = [int(ns) for ns in real.release_ns]
        self.end = self.release[real.cycles]
        self.placed: list[Placement] = [problem.candidates[name] for name in stamps]
        self.index = {task: i for i, task in enumerate(self.pipeline.tasks)}
        self.sinks = [task for task in self.pipeline.tasks if not self.pipeline.outputs(task)]

        self.nodes = {name: NodeState(node) for name, node in problem.fabric.nodes.items()}
        self.pools = {
            (name, node): Pool(task, execution.workers)
            for name, task in self.pipeline.tasks.items()
            for node, execution in task.on.items()
        }
        self.queues = {link: simpy.Store(self.env) for link in problem.fabric.links}
        self.last_arrival = dict.fromkeys(problem.fabric.links, (0, -1))
        self.segments: dict[str, list[LinkSegment]] = {link: [] for link in problem.fabric.links}
        for segment in real.link_segments:
            self.segments[segment.link].append(segment)

        self.inputs: dict[tuple[int, str], list[tuple[int, Job]]] = {}
        self.lost_joins: set[tuple[int, str]] = set()
        self.losses: dict[int, str] = {}
        self.jobs: dict[tuple[int, str], Job] = {}
        self.completed: dict[int, list[Job]] = {k: [] for k in range(real.cycles)}
        self.busy: dict[str, list[Fraction]] = {name: [] for name in self.nodes}

        self.log: list[LogEntry] = []
        self.current = -1

    # ------------------------------------------------------------------ events and their order

    @property
    def now(self) -> int:
        return int(self.env.now)

    def at(
        self,
        time: int,
        kind: int,
        cycle: int,
        task: int,
        action: Callable[[], None],
        *,
        fixed: bool = False,
        cause: int | None = None,
        valid: Callable[[], bool] = lambda: True,
    ) -> None:
        """Let `action` happen at `time`, unless it is not `valid` any more by then."""
        caused_by = self.current if cause is None else cause

        def happen() -> None:
            if not valid():
                return
            self.current = self.note(time, caused_by, kind=kind, fixed=fixed)
            for node in self.nodes.values():
                node.advance(time)
            action()
            for node in self.nodes.values():
                node.give_out()
                self.plan(node)

        order = (kind * 10**9 + cycle + 1) * 10**6 + task + 1
        At(self.env, time - self.now, order, happen)

    def note(self, time: int, cause: int, *, kind: int = 0, fixed: bool = False) -> int:
        entry = len(self.log)
        if kind == COMPLETION:
            anchor = entry
        else:
            anchor = -1 if fixed or cause < 0 else self.log[cause].anchor
        self.log.append(LogEntry(time, cause, anchor))
        return entry

    def plan(self, node: NodeState) -> None:
        """Note who got cores for the first time, and foresee every completion."""
        now = self.now
        for jobs in (node.jobs, *node.served.values()):
            for job in jobs:
                if job.cores > 0 and job.start is None:
                    job.start = now
                    job.started_by = self.current
                due = node.due(job, now)
                if due == job.due:
                    continue
                job.due = due
                if due is not None:
                    self.foresee(job, due)
        empty_at = now + -(-node.left // node.rate) if node.quota and node.rate else None
        if empty_at != node.empty_at:
            node.empty_at = empty_at
            if empty_at is not None:
                # Nothing else happens then; every event looks anew at who runs, and how fast.
                self.at(empty_at, DISTURBANCE, -1, 0, lambda: None)

    def renewer(self, node: NodeState) -> Callable[[], None]:
        def renew() -> None:
            node.left = node.quota

        return renew

    def foresee(self, job: Job, due: int) -> None:
        self.at(
            due,
            COMPLETION,
            job.cycle,
            job.index,
            lambda: self.complete(job),
            cause=job.started_by,
            valid=lambda: job.due == due and job.outcome == "in_flight",
        )

    # --------------------------------------------------------------------------------- the run

    def run(self) -> Result:
        for name in self.segments:
            for segment in self.segments[name]:
                self.note(segment.at_ns, -1, fixed=True)
            self.env.process(self.transmit(name))
        for i, change in enumerate(self.real.node_changes):
            self.at(change.at_ns, DISTURBANCE, -1, i, self.changer(change), fixed=True)
        for node in self.nodes.values():
            for begin in range(node.period, self.end + 1, node.period) if node.quota else ():
                self.at(begin, DISTURBANCE, -1, 0, self.renewer(node), fixed=True)
        for k in range(self.real.cycles):
            if self.release[k] < self.end:
                self.at(self.release[k], RELEASE, k, -1, self.releaser(k), fixed=True)
        window = self.problem.window_cycles
        for k in range(0, self.real.cycles + 1, window):
            self.at(self.release[k], CLOSE, k, -1, self.close, fixed=True)
        while self.env.peek() <= self.end:
            self.env.step()
        return Result(
            cycles=tuple(self.cycle_result(k) for k in range(self.real.cycles)),
            jobs={
                key: JobResult(job.node, job.ready, job.start, job.end, job.outcome)
                for key, job in self.jobs.items()
            },
            busy={name: tuple(values) for name, values in self.busy.items()},
            closest_ns=closest_unrelated(self.log),
        )

    def close(self) -> None:
        for name, node in self.nodes.items():
            self.busy[name].append(node.busy)

    # ---------------------------------------------------------------------------------- cycles

    def releaser(self, cycle: int) -> Callable[[], None]:
        def release() -> None:
            for name, task in self.pipeline.tasks.items():
                if self.pipeline.inputs(name):
                    continue
                offset = nanoseconds(task.offset_ms)
                if offset == 0:
                    self.start_source(cycle, name)
                else:
                    self.at(
                        self.release[cycle] + offset,
                        START,
                        cycle,
                        self.index[name],
                        lambda name=name: self.start_source(cycle, name),  # type: ignore[misc]
                        fixed=True,
                    )

        return release

    def start_source(self, cycle: int, task: str) -> None:
        # Reading: a source with an offset is released when its offset is over. On a node that is
        # down its job is lost as soon as it is ready.
        job = self.make_job(cycle, task, ())
        if self.nodes[job.node].down:
            self.lose_job(job, "node_down")
        else:
            self.queue_up(job)

    def lose(self, cycle: int, outcome: str) -> None:
        """Something of a cycle is lost; the first such loss names its outcome."""
        self.losses.setdefault(cycle, outcome)

    def lose_job(self, job: Job, outcome: str) -> None:
        job.outcome = outcome
        job.end = self.now
        self.lose(job.cycle, outcome)

    def cycle_result(self, cycle: int) -> CycleResult:
        if cycle in self.losses:
            return CycleResult(self.losses[cycle])
        sinks = [job for job in self.completed[cycle] if job.task.name in self.sinks]
        if len(sinks) < len(self.sinks):
            return CycleResult("in_flight")
        end = max(self.end_of(job) for job in sinks)
        splits = {
            split for job in sinks if job.end == end for split in self.splits(job, Split(0, 0, 0))
        }
        return CycleResult("done", end - self.release[cycle], frozenset(splits))

    def end_of(self, job: Job) -> int:
        assert job.end is not None
        return job.end

    def splits(self, job: Job, after: Split) -> set[Split]:
        """Split the time from the release to the end of a job; `after` is what came after that."""
        assert job.start is not None
        compute = after.compute_ns + self.end_of(job) - job.start
        queue = after.queue_ns + job.start - job.ready
        if not job.senders:
            queue += job.ready - self.release[job.cycle]
            return {Split(compute, queue, after.network_ns)}
        found = set()
        for sender in job.senders:
            network = after.network_ns + job.ready - self.end_of(sender)
            found |= self.splits(sender, Split(compute, queue, network))
        return found

    # ----------------------------------------------------------------------- inputs and workers

    def deliver(self, cycle: int, task: str, sender: Job) -> None:
        """Bring one input to a task, by a message or by a hand-over on the same node."""
        key = (cycle, task)
        if self.nodes[self.placed[cycle][task]].down:
            self.lost_joins.add(key)
            self.lose(cycle, "node_down")
        if key in self.lost_joins:
            return
        there = self.inputs.setdefault(key, [])
        there.append((self.now, sender))
        if len(there) == len(self.pipeline.inputs(task)):
            del self.inputs[key]
            last = tuple(job for arrival, job in there if arrival == self.now)
            self.queue_up(self.make_job(cycle, task, last))

    def make_job(self, cycle: int, name: str, senders: tuple[Job, ...]) -> Job:
        """Return the job that is ready now."""
        task = self.pipeline.tasks[name]
        node = self.placed[cycle][name]
        site = self.real.sites.index((name, node))
        job = Job(
            cycle=cycle,
            task=task,
            index=self.index[name],
            execution=task.on[node],
            node=node,
            ready=self.now,
            left=Fraction(int(self.real.exec_ns[site, cycle])),
            senders=senders,
        )
        self.jobs[cycle, name] = job
        return job

    def queue_up(self, job: Job) -> None:
        pool = self.pools[job.task.name, job.node]
        pool.waiting.append(job)
        self.take(pool, job.node)
        if job.task.depth and len(pool.waiting) > job.task.depth:
            # Reading: the oldest is the one that has waited longest, not the lowest cycle.
            lost = min(pool.waiting[0], job, key=lambda waiting: waiting.cycle)
            pool.waiting.remove(lost)
            self.lose_job(lost, "replaced")

    def take(self, pool: Pool, node: str) -> None:
        """Let idle workers take the first waiting jobs."""
        while pool.idle > 0 and pool.waiting:
            pool.idle -= 1
            job = pool.waiting.pop(0)
            self.nodes[node].runnable(job).append(job)

    def complete(self, job: Job) -> None:
        job.end = self.now
        job.outcome = "done"
        self.nodes[job.node].runnable(job).remove(job)
        self.completed[job.cycle].append(job)
        for flow in self.pipeline.outputs(job.task.name):
            target = self.placed[job.cycle][flow.target]
            if target == job.node:
                self.deliver(job.cycle, flow.target, job)
            else:
                link = f"{job.node}->{target}"
                hop = self.real.hops.index((flow.source, flow.target, link))
                self.send(link, Message(job.cycle, flow, hop, job, self.now, self.current))
        pool = self.pools[job.task.name, job.node]
        pool.idle += 1
        self.take(pool, job.node)

    # ----------------------------------------------------------------------------- disturbances

    def changer(self, change: NodeChange) -> Callable[[], None]:
        def happen() -> None:
            node = self.nodes[change.node]
            node.foreign = change.threads
            if change.down and not node.down:
                node.down = True
                self.go_down(change.node)
            elif node.down and not change.down:
                node.down = False
                self.come_up(change.node)

        return happen

    def go_down(self, name: str) -> None:
        node = self.nodes[name]
        for jobs in (node.jobs, *node.served.values()):
            for job in jobs:
                self.lose_job(job, "node_down")
            jobs.clear()
        for (_, site), pool in self.pools.items():
            if site == name:
                for job in pool.waiting:
                    self.lose_job(job, "node_down")
                pool.waiting.clear()
                pool.idle = 0
                pool.restart += 1
        for cycle, task in list(self.inputs):
            if self.placed[cycle][task] == name:
                del self.inputs[cycle, task]
                self.lost_joins.add((cycle, task))
                self.lose(cycle, "node_down")

    def come_up(self, name: str) -> None:
        for (task, site), pool in self.pools.items():
            if site == name:
                self.at(
                    self.now + nanoseconds(pool.task.start_ms),
                    RESTART,
                    -1,
                    self.index[task],
                    self.restarter(pool, name),
                    fixed=True,
                    valid=lambda pool=pool, restart=pool.restart: pool.restart == restart,  # type: ignore[misc]
                )

    def restarter(self, pool: Pool, node: str) -> Callable[[], None]:
        def happen() -> None:
            pool.idle = pool.task.on[node].workers
            self.take(pool, node)

        return happen

    # ------------------------------------------------------------------------------------ links

    def send(self, link: str, message: Message) -> None:
        self.queues[link].put(message)

    def state(self, link: str) -> LinkSegment:
        """Segment in which a link is now."""
        return [s for s in self.segments[link] if s.at_ns <= self.now][-1]

    def transmit(self, name: str) -> Generator[simpy.Event, Any, None]:
        """A link: one transmission after another, for ever."""
        link = self.problem.fabric.links[name]
        begun = -1
        while True:
            message: Message = yield self.queues[name].get()
            if self.now == message.sent_at:
                begun = message.sent_by
            else:
                begun = self.note(self.now, begun)
            while link.retransmit_ms is not None and self.state(name).down:
                later = [s.at_ns for s in self.segments[name] if s.at_ns > self.now]
                if not later:
                    return
                yield self.env.timeout(later[0] - self.now)
                begun = self.note(self.now, -1, fixed=True)
            state = self.state(name)
            if state.down:
                # Reading: a message is lost when its transmission begins, or would begin.
                self.lose(message.cycle, "dropped")
                continue
            duration = transmission_ns(message.flow.payload_bytes, state.rate_mbps)
            key = int(self.real.loss_keys[message.hop])
            if attempt_uniform(key, message.cycle, message.attempt) >= state.loss:
                self.propagate(name, message, state, duration, begun)
            elif link.retransmit_ms is None:
                self.lose(message.cycle, "dropped")
            else:
                again = self.now + duration + nanoseconds(link.retransmit_ms)
                self.repeat(name, message, again, begun)
            yield self.env.timeout(duration)

    def propagate(
        self, link: str, message: Message, state: LinkSegment, duration: int, begun: int
    ) -> None:
        """Let a transmission that begins now arrive."""
        delay = int(self.real.delay_ns[message.hop, message.cycle])
        for row, (hop, layer) in enumerate(self.real.layers):
            if hop == message.hop and layer in state.layers:
                delay += int(self.real.extra_ns[row, message.cycle])
        arrival = self.now + duration + delay
        if self.problem.fabric.links[link].in_order:
            last, last_begun = self.last_arrival[link]
            if arrival < last:
                arrival, begun = last, last_begun
            self.last_arrival[link] = arrival, begun
        self.at(
            arrival,
            ARRIVAL,
            message.cycle,
            self.index[message.flow.target],
            lambda: self.deliver(message.cycle, message.flow.target, message.sender),
            cause=begun,
        )

    def repeat(self, link: str, message: Message, again: int, begun: int) -> None:
        """Send a lost message once more at `again`."""

        def happen() -> None:
            message.attempt += 1
            message.sent_at, message.sent_by = self.now, self.current
            self.send(link, message)

        task = self.index[message.flow.target]
        self.at(again, REPEAT, message.cycle, task, happen, cause=begun)


def closest_unrelated(log: Sequence[LogEntry]) -> int | None:
    """Least distance, below a microsecond, of two events of which neither caused the other.

    Pairs whose instants follow from the same completion, or from the input alone, are left out:
    they are the same whole number of nanoseconds apart in every simulator.
    """

    def caused(early: int, late: int) -> bool:
        while late >= 0 and log[late].time >= log[early].time:
            if late == early:
                return True
            late = log[late].cause
        return False

    closest: int | None = None
    order = sorted(range(len(log)), key=lambda i: log[i].time)
    for position, i in enumerate(order):
        for j in order[position + 1 :]:
            distance = log[j].time - log[i].time
            if distance >= (NEAR_NS if closest is None else closest):
                break
            if log[i].anchor == log[j].anchor:
                continue
            if not caused(i, j) and not caused(j, i):
                closest = distance
    return closest


def simulate(problem: Problem, realisation: Realisation, stamps: Sequence[str]) -> Result:
    """Play a realisation in which cycle k is released with the candidate `stamps[k]`.

    The run ends at the last entry of `release_ns`: completions, arrivals and disturbances of that
    very instant happen, nothing after it does.
    """
    assert len(stamps) == realisation.cycles
    return Simulation(problem, realisation, stamps).run()
