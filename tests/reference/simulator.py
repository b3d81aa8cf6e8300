"""A second, slow simulator of the page docs/background/simulator.md, for one cell, on SimPy.

It shares no code with the kernels and is written to be compared with the page, sentence by
sentence: every node looks at all of its jobs after every event, remaining work is an exact
fraction, a link is a SimPy process that takes messages out of a queue. What the page leaves open is
read as the comments marked "Reading:" say.

Out of its scope: fleets.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import simpy

from dwell.kernels.realisation import LinkSegment, NodeChange, Realisation
from dwell.model import Execution, Flow, Node, Problem, Quota, Task
from dwell.model.placement import Copy
from tests.reference.guard import NEVER, Guard, Proof, Wait
from tests.reference.rates import Rates, earlier_cycles
from tests.reference.replicas import Copies, second

#: Of the changes of one instant, the place of what quotas do then.
LAST_CHANGE = 900_000
COMPLETION, ARRIVAL, START, REPEAT, DISTURBANCE, RESTART, STEP = range(1, 8)
CLOSE, DECIDE, GUARD, RELEASE = range(8, 12)
# Cells: the jobs of a cycle itself, and those of its shadow.
ITSELF, SHADOW = 0, 1
ZERO, ONE = Fraction(0), Fraction(1)
MASK = 2**64 - 1
NEAR_NS = 1000
STATE_TIMEOUT_MS = 200
DRAWN_MS = 5
LEAST_TURN_MS = 1.4
# Cycles beyond a window after which a shadow is given up.
GIVEN_UP_AFTER = 64
# Behind all that an event does one after another.
LATE = 10**9
# Forwarded messages are handled behind all others of their cycle.
BEHIND_TASKS = 800_000
# Behind SimPy's own priorities, 0 and 1, and before every other event.
EVENT_END = 2


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

    `end_ns` is its completion, or the instant at which it was lost. `core` is the core time that it
    has received, nanoseconds; of one on an accelerator, the time that it has had its place. `taken`
    are the cycles of the values that it got of sampled inputs, by their sources.
    """

    node: str
    ready_ns: int
    start_ns: int | None
    end_ns: int | None
    outcome: str
    core: Fraction
    taken: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Usage:
    """What a resource has done since time 0, core-nanoseconds, or those of places.

    `busy` is the integral of min(c, K' + s + b), or of the places taken; `own` and `shadow` are the
    work that the jobs of the cycles, and those of their shadows, have received.
    """

    busy: Fraction
    own: Fraction
    shadow: Fraction


@dataclass(frozen=True)
class WindowResult:
    """A window: its first cycle, what resources had done when it opened and closed, what was known.

    `known` holds the jobs and `arrived` the messages of its cycles, and of their shadows, that the
    events before the close have brought about.
    """

    first_cycle: int
    close_ns: int
    opened: Mapping[str, Usage]
    closed: Mapping[str, Usage]
    known: Mapping[tuple[int, int, str], JobResult]
    arrived: Mapping[tuple[int, int, str, str], int]


@dataclass(frozen=True)
class Look:
    """The cycles of one decision: `first` to `last`, of which those from `begin` on are new.

    `opened` is the usage at the release of `first`, `begun` at the release of `begin`. `known` and
    `arrived` hold the jobs and messages of the cycles from `earliest` on, as of the decision.
    """

    earliest: int
    first: int
    begin: int
    last: int
    close_ns: int
    opened: Mapping[str, Usage]
    begun: Mapping[str, Usage]
    closed: Mapping[str, Usage]
    known: Mapping[tuple[int, int, str], JobResult]
    arrived: Mapping[tuple[int, int, str, str], int]


@dataclass(frozen=True)
class Decision:
    """A decision of the controller, or a move of the guard.

    `window` holds `last_cycle`; a move of the guard begins it. It looks at `cycles` cycles,
    a move of the guard at none.
    """

    window: int
    last_cycle: int
    cycles: int
    incumbent: str
    placement: str
    by_guard: bool


@dataclass(frozen=True)
class Transmission:
    """A transmission of a link: when the message was handed to the link, and its bytes."""

    at_ns: int
    link: str
    payload_bytes: int


@dataclass(frozen=True)
class Result:
    """The record of a run.

    `cycles` are those released before the run ended. `jobs` and `shadow_jobs` are by cycle and
    task; `arrived` is when a message was handed to its target, by cell, cycle, source and target.
    `stamps` are the candidates that every released cycle runs under, and is also sent through.
    `decisions` are those of the controller, and the moves of the guard. `looks` has one entry per
    instant at which a decision is due, whether or not the controller's node is up.
    `closest_ns` is the least distance, below a microsecond, of two events that have nothing to do
    with each other (see `closest_unrelated`); None where there is no such pair. `late` counts the
    messages of each cycle that came after the other copy's; `heard` is when nodes heard that cycles
    with two copies were done. Jobs of second copies have the name `second(task)`, and so have both
    ends of their messages. `transmitted` has each transmission of a link.
    """

    cycles: tuple[CycleResult, ...]
    jobs: Mapping[tuple[int, str], JobResult]
    shadow_jobs: Mapping[tuple[int, str], JobResult]
    arrived: Mapping[tuple[int, int, str, str], int]
    windows: tuple[WindowResult, ...]
    looks: tuple[Look, ...]
    stamps: tuple[tuple[str, str | None], ...]
    decisions: tuple[Decision, ...]
    closest_ns: int | None
    late: Mapping[int, int] = field(default_factory=dict)
    transmitted: Sequence[Transmission] = ()
    heard: Mapping[tuple[int, str], int] = field(default_factory=dict)

    @property
    def busy(self) -> Mapping[str, tuple[Fraction, ...]]:
        """Busy time of every resource at the first release and at the close of every window."""
        times = (self.windows[0].opened, *(window.closed for window in self.windows))
        return {name: tuple(usage[name].busy for usage in times) for name in times[0]}


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


def shadow_stamp(cycle: int, active: str, names: Sequence[str], fraction: float) -> str | None:
    """Return the candidate that a cycle under `active` is also sent through, if any."""
    if fraction <= 0:
        return None
    # The golden ratio to 40 digits.
    golden = Fraction(math.isqrt(5 * 10**80) - 10**40, 2 * 10**40)
    place = cycle * golden % 1
    for i, name in enumerate(name for name in names if name != active):
        if i * Fraction(fraction) <= place < (i + 1) * Fraction(fraction):
            return name
    return None


# ---------------------------------------------------------------------------- things that move


@dataclass(eq=False)
class Job:
    """A job that is ready, or further."""

    cell: int
    cycle: int
    task: Task
    index: int
    execution: Execution
    node: str
    ready: int
    left: Fraction
    senders: tuple[Job, ...]
    core: Fraction = Fraction(0)
    start: int | None = None
    started_by: int = -1
    end: int | None = None
    outcome: str = "in_flight"
    cores: int = 0
    due: int | None = None
    taken: dict[str, int] = field(default_factory=dict)
    is_second: bool = False

    @property
    def readiness(self) -> tuple[int, int, int, int]:
        return self.ready, self.cell, self.cycle, self.index

    @property
    def result(self) -> JobResult:
        return JobResult(
            *(self.node, self.ready, self.start, self.end, self.outcome, self.core),
            dict(self.taken),
        )


@dataclass(eq=False)
class Thread:
    """What takes turns on a node: a job, or a foreign thread, and what it has received."""

    job: Job | None
    received: int

    @property
    def place(self) -> tuple[int, tuple[int, ...]]:
        """Of those that have received the same, jobs go first."""
        return self.received, self.job.readiness if self.job else (2**62,)


@dataclass(frozen=True)
class Draws:
    """Delays of one hop, its extra delays by layer, and the stream of its losses."""

    delay_ns: Sequence[int]
    extra_ns: Mapping[int, Sequence[int]]
    loss_key: int


@dataclass(eq=False)
class Message:
    """What crosses a link: an output, a forwarded value, or the state of a task that moves.

    `arrive` is what happens when it does. Its draws are those of `cycle`. `task` and `flow` order
    it among the messages of its cycle. `arrival` is when it would arrive if it waited for no other
    message, and the event from which that follows. `is_needed` says whether its loss names the
    outcome of its cycle.
    """

    cell: int
    cycle: int
    target: str
    payload_bytes: int
    draws: Draws
    arrive: Callable[[], None]
    sent_at: int
    sent_by: int
    task: int
    flow: int = 0
    is_needed: bool = True
    is_forward: bool = False
    is_state: bool = False
    migration: int = 0
    attempt: int = 0
    is_stopped: Callable[[], bool] = lambda: False
    number: int = 0
    arrival: tuple[int, int] | None = None

    @property
    def sent(self) -> tuple[int, int]:
        """Event that sent it, and its place among what that event did."""
        return self.sent_by, self.number


@dataclass(eq=False)
class Pool:
    """The workers of a task on a node, and the input before them."""

    task: Task
    idle: int
    waiting: list[Job] = field(default_factory=list)
    restart: int = 0
    starting: bool = False


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
        self.work = {ITSELF: Fraction(0), SHADOW: Fraction(0)}
        self.places = {kind: [Fraction(0)] * 3 for kind in node.accelerators}
        self.since = 0
        self.stressed = 0
        self.period = self.quota = self.left = self.pool = self.slack = self.periods = 0
        self.tick = 0
        self.background, self.interference = Fraction(node.background), Fraction(node.interference)
        if node.quota is not None:
            self.period = nanoseconds(node.quota.period_ms)
            self.count(node.quota)
            self.left = self.quota
            self.tick = nanoseconds(node.quota.tick_ms)
            if self.slack or self.tick:
                self.pool, self.left = self.quota, 0
        self.turn: Thread | None = None
        self.waiting: list[Thread] = []
        self.had = 0
        self.debt = self.touched = self.touched_by_change = False
        # Shadow jobs there were at the last event, and accelerators where one may begin in this.
        self.seen_shadows: list[Job] = []
        self.looked_at: set[str] = set()
        self.period_ago = self.tick_ago = 0
        self.wakes = [0]
        self.wake_key = 0
        self.empty_at: int | None = None

    def count(self, quota: Quota) -> None:
        """Express the quota, and what outlasts it, in time of a core."""
        node, cpu = self.node, Fraction(quota.cpu)
        beside = node.background if node.background_beside is None else node.background_beside
        self.quota, self.stressed = (
            max(round(self.left_by(taken, cpu) * self.period), 1)
            for taken in (Fraction(beside), Fraction(node.background))
        )
        self.slack = nanoseconds(quota.slack_ms)

    @property
    def stopped(self) -> bool:
        """Whether the quota is used up, as far as the kernel has noticed."""
        if self.tick:
            return self.debt
        return self.quota > 0 and self.left <= 0

    def renew(self) -> None:
        """Begin a period of the quota; its pool is full before anything else happens then."""
        if self.slack:
            self.draw()
        else:
            self.left = self.grant

    def left_by(self, taken: Fraction, cpu: Fraction) -> Fraction:
        """Cores' worth of a quota that others leave."""
        return min(cpu, Fraction(self.node.cores)) - taken if taken else cpu

    @property
    def grant(self) -> int:
        """What a period begins with."""
        return self.stressed if self.foreign else self.quota

    @property
    def thirsty(self) -> bool:
        """Whether something runs that has used up what was drawn, and the pool is not empty."""
        busy = not self.down and self.threads + self.foreign > 0
        return bool(self.slack and not self.tick) and busy and self.left <= 0 and self.pool > 0

    def draw(self) -> None:
        """Draw on the pool; only after all changes of this instant."""
        if self.thirsty:
            self.left, self.pool = self.left + self.pool, 0

    def give_back(self) -> None:
        """Give back what an idle node has beyond the slack."""
        idle = self.down or self.threads + self.foreign == 0
        looked = self.touched if self.tick else bool(self.slack)
        if looked and idle and self.left > self.slack:
            self.pool = min(self.pool + self.left - self.slack, self.quota)
            self.left = self.slack

    @property
    def average(self) -> int:
        """What the threads have received in the mean, rounded down."""
        threads = [*self.waiting, *([self.turn] if self.turn else [])]
        return sum(thread.received for thread in threads) // max(len(threads), 1)

    @property
    def own(self) -> list[Job]:
        """Jobs of the CPU that are no shadow jobs."""
        return [job for job in self.jobs if job.cell == ITSELF]

    @property
    def shadows(self) -> list[Job]:
        """Shadow jobs of the CPU."""
        return [job for job in self.jobs if job.cell == SHADOW]

    def line_up(self) -> None:
        """Let threads that are new wait for their turn, and take those that are gone away."""
        if self.shadows != self.seen_shadows:
            self.seen_shadows, self.touched = self.shadows, True
        new_foreign = self.touched_by_change
        average = self.average
        if self.turn and self.turn.job and self.turn.job not in self.jobs:
            self.end_turn()
        there = [thread for thread in self.waiting if thread.job is None or thread.job in self.jobs]
        self.touched = self.touched or there != self.waiting
        self.waiting = there
        if new_foreign:
            if self.turn and self.turn.job is None:
                self.end_turn()
            self.waiting = [thread for thread in self.waiting if thread.job]
            self.waiting += [Thread(None, average) for _ in range(self.foreign)]
            self.touched_by_change = False
        known = [thread.job for thread in (*self.waiting, self.turn) if thread]
        for job in self.own:
            if job not in known:
                self.waiting.append(Thread(job, self.average))
                self.touched = True

    def end_turn(self) -> None:
        self.turn, self.had, self.touched = None, 0, True

    def pass_on(self, now: int) -> None:
        """End a turn: at a tick, if it has lasted long enough; at a wake, if another had less."""
        at_tick = (now + self.tick_ago) % self.tick == 0
        self.touched = True
        if self.debt or not self.turn:
            return
        long = self.had >= nanoseconds(LEAST_TURN_MS)
        behind = any(thread.received < self.turn.received for thread in self.waiting)
        if (at_tick and long) or (now in self.wakes[-2:] and behind):
            self.waiting.append(self.turn)
            self.end_turn()

    def take_turns(self) -> None:
        """Give the turn to the thread that has received least."""
        if self.turn or self.debt or not self.waiting:
            return
        self.turn = min(self.waiting, key=lambda thread: thread.place)
        self.waiting.remove(self.turn)

    def notice(self) -> None:
        """Let the kernel look whether the quota is used up: draw on the pool, or pay the debt."""
        if self.left <= 0:
            drawn = min(self.pool, (1 if self.debt else nanoseconds(DRAWN_MS)) - self.left)
            self.pool -= drawn
            self.left += drawn
        stops = self.left <= 0
        if stops and not self.debt and self.turn:
            self.waiting.append(self.turn)
            self.end_turn()
        self.debt = stops

    def next_look(self, now: int) -> int | None:
        """When the kernel looks next if nothing changes."""
        if self.down or not (self.turn or self.waiting or self.shadows):
            return None
        step, ago = self.tick, self.tick_ago
        if self.debt:
            step, ago = self.period, self.period_ago
        at = ((now + ago) // step + 1) * step - ago
        return at if self.debt else min(at, self.next_wake(now, at))

    def next_wake(self, now: int, until: int) -> int:
        """When something of the background wakes next; `until` if it does not before."""
        if self.node.background_hz == 0:
            return until
        gap_ns = 1e9 / self.node.background_hz
        while self.wakes[-1] <= now:
            drawn = attempt_uniform(self.wake_key, len(self.wakes) - 1, 0)
            self.wakes.append(self.wakes[-1] + 1 + int(-math.log(1 - drawn) * gap_ns))
        return self.wakes[-1]

    @property
    def rate(self) -> int:
        """Cores that are busy."""
        if self.down or self.stopped:
            return 0
        return min(self.node.cores, self.threads + self.foreign)

    @property
    def running(self) -> list[Job]:
        if self.tick:
            return [self.turn.job] if self.turn and self.turn.job else self.shadows
        if self.node.scheduler == "fair":
            return self.jobs
        return [job for job in self.jobs if job.cores > 0]

    @property
    def threads(self) -> int:
        """K' + H'."""
        return self.threads_of(self.jobs)

    def threads_of(self, jobs: Sequence[Job]) -> int:
        """Threads of jobs, or the cores that they hold."""
        if self.node.scheduler == "fair":
            return sum(job.execution.threads for job in jobs)
        return sum(job.cores for job in jobs)

    def speed(self, cell: int) -> Fraction:
        """Speed of own jobs, or of shadow jobs."""
        if self.stopped:
            return Fraction(0)
        share = self.share if cell == ITSELF else self.share_of_shadows
        return share / self.slowness

    @property
    def slowness(self) -> Fraction:
        """How many times as much core time jobs take."""
        return self.interference if self.foreign else ONE

    @property
    def free_of_background(self) -> Fraction:
        """c'."""
        # Under a quota the background takes from the bucket, elsewhere from the cores.
        return self.node.cores - (ZERO if self.quota else self.background)

    @property
    def share(self) -> Fraction:
        """Cores that a thread of an own job has of those that there are."""
        c, s = self.node.cores, self.foreign
        left = self.free_of_background
        if self.tick:
            job = self.turn.job if self.turn else None
            return Fraction(1, job.execution.threads) if job else Fraction(0)
        if self.node.scheduler == "fair":
            return min(Fraction(1), left / max(1, self.threads_of(self.own) + s))
        return left / (c + s)

    @property
    def share_of_shadows(self) -> Fraction:
        """Cores that a thread of a shadow job has."""
        if self.node.scheduler != "fair":
            return self.share
        own, left = self.threads_of(self.own), self.free_of_background
        if self.tick:
            left = Fraction(0 if self.turn and self.turn.job else 1)
        else:
            left -= own * self.share
        return min(Fraction(1), left / max(1, self.foreign + self.threads_of(self.shadows)))

    def part(self, job: Job) -> Fraction:
        """Part of its speed at which a job runs on the cores that it holds."""
        # The speed of a fair node is that of its threads, however many a job has.
        if self.node.scheduler == "fair":
            return ONE
        return min(ONE, Fraction(self.node.cores, job.execution.threads))

    @property
    def behind(self) -> Fraction:
        """Cores that the background has."""
        if self.down or self.quota:
            return ZERO if self.down else self.background
        return min(self.background, Fraction(self.node.cores - self.rate))

    def advance(self, now: int) -> None:
        """Let the time since the last change pass."""
        elapsed = now - self.since
        if not elapsed:
            return
        self.since = now
        running, rate = self.running, self.rate
        speeds = {cell: self.speed(cell) for cell in {job.cell for job in running}}
        for job in running:
            before = max(job.left, ZERO)
            job.left -= speeds[job.cell] * self.part(job) * elapsed
            received = before - max(job.left, ZERO)
            self.work[job.cell] += job.execution.threads * received
            job.core += job.execution.threads * received * self.slowness
        for kind, jobs in self.served.items():
            places = self.places[kind]
            for job in jobs:
                if job.cores == 0:
                    continue
                received = min(Fraction(elapsed), max(job.left, Fraction(0)))
                job.left -= elapsed
                places[1 + job.cell] += received
                job.core += received
                places[0] += elapsed
        self.busy += (rate + self.behind) * elapsed
        self.left -= rate * elapsed
        if self.turn:
            self.had += rate * elapsed
            self.turn.received += rate * elapsed
        if (self.slack or self.tick) and (now + self.period_ago) // self.period > self.periods:
            self.periods, self.pool = (now + self.period_ago) // self.period, self.grant

    @property
    def usage(self) -> dict[str, Usage]:
        """What the CPU has done, and each kind of the accelerators, by the resource's name."""
        name = self.node.name
        of_cpu = Usage(self.busy, self.work[ITSELF], self.work[SHADOW])
        of_kinds = {f"{name}.{kind}": Usage(*places) for kind, places in self.places.items()}
        return {name: of_cpu, **of_kinds}

    def runnable(self, job: Job) -> list[Job]:
        """Jobs among which this one runs: the CPU's, or those of its accelerator."""
        kind = job.execution.accelerator
        return self.jobs if kind is None else self.served[kind]

    def give_out(self, awaited: Callable[[str, Job], bool]) -> None:
        """Give out the cores, and the places on the accelerators.

        `awaited` says whether an own job is due on an accelerator before a shadow job would end.
        """
        c = self.node.cores
        if self.tick:
            self.line_up()
            if self.touched:
                self.notice()
            self.take_turns()
            for job in self.own:
                job.cores = int(self.turn is not None and job is self.turn.job)
            for job in self.shadows:
                job.cores = 1
        elif self.node.scheduler == "fair":
            for job in self.jobs:
                job.cores = min(job.execution.threads, c)
        elif self.node.scheduler == "fifo":
            hold_in_order(sorted(self.own, key=lambda job: job.readiness), c, c)
            shadows = sorted(self.shadows, key=lambda job: job.readiness)
            left = c - self.threads_of(self.own)
            put_back(shadows, left)
            hold_in_order(shadows, left, c)
        else:
            free = c
            for jobs in (self.own, self.shadows):
                for job in jobs:
                    # Reading: one that has all its work keeps its cores until it completes.
                    if job.start is None or job.left > 0:
                        job.cores = 0
                # Reading: as under fifo, the first that does not fit ends the round.
                by_priority = sorted(jobs, key=lambda job: (-job.task.priority, job.readiness))
                hold_in_order(by_priority, free, c)
                free -= self.threads_of(jobs)
        for kind, jobs in self.served.items():
            self.give_out_places(kind, sorted(jobs, key=lambda job: job.readiness), awaited)

    def give_out_places(
        self, kind: str, jobs: Sequence[Job], awaited: Callable[[str, Job], bool]
    ) -> None:
        """Give out the places of an accelerator."""
        places = self.node.accelerators[kind]
        own, shadows = ([job for job in jobs if job.cell == cell] for cell in (ITSELF, SHADOW))
        hold_in_order(own, places - sum(job.cores for job in shadows), 1)
        if kind not in self.looked_at or any(job.cores == 0 for job in own):
            return
        for job in shadows:
            full = sum(other.cores for other in jobs) >= places
            if job.cores == 0 and (full or awaited(kind, job)):
                break
            job.cores = 1

    def due(self, job: Job, now: int) -> int | None:
        """First whole nanosecond at which the job will have its execution time, as things are."""
        if job.start is not None and job.left <= 0:
            return now
        if job.cores == 0:
            return None
        speed = (
            self.speed(job.cell) * self.part(job)
            if job.execution.accelerator is None
            else Fraction(1)
        )
        if speed == 0:
            return None
        return now + math.ceil(job.left / speed)


def put_back(jobs: Sequence[Job], cores: int) -> None:
    """Take the cores of the last of some jobs, in order, until the rest fit."""
    for job in reversed(jobs):
        if sum(other.cores for other in jobs) > cores and job.left > 0:
            job.cores = 0


def hold_in_order(jobs: Sequence[Job], cores: int, width: int) -> None:
    """Give cores, at most `width`, to those that hold none, in order, until one does not fit."""
    free = cores - sum(job.cores for job in jobs)
    for job in jobs:
        if job.cores > 0:
            continue
        needed = min(job.execution.threads, width)
        if needed > free:
            break
        job.cores = needed
        free -= needed


# -------------------------------------------------------------------------------------- the run


class Simulation:
    """One run of one cell, and of its shadow if it has one.

    Cycles are stamped as `given` says, or else as a controller does that orders what the `script`
    says, one name at each decision. With a guard the cell has one, and a name that it
    holds back is said again at the next decision, unless the controller is `fickle`.
    """

    def __init__(
        self,
        problem: Problem,
        real: Realisation,
        shadows: Realisation | None,
        *,
        given: Sequence[tuple[str, str | None]] | None = None,
        script: Sequence[str] = (),
        fractions: Mapping[str, float] | None = None,
        guarded: bool = False,
        fickle: bool = False,
    ) -> None:
        self.env = simpy.Environment()
        self.problem = problem
        self.pipeline = problem.pipeline
        self.settings = problem.controller
        self.reals = [real] if shadows is None else [real, shadows]
        self.release = [int(ns) for ns in real.release_ns]
        self.number = real.cycles
        self.end = self.close_of(self.number)
        rows = [*self.pipeline.tasks, *map(second, self.pipeline.tasks)]
        self.index = {task: i for i, task in enumerate(rows)}
        self.rates = Rates(self.pipeline)
        self.copies = Copies(problem)

        self.given = given
        self.script = list(script)
        self.fractions = fractions or {}
        self.fickle = fickle
        # Candidates that were ordered, with the first cycle that each stamps.
        self.moves = [(0, problem.initial)]
        self.stamps: list[tuple[str, str | None]] = []
        self.first = 0
        self.over = False
        self.opened: dict[int, dict[str, Usage]] = {}
        self.transmitted: list[Transmission] = []
        self.windows: list[WindowResult] = []
        self.looks: list[Look] = []
        self.every = problem.decide_cycles
        # First cycle under the placement that decisions look at, and end of the next stretch.
        self.since = 0
        self.due = self.every
        self.migration = 0
        self.moving = False

        period, deadline = map(nanoseconds, (self.pipeline.period_ms, self.pipeline.deadline_ms))
        more = self.settings.guard_cycles - 1
        waits = [Wait(max(deadline, period) + more * period)]
        # Chains whose age the guard bounds.
        self.chains = [
            chain for chain in self.pipeline.chains.values() if math.isfinite(chain.max_age_ms)
        ]
        for chain in self.chains:
            ways = self.rates.on_ways(chain.source, chain.target)
            slowest = max(self.rates.of[task] for task in ways)
            patience = nanoseconds(chain.max_age_ms) + more * slowest * period
            waits.append(Wait(patience, is_chain=True, every=self.rates.of[chain.source]))
        self.patiences = [wait.patience for wait in waits]
        self.guard = Guard(problem, waits) if guarded else None
        self.proof = Proof(problem, max(self.patiences))
        self.decisions: list[Decision] = []
        # Candidates that cycles are probes of, from which on.
        self.wishes: list[tuple[int, str | None]] = []
        self.heard_of: set[tuple[int, int]] = set()

        self.nodes = {name: NodeState(node) for name, node in problem.fabric.nodes.items()}
        for name, (period_ago, tick_ago, wake_key) in real.phases.items():
            self.nodes[name].period_ago, self.nodes[name].tick_ago = period_ago, tick_ago
            self.nodes[name].wake_key = wake_key
        self.pools = {
            (cell, name, node): Pool(task, execution.workers)
            for cell in range(len(self.reals))
            for name, task in self.pipeline.tasks.items()
            for node, execution in task.on.items()
        }
        self.queues = {link: simpy.Store(self.env) for link in problem.fabric.links}
        self.last_arrival = dict.fromkeys(problem.fabric.links, (0, -1))
        # Messages of links with an order that have not arrived, by their first attempts.
        self.ordered: dict[str, list[Message]] = {link: [] for link in problem.fabric.links}
        self.segments: dict[str, list[LinkSegment]] = {link: [] for link in problem.fabric.links}
        for segment in real.link_segments:
            self.segments[segment.link].append(segment)

        # By cell and cycle, then by task.
        self.placed: dict[tuple[int, int], Copy] = {}
        self.apart: dict[int, set[str]] = {}
        self.losses: dict[tuple[int, int], list[tuple[int, int, str]]] = {}
        # Cycles of which anything is lost, needed or not.
        self.flawed: set[tuple[int, int]] = set()
        # Newest cycle that a node has of a sampled flow, by the flow's place and the node.
        self.values: dict[tuple[int, str], int] = {}
        # Newest cycle that has been forwarded of it over a link.
        self.forwarded: dict[tuple[int, str], int] = {}
        self.inputs: dict[tuple[int, int, str], list[tuple[int, Job]]] = {}
        self.lost_joins: set[tuple[int, int, str]] = set()
        self.jobs: dict[tuple[int, int, str], Job] = {}
        self.arrived: dict[tuple[int, int, str, str], int] = {}
        self.given_up: set[int] = set()
        # Least time from a release to readiness, by candidate and task.
        self.soonest: dict[tuple[str, str], int] = {}

        self.log: list[LogEntry] = []
        self.current = -1
        self.numbers = itertools.count()

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
        cell: int = ITSELF,
        flow: int = 0,
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
            # Links begin what the event sends: what is lost then is lost before the event ends.
            At(self.env, 0, EVENT_END, self.end_event)

        order = (((kind * 10 + cell) * 10**9 + cycle + 1) * 10**6 + task + 1) * 10**6 + flow
        At(self.env, time - self.now, order, happen)

    def end_event(self) -> None:
        """Give out cores, and places on accelerators."""
        for name, node in self.nodes.items():
            node.give_out(self.awaiter(name))
            node.give_back()
            self.plan(node)
            node.touched = False
            node.looked_at.clear()

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
        if node.thirsty:
            empty_at = now
        if node.tick:
            # A look at this instant that has yet to come is not passed over.
            empty_at = node.next_look(now)
            if empty_at is not None and node.empty_at == now:
                empty_at = now
        if empty_at != node.empty_at:
            node.empty_at = empty_at
            if empty_at is not None:
                # Nothing else happens then; every event looks anew at who runs, and how fast.
                look = self.looker(node, empty_at)
                self.at(empty_at, DISTURBANCE, -1, LAST_CHANGE, look, fixed=bool(node.tick))

    def awaiter(self, node: str) -> Callable[[str, Job], bool]:
        """Whether an own job is due on an accelerator of a node before a shadow job would end."""

        def on_it(cycle: int, kind: str) -> list[str]:
            there = [
                (name, row)
                for name in self.pipeline.tasks
                for row in (name, second(name))[: 1 + self.copies.is_doubled(cycle, name)]
                if self.node_of(ITSELF, cycle, row) == node
            ]
            return [row for name, row in there if self.execution(name, node).accelerator == kind]

        def awaited(kind: str, job: Job) -> bool:
            end = self.now + nanoseconds(job.execution.exec_ms.expectation)
            period = nanoseconds(self.pipeline.period_ms)
            for cycle, (active, _) in enumerate(self.stamps):
                for row in on_it(cycle, kind):
                    task = self.copies.names.get(row, row)
                    due = self.release[cycle] + self.soonest.get((active, row), 0)
                    follows = cycle == len(self.stamps) - 1 and self.rates.is_due(task, cycle + 1)
                    if follows and due + period < end:
                        return True
                    if not self.rates.is_due(task, cycle):
                        continue
                    missing = (ITSELF, cycle, row) not in self.jobs
                    over = (ITSELF, cycle) in self.flawed or self.copies.has_heard(cycle, node)
                    if missing and not over and due < end and self.now < due + period:
                        return True
            return False

        return awaited

    def execution(self, task: str, node: str) -> Execution:
        return self.pipeline.tasks[task].on[node]

    def looker(self, node: NodeState, time: int) -> Callable[[], None]:
        def look() -> None:
            if not node.tick:
                node.draw()
            elif time == node.empty_at:
                node.empty_at = None
                node.pass_on(time)

        return look

    def renewer(self, node: NodeState) -> Callable[[], None]:
        return node.renew

    def foresee(self, job: Job, due: int) -> None:
        self.at(
            due,
            COMPLETION,
            job.cycle,
            job.index,
            lambda: self.complete(job),
            cell=job.cell,
            cause=job.started_by,
            valid=lambda: job.due == due and job.outcome == "in_flight",
        )

    # --------------------------------------------------------------------------------- the run

    def run(self) -> Result:
        for name in self.segments:
            for segment in self.segments[name]:
                self.note(segment.at_ns, -1, fixed=True)
            self.env.process(self.transmit(name))
        for i, change in enumerate(self.reals[ITSELF].node_changes):
            self.at(change.at_ns, DISTURBANCE, -1, i, self.changer(change), fixed=True)
        for node in self.nodes.values():
            own = node.quota and not node.tick
            for begin in range(node.period, self.end + 1, node.period) if own else ():
                self.at(begin, DISTURBANCE, -1, LAST_CHANGE, self.renewer(node), fixed=True)
        for k in range(self.number):
            self.at(self.release[k], RELEASE, k, -1, self.releaser(k), fixed=True)
        if self.guard is not None:
            for time in sorted(self.guard_looks()):
                self.at(time, GUARD, -1, -1, self.look, fixed=True)
        self.open_window(0)
        self.look_from(0)
        while not self.over and self.env.peek() <= self.end:
            self.env.step()
        return Result(
            cycles=tuple(self.cycle_result(k) for k in range(len(self.stamps))),
            jobs=self.results(ITSELF),
            shadow_jobs=self.results(SHADOW),
            arrived=self.arrived,
            windows=tuple(self.windows),
            looks=tuple(self.looks),
            stamps=tuple(self.stamps),
            decisions=tuple(self.decisions),
            closest_ns=closest_unrelated(self.log),
            late=self.copies.late,
            transmitted=tuple(self.transmitted),
            heard=self.copies.heard,
        )

    def results(self, cell: int) -> dict[tuple[int, str], JobResult]:
        return {key[1:]: job.result for key, job in self.jobs.items() if key[0] == cell}

    # ------------------------------------------------------------------- windows and migrations

    @property
    def usage(self) -> dict[str, Usage]:
        return {name: of for node in self.nodes.values() for name, of in node.usage.items()}

    def open_window(self, first: int) -> None:
        """Let the next window begin with this cycle; without a whole one left, the run is over."""
        self.first = first
        boundary = first + self.problem.window_cycles
        if boundary > self.number:
            self.over = True
            return
        self.at(
            self.close_of(boundary),
            CLOSE,
            boundary,
            -1,
            self.close_window,
            fixed=True,
            # A window that the guard has cut short does not close.
            valid=lambda: self.first == first,
        )

    def close_of(self, boundary: int) -> int:
        """Close of the window that ends before a cycle: no deadline of its cycles comes later."""
        # Reading: a deadline between two nanoseconds has passed after the first of them.
        deadline = math.floor(Fraction(repr(self.pipeline.deadline_ms)) * 10**6)
        first = max(0, boundary - self.problem.window_cycles)
        deadlines = [release + deadline for release in self.release[first:boundary]]
        grace = nanoseconds(self.settings.close_grace_ms)
        return max(self.release[boundary] + grace, *deadlines)

    def close_window(self) -> None:
        boundary = self.first + self.problem.window_cycles
        known, arrived = self.known_of(self.first, boundary)
        self.windows.append(
            WindowResult(
                first_cycle=self.first,
                close_ns=self.now,
                opened=self.opened.get(self.first, self.usage),
                closed=self.usage,
                known=known,
                arrived=arrived,
            )
        )
        if not self.between:
            self.decide(boundary)
        if self.first + self.problem.window_cycles == boundary:
            self.open_window(boundary)

    def known_of(
        self, first: int, end: int
    ) -> tuple[dict[tuple[int, int, str], JobResult], dict[tuple[int, int, str, str], int]]:
        """Return the jobs and arrivals of some cycles up to now."""
        known = {key: job.result for key, job in self.jobs.items() if first <= key[1] < end}
        return known, {key: at for key, at in self.arrived.items() if first <= key[1] < end}

    # --------------------------------------------------------------------------------- decisions

    @property
    def between(self) -> bool:
        """Whether decisions are made between the closes of windows."""
        return self.given is None and self.every < self.problem.window_cycles

    def look_from(self, since: int) -> None:
        """Count the cycles of the next decisions from the first cycle under a placement."""
        self.since = since
        self.await_decision(since + self.every)

    def await_decision(self, boundary: int) -> None:
        """Make the next decision when a window that ends before this cycle would close."""
        self.due = boundary
        if self.between and boundary <= self.number:
            self.at(
                self.close_of(boundary),
                DECIDE,
                boundary,
                -1,
                lambda: self.decide(boundary),
                fixed=True,
                # A move puts it off.
                valid=lambda: self.due == boundary and not self.moving,
            )

    def decide(self, boundary: int) -> None:
        """Look at the last W cycles under the placement, and order what the script says."""
        begin, first = boundary - self.every, max(self.since, boundary - self.problem.window_cycles)
        earliest = max(0, min(first, begin - earlier_cycles(self.problem)))
        known, arrived = self.known_of(earliest, boundary)
        self.looks.append(
            Look(
                earliest=earliest,
                first=first,
                begin=begin,
                last=boundary - 1,
                close_ns=self.now,
                opened=self.opened.get(first, self.usage),
                begun=self.opened.get(begin, self.usage),
                closed=self.usage,
                known=known,
                arrived=arrived,
            )
        )
        active = self.moves[-1][1]
        order = active
        if self.given is None and not self.nodes[self.problem.controller_node].down:
            order = self.next_order(active, boundary)
        if order == active:
            self.await_decision(boundary + self.every)
        elif self.settings.migration == "cold" and self.apart_of(active, order):
            self.migrate(active, order, boundary)
        else:
            delay = nanoseconds(self.settings.order_delay_ms)
            self.move(order, boundary, self.now + delay, begins_window=not self.between)

    def apart_of(self, active: str, order: str) -> dict[str, tuple[str, str, str]]:
        """Return what a move brings to another node: task, old node of the first copy, new node.

        The second new node of a task goes by the name of its second copy.
        """
        found: dict[str, tuple[str, str, str]] = {}
        old, new = (self.copies.placements(name) for name in (active, order))
        for task in self.pipeline.tasks:
            here = [placed[task] for placed in old]
            for node in dict.fromkeys(placed[task] for placed in new):
                if node not in here:
                    found[second(task) if task in found else task] = task, here[0], node
        return found

    def next_order(self, active: str, boundary: int) -> str:
        """Return what the policy says, unless the guard holds it back."""
        name = self.script[0]
        held = self.held_back(name, active, boundary)
        if not held or self.fickle:
            self.script.pop(0)
        order = active if held else name
        last, cycles = boundary - 1, boundary - self.looks[-1].first
        self.decisions.append(
            Decision(self.window_of(last), last, cycles, active, order, by_guard=held)
        )
        return order

    def window_of(self, cycle: int) -> int:
        """Return the number of windows that end before a cycle."""
        ends = [window.first_cycle + self.problem.window_cycles for window in self.windows]
        return sum(end <= cycle for end in ends)

    def held_back(self, name: str, active: str, boundary: int) -> bool:
        """Whether an order has to wait for its proof, which begins with the wish."""
        if self.guard is None or not self.guard.on_fallback:
            return False
        if name != active and self.proof.proven(name, self.now):
            return False
        wish = None if name == active else name
        if wish != self.proof.wanted:
            self.proof.want(wish)
            delay = nanoseconds(self.settings.order_delay_ms)
            self.wishes.append((self.first_stamped(boundary, self.now + delay), wish))
        return wish is not None

    def move(self, order: str, boundary: int, ready: int, *, begins_window: bool) -> None:
        """Stamp cycles with what was ordered once it is ready."""
        first = self.first_stamped(boundary, ready)
        self.moves.append((first, order))
        self.moving = False
        if self.guard is not None and self.guard.on_fallback:
            self.proof.returns()
            self.wishes.append((first, None))
        if begins_window:
            self.open_window(first)
        self.look_from(first)

    def first_stamped(self, boundary: int, ready: int) -> int:
        """First cycle that an order stamps which takes effect at `ready`."""
        later = [k for k in range(self.number) if self.release[k] >= ready]
        return max(boundary + self.settings.order_lead_cycles, [*later, self.number][0])

    def migrate(self, active: str, order: str, boundary: int) -> None:
        """Give an order for a cold migration."""
        arrival = self.now + nanoseconds(self.settings.order_delay_ms)
        if self.first_stamped(boundary, arrival) + self.problem.window_cycles > self.number:
            self.over = True  # no window can follow, however fast the tasks move
            return
        moving = self.apart_of(active, order)
        # No window closes, and nothing is decided, before the migration is over.
        self.first, self.moving = -1, True
        self.migration += 1
        number = self.migration

        def be_ready(row: str) -> None:
            del moving[row]
            if not moving:
                self.move(order, boundary, self.now, begins_window=True)

        def arrive() -> None:
            for row, (task, _, _) in moving.items():
                started = self.now + nanoseconds(self.pipeline.tasks[task].start_ms)
                self.step(started, 0, row, number, lambda row=row: send_state(row))  # type: ignore[misc]

        def send_state(row: str) -> None:
            task, old, new = moving[row]
            payload = self.pipeline.tasks[task].state_bytes
            if payload == 0:
                be_ready(row)
                return
            link = f"{old}->{new}"
            self.send(
                link,
                Message(
                    ITSELF,
                    boundary,
                    row,
                    payload,
                    self.draws(ITSELF, self.reals[ITSELF].hops.index((task, task, link))),
                    lambda: be_ready(row),
                    self.now,
                    self.current,
                    self.index[row],
                    is_state=True,
                    migration=number,
                ),
            )

        valid = self.going_on(number)
        self.at(arrival, STEP, -1, -1, arrive, fixed=True, valid=valid)

    def going_on(self, migration: int) -> Callable[[], bool]:
        """Whether a migration has not been cut short by the guard."""
        return lambda: migration == self.migration

    def step(
        self,
        time: int,
        attempt: int,
        task: str,
        migration: int,
        action: Callable[[], None],
        *,
        cause: int | None = None,
    ) -> None:
        """Let a cold migration go on with a task."""
        valid = self.going_on(migration)
        self.at(time, STEP, attempt, self.index[task], action, cause=cause, valid=valid)

    # --------------------------------------------------------------------------------- the guard

    def guard_looks(self) -> set[int]:
        """Instants at which the guard may move: patience ends, or something is there again."""
        back = {change.at_ns for change in self.reals[ITSELF].node_changes}
        started = {
            at + nanoseconds(task.start_ms) for at in back for task in self.pipeline.tasks.values()
        }
        links = {segment.at_ns for segments in self.segments.values() for segment in segments}
        old = {release + patience for release in self.release for patience in self.patiences}
        return old | back | started | links

    def node_down_since(self, node: str, start: int = 0) -> int | None:
        """Since when a node is down; with a `start`, a worker on it that takes as long to be ready.

        None where it is there.
        """
        since, there = None, 0
        for change in self.reals[ITSELF].node_changes:
            if change.node != node or change.at_ns > self.now:
                continue
            if change.down:
                # A worker that is not ready by then has not been there in between.
                since = since if since is not None and change.at_ns <= there else change.at_ns
                there = NEVER
            elif there == NEVER:
                there = change.at_ns + start
        return None if there <= self.now else since

    def link_down_since(self, link: str) -> int | None:
        """Since when a link is down; None where it is up."""
        since = None
        for segment in self.segments[link]:
            if segment.at_ns <= self.now:
                since = None if not segment.down else segment.at_ns if since is None else since
        return since

    def is_there(self, candidate: str) -> bool:
        """Whether nothing of a candidate is missing."""
        # Only of fallbacks, which have no replicas.
        placement = self.problem.candidates[candidate].first
        since = [self.node_down_since(node) for node in placement.values()]
        for name, task in self.pipeline.tasks.items():
            since.append(self.node_down_since(placement[name], nanoseconds(task.start_ms)))
        for flow in self.pipeline.flows:
            source, target = placement[flow.source], placement[flow.target]
            if source != target:
                since.append(self.link_down_since(f"{source}->{target}"))
        longest = (self.settings.guard_cycles - 1) * nanoseconds(self.pipeline.period_ms)
        return all(down is None or self.now - down < longest for down in since)

    def look(self) -> None:
        """Let the guard look whether to move."""
        if self.guard is None or self.nodes[self.problem.stamper_node].down:
            return
        fallback = self.guard.look(self.now, self.is_there)
        if fallback is None:
            return
        first = [*(k for k in range(self.number) if self.release[k] >= self.now), self.number][0]
        left = self.guard.stay.placement
        self.guard.move(fallback)
        self.proof.relapse()
        self.migration += 1
        self.moves = [*(move for move in self.moves if move[0] < first), (first, fallback)]
        self.wishes = [*(wish for wish in self.wishes if wish[0] < first), (first, None)]
        self.moving = False
        self.open_window(first)
        self.look_from(first)
        if not self.over:
            window = len(self.windows)
            self.decisions.append(Decision(window, first - 1, 0, left, fallback, by_guard=True))

    def hear_back(self, cell: int, cycle: int) -> None:
        """Let the guard hear of a cycle or a probe if it has completed, after the way back."""
        if self.guard is None or (cell, cycle) in self.heard_of or (cell, cycle) not in self.placed:
            return
        if self.is_given_up(cell, cycle):
            return
        if not self.counts(cell, cycle) or not self.is_complete(cell, cycle):
            return
        self.heard_of.add((cell, cycle))
        back = way_back(self.problem, self.placed[cell, cycle])
        self.at(self.now + back, ARRIVAL, cycle, -1, lambda: self.heard(cell, cycle), cell=cell)

    def hear_actuation(self, job: Job) -> None:
        """Let the guard hear of an actuation of a chain, after the way back."""

        def taken(cycle: int, task: str) -> Mapping[str, int]:
            return self.jobs[ITSELF, cycle, task].taken

        back = way_from(self.problem, [job.node])
        for number, chain in enumerate(self.chains):
            if chain.target != job.task.name:
                continue
            known = self.rates.descent(taken, chain.source, chain.target, job.cycle)
            for origin in [min(known)] if known else []:
                act = self.actuated(number, origin)
                self.at(self.now + back, ARRIVAL, job.cycle, -1, act)

    def actuated(self, chain: int, origin: int) -> Callable[[], None]:
        def heard() -> None:
            if self.guard is not None:
                self.guard.hear(origin, chain)

        return heard

    def heard(self, cell: int, cycle: int) -> None:
        """The guard hears of the completion of a cycle or a probe."""
        if self.guard is None:
            return
        through = self.stamps[cycle][cell]
        if through is not None:
            self.guard.hear_through(through, cycle)
        if cell == ITSELF:
            self.guard.hear(cycle)
            if not self.guard.on_fallback and cycle >= self.guard.returned:
                self.proof.complete()
        elif self.is_probe(cycle):
            self.proof.hear(cycle, self.now)

    def is_probe(self, cycle: int) -> bool:
        """Whether a cycle that is released is sent through what is wanted now."""
        first, wish = self.wishes[-1] if self.wishes else (0, None)
        return wish is not None and first <= cycle

    def counts(self, cell: int, cycle: int) -> bool:
        """Whether the guard counts a cycle (a sink is due), or a shadow (a task apart is due)."""
        if cell == ITSELF:
            return bool(self.rates.due_sinks(cycle))
        away = self.apart[cycle]
        return not away or any(self.rates.is_due(task, cycle) for task in away)

    def is_complete(self, cell: int, cycle: int) -> bool:
        """Whether a cycle is done, or all messages of a shadow have been handed over."""
        sinks = self.rates.due_sinks(cycle)
        return all(self.reached(cell, cycle, sink) for sink in sinks) and all(
            (SHADOW, cycle, flow.source, flow.target) in self.arrived
            for flow in self.pipeline.flows
            if cell == SHADOW and flow.sampled and self.is_shadowed(flow.source, cycle)
        )

    def is_shadowed(self, task: str, cycle: int) -> bool:
        """Whether the shadow of a cycle has a job of a task."""
        away = task in self.apart[cycle] and task not in self.rates.sinks
        return away and self.rates.is_due(task, cycle)

    def reached(self, cell: int, cycle: int, sink: str) -> bool:
        """Whether a sink has completed, or has all inputs that a shadow stops with."""
        if cell == ITSELF or sink not in self.apart[cycle]:
            job = self.jobs.get((ITSELF, cycle, sink))
            return job is not None and job.outcome == "done"
        return all(
            (SHADOW, cycle, flow.source, sink) in self.arrived
            for flow in self.rates.waited_inputs(sink)
        )

    # ---------------------------------------------------------------------------------- cycles

    def stamp(self, cycle: int) -> tuple[str, str | None]:
        """Return the candidate of a cycle, and the one that it is also sent through."""
        if self.given is not None:
            return self.given[cycle]
        active = [name for first, name in self.moves if first <= cycle][-1]
        wishes = [name for first, name in self.wishes if first <= cycle]
        if wishes and wishes[-1] is not None:
            return active, self.copies.probed(wishes[-1], active)
        fraction = self.fractions.get(active, 0.0)
        return active, shadow_stamp(cycle, active, self.copies.plain(active), fraction)

    def releaser(self, cycle: int) -> Callable[[], None]:
        def release() -> None:
            self.opened[cycle] = self.usage
            self.give_up(cycle - self.problem.window_cycles - GIVEN_UP_AFTER)
            for node in self.nodes.values():
                node.looked_at |= set(node.served)
            active, other = self.stamp(cycle)
            self.stamps.append((active, other))
            self.placed[ITSELF, cycle] = self.problem.candidates[active].first
            self.copies.release(cycle, active)
            if other is not None:
                self.placed[SHADOW, cycle] = self.problem.candidates[other].first
                self.apart[cycle] = self.rates.apart(
                    self.problem.candidates[active], self.placed[SHADOW, cycle]
                )
            self.move_values(cycle)
            if self.guard is not None:
                self.tell_guard(cycle, active, other)
            for name in self.rates.sources:
                if not self.rates.is_due(name, cycle):
                    continue
                offset = nanoseconds(self.pipeline.tasks[name].offset_ms)
                if offset == 0:
                    self.start_source(ITSELF, cycle, name)
                else:
                    self.start_later(ITSELF, cycle, name, offset)
                if self.copies.is_doubled(cycle, name):
                    later = max(offset, self.copies.after_ns(cycle))
                    self.start_later(ITSELF, cycle, second(name), later)
            if other is not None:
                self.release_shadow(cycle)

        return release

    def tell_guard(self, cycle: int, active: str, other: str | None) -> None:
        """Let the guard know of a cycle, and of its shadow, if they count."""
        assert self.guard is not None
        through = other if other is not None and self.counts(SHADOW, cycle) else None
        due = self.counts(ITSELF, cycle)
        self.guard.release(cycle, self.now, active, through, due=due)
        if self.is_probe(cycle) and through is not None:
            self.proof.released[cycle] = self.now

    def release_shadow(self, cycle: int) -> None:
        """Release the shadow of a cycle: sources that run elsewhere are started a second time."""
        for name in self.rates.sources:
            if self.is_shadowed(name, cycle):
                offset = nanoseconds(self.pipeline.tasks[name].offset_ms)
                self.start_later(SHADOW, cycle, name, offset)
        self.hear_back(SHADOW, cycle)

    def give_up(self, cycle: int) -> None:
        """Give up the shadow of a cycle."""
        self.given_up.add(cycle)
        for name in self.pipeline.tasks:
            job = self.jobs.get((SHADOW, cycle, name))
            if job is None or job.outcome != "in_flight":
                continue
            pool = self.pools[SHADOW, name, job.node]
            job.due = None
            if job in pool.waiting:
                pool.waiting.remove(job)
                continue
            self.nodes[job.node].runnable(job).remove(job)
            self.looked_at(job)
            pool.idle += 1
            self.take(pool, job.node)

    def is_given_up(self, cell: int, cycle: int) -> bool:
        return cell == SHADOW and cycle in self.given_up

    def looked_at(self, job: Job) -> None:
        """Note that something happened to jobs of an accelerator."""
        if job.execution.accelerator is not None:
            self.nodes[job.node].looked_at.add(job.execution.accelerator)

    def start_later(self, cell: int, cycle: int, task: str, offset: int) -> None:
        self.at(
            self.now + offset,
            START,
            cycle,
            self.index[task],
            lambda: self.start_source(cell, cycle, task),
            cell=cell,
            fixed=True,
        )

    def start_source(self, cell: int, cycle: int, task: str) -> None:
        # Reading: a source with an offset is released when its offset is over. On a node that is
        # down its job is lost as soon as it is ready.
        if self.is_given_up(cell, cycle):
            return
        if cell == ITSELF and self.copies.has_heard(cycle, self.node_of(cell, cycle, task)):
            return
        job = self.make_job(cell, cycle, task, ())
        if self.nodes[job.node].down:
            self.lose_job(job, "node_down")
        else:
            self.queue_up(job)

    def lose(
        self,
        cell: int,
        cycle: int,
        outcome: str,
        since: tuple[int, int] | None = None,
        *,
        is_needed: bool = True,
    ) -> None:
        """Something of a cycle is lost, now or since an event; the first loss names its outcome."""
        self.flawed.add((cell, cycle))
        if is_needed:
            event, number = since or (self.current, next(self.numbers))
            self.losses.setdefault((cell, cycle), []).append((event, number, outcome))

    def lose_message(
        self, message: Message, outcome: str, since: tuple[int, int] | None = None
    ) -> None:
        """Lose a message for ever; state and forwarded values belong to no cycle."""
        if not message.is_state and not message.is_forward:
            needed = message.is_needed
            self.lose(message.cell, message.cycle, outcome, since, is_needed=needed)

    def lose_job(self, job: Job, outcome: str) -> None:
        job.outcome = outcome
        job.end = self.now
        # A job that an output makes ready takes another's place when all outputs have been sent.
        late = (self.current, LATE) if outcome == "replaced" else None
        needed = self.rates.is_needed(job.task.name, job.cycle)
        self.lose(job.cell, job.cycle, outcome, late, is_needed=needed)

    def drop(self, message: Message, begun: int) -> None:
        """Lose a message on its link, in the event that sends it or else as an arrival."""
        if message.sent_at == self.now:
            self.lose_message(message, "dropped", message.sent)
            return
        self.at(
            self.now,
            ARRIVAL,
            message.cycle,
            message.task,
            lambda: self.lose_message(message, "dropped"),
            cell=message.cell,
            flow=message.flow,
            cause=begun,
        )

    def cycle_result(self, cycle: int) -> CycleResult:
        due = self.rates.due_sinks(cycle)
        if not due:
            return CycleResult("idle")
        sinks = [self.jobs.get((ITSELF, cycle, name)) for name in due]
        done = [job for job in sinks if job is not None and job.outcome == "done"]
        if len(done) < len(due):
            lost = self.losses.get((ITSELF, cycle))
            return CycleResult(min(lost)[-1] if lost else "in_flight")
        end = max(self.end_of(job) for job in done)
        splits = {
            split for job in done if job.end == end for split in self.splits(job, Split(0, 0, 0))
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

    def is_common(self, cell: int, cycle: int, task: str) -> bool:
        """Whether a task of a cycle with two copies runs once; shadows have one copy."""
        return cell == ITSELF and self.copies.is_common(cycle, task)

    def node_of(self, cell: int, cycle: int, row: str) -> str:
        """Return the node of a task, or of its second copy."""
        if row in self.pipeline.tasks:
            return self.placed[cell, cycle][row]
        return self.copies.node_of_second(cycle, row)

    def deliver(
        self, cell: int, cycle: int, flow: Flow, sender: Job, *, is_second: bool = False
    ) -> None:
        """Bring one input to a task, by a message or by a hand-over on the same node."""
        task, ends = flow.target, (flow.source, flow.target)
        if is_second:
            ends = second(flow.source), second(flow.target)
            task = second(task) if self.copies.is_doubled(cycle, task) else task
        key = (cell, cycle, task)
        if self.is_given_up(cell, cycle):
            return
        node = self.node_of(cell, cycle, task)
        if self.nodes[node].down:
            needed = not flow.sampled and self.rates.is_needed(flow.target, cycle)
            self.lose(cell, cycle, "node_down", is_needed=needed)
            if not flow.sampled and not self.is_common(cell, cycle, task):
                self.lost_joins.add(key)
            return
        self.arrived[cell, cycle, *ends] = self.now
        if cell == ITSELF and self.copies.is_late(cycle, flow, task, node):
            return
        if cell == SHADOW:
            self.hear_back(SHADOW, cycle)
        if flow.sampled:
            if cell == ITSELF:
                self.keep_value(flow, node, cycle)
            return
        if key in self.lost_joins:
            return
        there = self.inputs.setdefault(key, [])
        there.append((self.now, sender))
        if len(there) == len(self.rates.waited_inputs(flow.target)):
            del self.inputs[key]
            last = tuple(job for arrival, job in there if arrival == self.now)
            # A shadow stops before the sinks.
            if cell == ITSELF or task not in self.rates.sinks:
                self.queue_up(self.make_job(cell, cycle, task, last))

    def make_job(self, cell: int, cycle: int, row: str, senders: tuple[Job, ...]) -> Job:
        """Return the job that is ready now."""
        is_second = row not in self.pipeline.tasks
        name = self.copies.names[row] if is_second else row
        task = self.pipeline.tasks[name]
        node = self.node_of(cell, cycle, row)
        real = self.reals[cell]
        job = Job(
            cell=cell,
            cycle=cycle,
            task=task,
            index=self.index[row],
            is_second=is_second,
            execution=task.on[node],
            node=node,
            ready=self.now,
            left=Fraction(int(real.exec_ns[real.sites.index((name, node)), cycle])),
            senders=senders,
        )
        self.jobs[cell, cycle, row] = job
        if cell == ITSELF:
            since, under = self.now - self.release[cycle], self.stamps[cycle][0]
            self.soonest[under, row] = min(since, self.soonest.get((under, row), since))
        return job

    def queue_up(self, job: Job) -> None:
        pool = self.pools[job.cell, job.task.name, job.node]
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
            self.take_values(job)
            self.nodes[node].runnable(job).append(job)
            self.looked_at(job)

    def complete(self, job: Job) -> None:
        job.end = self.now
        job.outcome = "done"
        self.nodes[job.node].runnable(job).remove(job)
        self.looked_at(job)
        pool = self.pools[job.cell, job.task.name, job.node]
        pool.idle += 1
        self.take(pool, job.node)
        if job.cell == ITSELF and self.copies.has_heard(job.cycle, job.node):
            return
        outputs = [
            flow
            for flow in self.pipeline.outputs(job.task.name)
            if self.rates.carries(flow, job.cycle)
        ]
        for flow in outputs:
            self.send_output(job.cell, flow, job, is_second=job.is_second)
        if self.is_common(job.cell, job.cycle, job.task.name):
            for flow in outputs:
                if self.copies.is_doubled(job.cycle, flow.target):
                    self.send_to_second(flow, job)
        self.announce_done(job.cycle)
        if job.cell == ITSELF and (SHADOW, job.cycle) in self.placed:
            # Where the shadow shares the job, its outputs go to what it does not share, too.
            away = self.apart[job.cycle]
            for flow in outputs:
                if not flow.sampled and job.task.name not in away and flow.target in away:
                    self.send_output(SHADOW, flow, job)
        if job.cell == ITSELF and job.task.name in self.rates.sinks:
            self.hear_back(ITSELF, job.cycle)
            self.hear_back(SHADOW, job.cycle)
        if job.cell == ITSELF and self.guard is not None:
            self.hear_actuation(job)

    def send_to_second(self, flow: Flow, job: Job) -> None:
        """Send an output of a common task to the second copy of its target, or hold it."""
        cycle, number = job.cycle, self.pipeline.flows.index(flow)
        due = self.release[cycle] + self.copies.after_ns(cycle)
        if self.now >= due:
            self.send_output(ITSELF, flow, job, is_second=True)
            return
        self.copies.held[cycle, number] = job.node

        def end() -> None:
            held = self.copies.held.pop((cycle, number), None) is not None
            if held and not self.copies.has_heard(cycle, job.node):
                self.send_output(ITSELF, flow, job, is_second=True)

        row = self.index[second(flow.target)]
        self.at(due, REPEAT, cycle, row, end, flow=number, fixed=True)

    def announce_done(self, cycle: int) -> None:
        """Let the nodes of a cycle with two copies hear that it is done, once."""
        if not self.copies.is_replicated(cycle) or cycle in self.copies.done:
            return
        jobs = [self.jobs.get((ITSELF, cycle, sink)) for sink in self.rates.sinks]
        if any(job is None or job.outcome != "done" for job in jobs):
            return
        self.copies.done.add(cycle)
        for number, node, way in self.copies.ways(cycle):

            def hear(node: str = node) -> None:
                self.copies.heard[cycle, node] = self.now
                for (cell, _, site), pool in self.pools.items():
                    waiting = [job for job in pool.waiting if job.cycle == cycle]
                    for job in waiting if (cell, site) == (ITSELF, node) else ():
                        pool.waiting.remove(job)

            self.at(self.now + way, START, cycle, 2 * len(self.pipeline.tasks) + number, hear)

    def send_output(self, cell: int, flow: Flow, job: Job, *, is_second: bool = False) -> None:
        """Hand an output over, or send it, to where a cell has its target."""
        cycle = job.cycle
        if self.is_given_up(cell, cycle):
            return
        target = self.placed[cell, cycle][flow.target]
        row = flow.target
        if is_second:
            row = second(row)
            if self.copies.is_doubled(cycle, flow.target):
                target = self.copies.node_of_second(cycle, row)
        if target == job.node:
            self.deliver(cell, cycle, flow, job, is_second=is_second)
            return
        link = f"{job.node}->{target}"
        self.send(
            link,
            Message(
                cell,
                cycle,
                flow.target,
                flow.payload_bytes,
                self.draws(cell, self.reals[cell].hops.index((flow.source, flow.target, link))),
                lambda: self.deliver(cell, cycle, flow, job, is_second=is_second),
                self.now,
                self.current,
                self.index[row],
                flow=self.pipeline.flows.index(flow),
                is_needed=not flow.sampled and self.rates.is_needed(flow.target, cycle),
                is_stopped=lambda: cell == ITSELF and self.copies.has_heard(cycle, job.node),
            ),
        )

    def draws(self, cell: int, row: int) -> Draws:
        """Return the draws of a flow, of state, or of forwarded values on a link."""
        real = self.reals[cell]
        layers = {layer: real.extra_ns[i] for i, (of, layer) in enumerate(real.layers) if of == row}
        return Draws(real.delay_ns[row], layers, int(real.loss_keys[row]))

    # --------------------------------------------------------------------------- sampled flows

    def take_values(self, job: Job) -> None:
        """Let a job get the values of its sampled inputs; a shadow runs on its cycle's."""
        for flow in self.rates.sampled_inputs(job.task.name):
            value = self.values.get((self.pipeline.flows.index(flow), job.node))
            if value is not None and job.cell == ITSELF:
                job.taken[flow.source] = value

    def keep_value(self, flow: Flow, node: str, cycle: int) -> None:
        """Keep a message that arrives, unless it is overtaken; forward it to the flow's place."""
        key = self.pipeline.flows.index(flow), node
        if cycle <= self.values.get(key, -1):
            return
        self.values[key] = cycle
        place = self.placed[ITSELF, len(self.stamps) - 1][flow.target]
        if place != node:
            self.forward(flow, node, place)

    def move_values(self, cycle: int) -> None:
        """Let the old places of sampled flows forward their values to the new places."""
        if cycle == 0:
            return
        before, after = self.placed[ITSELF, cycle - 1], self.placed[ITSELF, cycle]
        for flow in self.pipeline.flows:
            if flow.sampled and before[flow.target] != after[flow.target]:
                self.forward(flow, before[flow.target], after[flow.target])

    def forward(self, flow: Flow, node: str, place: str) -> None:
        """Forward the value of a node to the place of a flow, if that is newer."""
        number = self.pipeline.flows.index(flow)
        cycle = self.values.get((number, node), -1)
        link = f"{node}->{place}"
        known = max(self.values.get((number, place), -1), self.forwarded.get((number, link), -1))
        if cycle <= known or link not in self.problem.fabric.links:
            return
        self.forwarded[number, link] = cycle

        def arrive() -> None:
            if not self.nodes[place].down:
                self.keep_value(flow, place, cycle)

        real, hop = self.reals[ITSELF], (flow.source, flow.target, link)
        links = list(self.problem.fabric.links)
        self.send(
            link,
            Message(
                ITSELF,
                cycle,
                flow.target,
                flow.payload_bytes,
                self.draws(ITSELF, len(real.hops) + real.forwards.index(hop)),
                arrive,
                self.now,
                self.current,
                BEHIND_TASKS,
                flow=number * len(links) + links.index(link),
                is_forward=True,
            ),
        )

    # ----------------------------------------------------------------------------- disturbances

    def changer(self, change: NodeChange) -> Callable[[], None]:
        def happen() -> None:
            node = self.nodes[change.node]
            gone = change.down and not node.down
            node.touched_by_change = gone or node.foreign != change.threads
            node.foreign = change.threads
            node.touched = True
            node.looked_at |= set(node.served)
            if change.down and not node.down:
                node.down = True
                self.go_down(change.node)
            elif node.down and not change.down:
                node.down = False
                self.come_up(change.node)
                if self.guard is not None and change.node == self.problem.stamper_node:
                    self.guard.restart()

        return happen

    def go_down(self, name: str) -> None:
        node = self.nodes[name]
        for jobs in (node.jobs, *node.served.values()):
            for job in jobs:
                self.lose_job(job, "node_down")
            jobs.clear()
        for (_, _, site), pool in self.pools.items():
            if site == name:
                for job in pool.waiting:
                    self.lose_job(job, "node_down")
                pool.waiting.clear()
                pool.idle = 0
                pool.restart += 1
                pool.starting = True
        for cell, cycle, task in list(self.inputs):
            if self.node_of(cell, cycle, task) == name:
                del self.inputs[cell, cycle, task]
                if self.is_common(cell, cycle, task):
                    self.copies.await_again(cycle, task)
                else:
                    self.lost_joins.add((cell, cycle, task))
                needed = self.rates.is_needed(self.copies.names.get(task, task), cycle)
                self.lose(cell, cycle, "node_down", is_needed=needed)
        for cycle, number in [key for key, node in self.copies.held.items() if node == name]:
            del self.copies.held[cycle, number]
            self.lose(ITSELF, cycle, "node_down")
        self.values = {key: value for key, value in self.values.items() if key[1] != name}

    def come_up(self, name: str) -> None:
        for (cell, task, site), pool in self.pools.items():
            if site == name:
                self.at(
                    self.now + nanoseconds(pool.task.start_ms),
                    RESTART,
                    -1,
                    self.index[task],
                    self.restarter(pool, name),
                    cell=cell,
                    fixed=True,
                    valid=lambda pool=pool, restart=pool.restart: pool.restart == restart,  # type: ignore[misc]
                )

    def restarter(self, pool: Pool, node: str) -> Callable[[], None]:
        def happen() -> None:
            pool.idle, pool.starting = pool.task.on[node].workers, False
            self.take(pool, node)

        return happen

    # ------------------------------------------------------------------------------------ links

    def send(self, link: str, message: Message) -> None:
        message.number = next(self.numbers)
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
                if later:
                    yield self.env.timeout(later[0] - self.now)
                    begun = self.note(self.now, -1, fixed=True)
                    continue
                # It waits for ever, and so do those behind it.
                self.lose_message(message, "in_flight", message.sent)
                self.lose_behind(name, message)
                message = yield self.queues[name].get()
            state = self.state(name)
            if state.down:
                self.would_begin(name, message, begun)
                continue
            if link.in_order and message not in self.ordered[name]:
                self.ordered[name].append(message)
            duration = transmission_ns(message.payload_bytes, state.rate_mbps)
            self.transmitted.append(Transmission(message.sent_at, name, message.payload_bytes))
            key = message.draws.loss_key
            if attempt_uniform(key, message.cycle, message.attempt) >= state.loss:
                self.propagate(name, message, state, duration, begun)
            elif link.retransmit_ms is None and not message.is_state:
                self.drop(message, begun)
                if link.in_order:
                    self.ordered[name].remove(message)
            else:
                timeout = link.retransmit_ms
                timeout_ns = nanoseconds(STATE_TIMEOUT_MS if timeout is None else timeout)
                again = self.now + duration + timeout_ns
                self.repeat(name, message, again, message.attempt + 1, begun)
            yield self.env.timeout(duration)

    def would_begin(self, name: str, message: Message, begun: int) -> None:
        """Deal with a message whose transmission would begin while a link that drops is down."""
        # Reading: a message is lost when its transmission begins, or would begin.
        if not message.is_state:
            self.drop(message, begun)
            return
        ends = [s.at_ns for s in self.segments[name] if s.at_ns > self.now and not s.down]
        if ends:
            self.repeat(name, message, ends[0], message.attempt, -1)
        else:
            self.lose_behind(name, message)

    def lose_behind(self, link: str, message: Message) -> None:
        """Lose the messages that wait for one that never arrives."""
        ordered = self.ordered[link]
        for other in ordered[ordered.index(message) + 1 :] if message in ordered else ():
            if other.arrival is not None:
                self.lose_message(other, "in_flight", message.sent)

    def propagate(
        self, link: str, message: Message, state: LinkSegment, duration: int, begun: int
    ) -> None:
        """Let a transmission that begins now arrive."""
        delay = int(message.draws.delay_ns[message.cycle])
        for layer, extra_ns in message.draws.extra_ns.items():
            if layer in state.layers:
                delay += int(extra_ns[message.cycle])
        message.arrival = self.now + duration + delay, begun
        if self.problem.fabric.links[link].in_order:
            self.release_ordered(link)
        else:
            self.announce(message, *message.arrival)

    def release_ordered(self, link: str) -> None:
        """Let messages arrive in their order, up to the first that is being repeated."""
        ordered = self.ordered[link]
        while ordered and ordered[0].arrival is not None:
            message = ordered.pop(0)
            arrival, last = message.arrival, self.last_arrival[link]
            assert arrival is not None
            self.last_arrival[link] = last if arrival[0] < last[0] else arrival
            self.announce(message, *self.last_arrival[link])

    def announce(self, message: Message, arrival: int, begun: int) -> None:
        """Let a message arrive at an instant."""
        if message.is_state:
            self.step(arrival, 0, message.target, message.migration, message.arrive, cause=begun)
            return
        self.at(
            arrival,
            ARRIVAL,
            message.cycle,
            message.task,
            message.arrive,
            cell=message.cell,
            flow=message.flow,
            cause=begun,
        )

    def repeat(self, link: str, message: Message, again: int, attempt: int, begun: int) -> None:
        """Send a message once more at `again`, unless it is given up by then."""
        goes_on = self.going_on(message.migration)

        def happen() -> None:
            over = message.is_stopped() or self.is_given_up(message.cell, message.cycle)
            if not goes_on() if message.is_state else over:
                # No other message waits for it from now on.
                if message in self.ordered[link]:
                    message.arrival = self.now, self.current
                    self.release_ordered(link)
                return
            message.attempt = attempt
            message.sent_at, message.sent_by = self.now, self.current
            self.send(link, message)

        if message.is_state:
            self.at(again, STEP, attempt, message.task, happen, cause=begun)
            return
        self.at(
            again,
            REPEAT,
            message.cycle,
            message.task,
            happen,
            cell=message.cell,
            flow=message.flow,
            cause=begun,
        )


def way_back(problem: Problem, placement: Copy) -> int:
    """Return the least sum of mean delays from the farthest sink's node to the stamper's."""
    tasks = problem.pipeline.tasks
    sinks = [placement[task] for task in tasks if not problem.pipeline.outputs(task)]
    return way_from(problem, sinks)


def way_from(problem: Problem, places: Sequence[str]) -> int:
    """Return the least sum of mean delays from the farthest of some nodes to the stamper's."""
    nodes, links = list(problem.fabric.nodes), problem.fabric.links
    ms = {(a, b): 0.0 if a == b else math.inf for a in nodes for b in nodes}
    for link in links.values():
        ms[link.source, link.target] = link.delay_ms.expectation
    for via, a, b in itertools.product(nodes, nodes, nodes):
        ms[a, b] = min(ms[a, b], ms[a, via] + ms[via, b])
    ways = [ms[place, problem.stamper_node] for place in places]
    return nanoseconds(max(0.0 if math.isinf(way) else way for way in ways))


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


def simulate(
    problem: Problem,
    realisation: Realisation,
    stamps: Sequence[str],
    *,
    shadows: Realisation | None = None,
    shadow_stamps: Sequence[str | None] | None = None,
) -> Result:
    """Play a realisation in which cycle k is released with the candidate `stamps[k]`.

    `shadow_stamps[k]` is the candidate that it is also sent through; its shadow jobs meet
    `shadows`. The run ends with the last window: completions, arrivals and disturbances of that
    very instant happen, nothing after it does.
    """
    others = shadow_stamps or [None] * realisation.cycles
    given = list(zip(stamps, others, strict=True))
    assert len(given) == realisation.cycles
    return Simulation(problem, realisation, shadows, given=given).run()


def control(
    problem: Problem,
    realisation: Realisation,
    script: Sequence[str],
    *,
    shadows: Realisation | None = None,
    fractions: Mapping[str, float] | None = None,
    guarded: bool = False,
    fickle: bool = False,
) -> Result:
    """Play a realisation under a controller that orders one name of a script at each decision.

    `fractions` are the shares of cycles that are also sent through each alternative, by the
    candidate that is active. If it is `guarded`, the cell's guard acts, and `shadows` are what its
    probes meet; a name that it holds back is said again at the next decision, unless the controller
    is `fickle`.
    """
    return Simulation(
        problem,
        realisation,
        shadows,
        script=script,
        fractions=fractions,
        guarded=guarded,
        fickle=fickle,
    ).run()
