"""A whole cell in one thread: its real roles on the in-memory network, its stages simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import dwell
from dwell.control import Controller
from dwell.live.host.agent import Agent
from dwell.live.host.supervision import Supervisor
from dwell.live.roles import role as role_module
from dwell.live.roles.controlled_cell import ControlledCell, Recorder
from dwell.live.roles.joins import Job
from dwell.live.roles.recording import RunRecorder
from dwell.live.roles.role import RolePlace
from dwell.live.roles.run_rows import Resume, Rows, columns_of
from dwell.live.roles.sink import Sink
from dwell.live.roles.stage_counts import StageBook
from dwell.live.roles.stamper import Stamper, StamperState
from dwell.live.roles.state_transfer import Chore
from dwell.live.roles.worker import Worker
from dwell.live.stage import CellActuator, CellStage, Message
from dwell.live.trust.signing import Seals
from dwell.live.wire import channels
from dwell.live.wire.keys import CONTROLLER, Keys
from dwell.live.wire.messages import Accepted, Ask, Order, StageCounts, decode, encode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role, roles, wire
from dwell.model import Host, Problem, QoS
from dwell.policies import MinimalPolicy
from tests.live.memory_transport import Clock, MemoryTransport, Network, NetworkConditions, hears
from tests.live.plain_launcher import PlainLauncher

# All processes of a cell are here, and take the digest of one and the same.
role_module.digests = lru_cache(role_module.digests)  # type: ignore[attr-defined]

MS = 1_000_000
#: What the stages of the canonical cell take.
EXEC_MS = {"sensing": 3.0, "perception": 10.0, "planning": 6.0, "control": 0.5}


@cache
def _canonical() -> Problem:
    return dwell.load("examples/canonical.yaml")


def canonical(window_cycles: int | None = None, **settings: Any) -> Problem:
    """Return the canonical cell with other windows, and settings of its controller."""
    cell = _canonical()
    if window_cycles is not None:
        controller = replace(cell.controller, decide_cycles=window_cycles)
        cell = replace(cell, window_cycles=window_cycles, warmup_windows=0, controller=controller)
    return replace(cell, controller=replace(cell.controller, **settings))


def on(problem: Problem, candidate: str) -> Problem:
    """Return a cell that begins at a candidate."""
    return replace(problem, controller=replace(problem.controller, initial=candidate))


def stateful(problem: Problem, task: str, state_bytes: int) -> Problem:
    """Return a cell with a task whose state has to move with it."""
    tasks = dict(problem.pipeline.tasks)
    tasks[task] = replace(tasks[task], state_bytes=state_bytes)
    return replace(problem, pipeline=replace(problem.pipeline, tasks=tasks))


class Staying:
    """A policy that is content with where the cell is."""

    def start(self, problem: Problem) -> None:
        self.name = problem.initial

    def adopt(self, name: str) -> None:
        self.name = name

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return self.name


class Alternating:
    """A policy that moves at every window, from a candidate to the next."""

    def __init__(self, *names: str) -> None:
        self.names, self.place = names, 0

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        self.place += 1
        return self.names[self.place % len(self.names)]


class MemoryBook:
    """A book that outlives its stamper."""

    def __init__(self) -> None:
        self.entry: StamperState | None = None
        self.first: StamperState | None = None

    def read(self) -> StamperState | None:
        return self.entry

    def write(self, entry: StamperState) -> None:
        self.entry, self.first = entry, self.first or entry


class MemoryHighest:
    """A memory that outlives its sink."""

    def __init__(self) -> None:
        self.highest = (-1, -1)

    def load(self) -> tuple[int, int]:
        return self.highest

    def store(self, run: int, cycle: int) -> None:
        self.highest = run, cycle


@dataclass
class Arm(CellActuator):
    """An actuator that remembers."""

    applied: list[tuple[int, float]] = field(default_factory=list)
    counts: list[tuple[int, int]] = field(default_factory=list)
    silences: int = 0

    def apply(self, command: Message) -> None:
        self.applied.append((command.cycle, command.age_ms))
        if command.payload.isdigit():
            self.counts.append((command.cycle, int(command.payload)))

    def hold(self) -> None:
        self.silences += 1

    zero = hold


class Passing(CellStage):
    """A stage that passes on what it gets."""

    def __init__(self, name: str) -> None:
        self.name = name

    def process(self, inputs: Mapping[str, Message]) -> Message:
        message = next(iter(inputs.values()))
        return Message(message.payload or b"-")


class Counting(Passing):
    """A stage with a state: how many cycles it has seen."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.count = 0

    def process(self, inputs: Mapping[str, Message]) -> Message:
        self.count += 1
        return Message(str(self.count).encode())

    def snapshot(self) -> bytes:
        return str(self.count).encode()

    def restore(self, state: bytes) -> None:
        self.count = int(state)


class MemoryRecorder:
    """Rows as they come; those of jobs, too, on request."""

    trouble = ""

    def __init__(self, *, jobs: bool = False) -> None:
        self.jobs = jobs
        self.rows: dict[str, list[tuple[object, ...]]] = {}

    def open(self, run: int) -> Resume:
        cycles = self.rows.get("cycles", [])
        return Resume(len(self.rows.get("windows", [])), len(cycles), jobs=self.jobs)

    def append(self, rows: Rows, **meta: object) -> None:
        for table, found in rows.items():
            self.rows.setdefault(table, []).extend(found)


def queued(worker: Worker) -> tuple[int, int, list[int]]:
    """Return how many jobs, jobs of shadows, and inputs per join wait at a worker."""
    joins = [len(joins.waiting) for joins in worker._joins.values()]
    return len(worker._jobs), len(worker.transfer.forked), joins


def forget_jobs(worker: Worker) -> bool:
    """Remove the waiting jobs of a worker; returns whether there were any."""
    waited = bool(queued(worker)[0])
    worker._jobs.clear()
    return waited


class MemorySlots:
    """Slots of a node's processes that outlive them."""

    def __init__(self, slots: dict[str, bytes], who: str) -> None:
        self.slots, self.who = slots, who

    def write(self, content: bytes) -> None:
        self.slots[self.who] = content

    def read(self, who: str) -> bytes:
        return self.slots.get(who, b"")


class Bench:
    """Drives a worker: runs its jobs for as long as they take.

    Its beats are woken for; what the thread of its jobs waits for, it waits for by itself.
    """

    def __init__(
        self, network: Network, end: MemoryTransport, worker: Worker, exec_ns: int
    ) -> None:
        self.network, self.end, self.worker, self.exec_ns = network, end, worker, exec_ns
        worker.started = True
        #: How long calls of the stage about its state take.
        self.chore_ns: dict[str, int] = {}
        #: Instant of the network at which it looks next whether there is something to do.
        self._look_ns = -1

    def subscriptions(self) -> Iterable[str]:
        return self.worker.subscriptions()

    def receive(self, sample: Arrival, now_ns: int) -> None:
        self.worker.receive(sample, now_ns)
        if self.worker.has_work:
            self.work()

    def wake(self, now_ns: int) -> int:
        return self.worker.wake(now_ns)

    def work(self) -> None:
        if self.end.closed:
            return
        if self.end.frozen:
            self.end.wakes.append(self.work)
            return
        worker, now_ns = self.worker, self.end.now_ns
        if (chore := worker.next_chore(now_ns)) is not None:
            result = worker.do_chore(chore)
            end = partial(self._finish_chore, chore, result, now_ns)
            if lasts_ns := self.chore_ns.get(chore.call, 0):
                self.network.call_at(self.network.now_ns + lasts_ns, end)
            else:
                end()
            return
        job = worker.next_job(now_ns)
        if job is not None:
            output, age = worker.run(job, now_ns)
            ended_ns = self.network.now_ns + self.exec_ns
            self.network.call_at(ended_ns, lambda: self._finish(job, output, now_ns, age))
        elif worker.has_work:
            rest_ns = max(round(worker.rest_s(now_ns) * 1e9), 1)
            look_ns = self.network.now_ns + rest_ns
            if look_ns != self._look_ns:
                self._look_ns = look_ns
                self.network.call_at(look_ns, lambda: self._look(look_ns))

    def _look(self, look_ns: int) -> None:
        if look_ns == self._look_ns:
            self.work()

    def _finish_chore(self, chore: Chore, result: tuple[bytes, str], started_ns: int) -> None:
        if self.end.closed:
            return
        if self.end.frozen:
            self.end.wakes.append(lambda: self._finish_chore(chore, result, started_ns))
            return
        self.worker.finish_chore(chore, *result, started_ns, self.end.now_ns)
        self.work()

    def _finish(self, job: Job, output: Message | None, started_ns: int, age: int) -> None:
        if self.end.closed:
            return
        if self.end.frozen:
            self.end.wakes.append(lambda: self._finish(job, output, started_ns, age))
            return
        self.worker.finish(job, output, started_ns, self.end.now_ns, age)
        self.work()


class World:
    """A cell, and what outlives its processes.

    Parameters
    ----------
    problem : Problem
    exec_ms : mapping of task to float
        How long a job takes.
    delay_ms : float
        Of every message.
    seals : mapping of str to Seals, optional
        By subject: each node and the controller.
    seed : int
        Seed of what the network draws.
    start_ns : int
        What the clocks show at first.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        exec_ms: Mapping[str, float] = EXEC_MS,
        delay_ms: float = 0.2,
        clocks: Mapping[str, Clock] | None = None,
        stages: Mapping[str, Callable[[str], Passing]] | None = None,
        policy: str | MinimalPolicy | None = None,
        seals: Mapping[str, Seals] | None = None,
        jobs: bool = False,
        seed: int = 0,
        start_ns: int = MS,
    ) -> None:
        hosts = {
            node: Host("127.0.0.1", 10_000 + 1_000 * i)
            for i, node in enumerate(problem.fabric.nodes)
        }
        live = replace(problem.live, hosts=hosts)
        self.problem = problem = replace(problem, live=live)
        # Nobody hears anybody that it would have no connection to.
        reach = partial(hears, wire(problem))
        delay_ns = round(delay_ms * MS)
        self.network = Network(seed=seed, delay_ns=delay_ns, start_ns=start_ns, reach=reach)
        self.clocks = dict(clocks or {})
        self.keys = Keys(problem.name)
        self._roles = {role.who: role for role in roles(problem)}
        self.exec_ms = exec_ms
        self.stages = stages or {}
        self.book = MemoryBook()
        sinks = [name for name in problem.pipeline.tasks if not problem.pipeline.outputs(name)]
        self.highest = {name: MemoryHighest() for name in sinks}
        self.arms = {name: Arm() for name in sinks}
        self.arm = self.arms[sinks[0]]
        self.roles: dict[str, object] = {}
        #: By worker: the memory of its counts, which outlives it.
        self.books: dict[str, bytearray] = {}
        #: By node: the slots of its processes.
        self.slots: dict[str, dict[str, bytes]] = {node: {} for node in problem.fabric.nodes}
        self.lives = 0
        self.run_id = 1
        self.boot = ""
        self.number = 0
        self.policy = policy
        self.seals = seals or {}
        self.recorder = MemoryRecorder(jobs=jobs)
        for role in self._roles.values():
            if role.kind != "controller" or policy is not None:
                self.start(role.who)

    def start(self, who: str) -> None:
        """Start a process, or start it again."""
        self.lives += 1
        role = self._roles[who]
        clock = self.clocks.get(role.node, Clock())
        end = self.network.transport(who, role.node, clock=clock)
        subject = CONTROLLER if role.kind == "controller" else role.node
        seals = self.seals.get(subject)
        place = RolePlace(self.problem, who, role.node, end, self.life_of(role), seals=seals)
        if role.kind != "controller":
            place.slots = MemorySlots(self.slots[role.node], who)
        made: Stamper | Sink | Quiet | ControlledCell | Bench
        if role.kind == "stamper":
            made = Stamper(place, self.book, self.time_of_day(role), end.now_ns, self.boot)
        elif role.kind == "sink":
            made = Sink(place, role.task, self.actuator_of(role), self.highest[role.task])
        elif role.kind == "agent":
            made = Quiet(place, partial(self._counts, role.node))
        elif role.kind == "controller":
            controller = Controller(self.problem, self.policy)
            recorder = self.recorder_of(controller)
            made = ControlledCell(place, controller, recorder, f"c{self.lives}", end.now_ns)
        else:
            stage = self.stage_of(role)
            standby = f"{role.task}@{role.node}" if role.kind == "standby" else ""
            shadow, book = role.kind == "shadow", self._book(role)
            worker = Worker(place, role.task, stage, shadow=shadow, stands_by=standby, book=book)
            # All that it reads is the network's: a run is the same whatever the machine does.
            worker.cpu_clock = lambda: self.network.now_ns
            made = Bench(self.network, end, worker, self.exec_ns_of(role))
        self.roles[who] = made
        self.network.attach(end, made)

    def _book(self, role: Role) -> StageBook:
        """Open the counts of a worker."""
        kept = partial(self.books.setdefault, role.who)
        return StageBook(self.problem, role.task, role.node, lambda size: kept(bytearray(size)))

    def _counts(self, node: str) -> Iterator[StageCounts]:
        """Yield the counts of a node's workers, as its agent reads them."""
        for role in self._roles.values():
            if role.node == node and role.kind in ("worker", "standby"):
                yield from self._book(role).report(role.who)

    def life_of(self, role: Role) -> int:
        """Life of a process that starts."""
        return self.lives

    def time_of_day(self, role: Role) -> int:
        """Time of day that a process reads at its start."""
        return self.run_id

    def stage_of(self, role: Role) -> CellStage:
        """Make the stage of a worker."""
        return self.stages.get(role.task, Passing)(role.task)

    def exec_ns_of(self, role: Role) -> int:
        """How long a job of a worker takes."""
        return round(self.exec_ms[role.task] * MS)

    def actuator_of(self, role: Role) -> CellActuator:
        """Make the actuator of a sink."""
        return self.arms[role.task]

    def recorder_of(self, controller: Controller) -> Recorder:
        """Make what keeps the runs of a controller."""
        return self.recorder

    def kill(self, who: str) -> None:
        """End a process."""
        self.network.kill(who)

    def run(self, ms: float) -> None:
        """Let time pass."""
        self.network.advance(self.network.now_ns + round(ms * MS))

    def sample(self, order: Order) -> Arrival:
        """An order as it arrives."""
        return Arrival(self.keys.of(channels.ORDER), encode(order))

    def order(self, placement: str, *, run: int = 0, term: int = 0, controller: str = "me") -> str:
        """Order a placement; returns why it was refused, or nothing."""
        self.number += 1
        stamper = self.stamper
        order = Order(self.number, controller, run or stamper.run, term or stamper.term, placement)
        return self.answer(order).refused

    def answer(self, order: Order) -> Accepted:
        """Hand an order to the stamper; returns its answer."""
        answers: list[bytes] = []

        def hear(sample: Arrival) -> None:
            if sample.key == self.keys.of(channels.ACCEPTED):
                answers.append(sample.payload)

        self.network.taps.append(hear)
        self.stamper.receive(self.sample(order), self.network.now_ns)
        self.network.taps.remove(hear)
        return decode(answers[-1], Accepted)

    def move_by_guard(self, placement: str) -> None:
        """Have the stamper move the cell, as its guard does."""
        self.stamper._move(placement, by_guard=True)

    @staticmethod
    def losing(share: float) -> NetworkConditions:
        """Conditions that lose a share of the messages."""
        return NetworkConditions(loss=share)

    def pin(self, candidate: str) -> None:
        """Have the controller move the cell, as a person does."""
        self.ask("pin", candidate)

    def ask(self, what: str, about: str = "") -> None:
        """Ask the controller as a person does."""
        self.tell(self.keys.of(channels.ASK), encode(Ask("me", what, about)))

    def tell(self, key: str, data: bytes) -> int:
        """Hand the controller a message; returns how many it complains of."""
        before = self.cell.place.complained
        self.cell.receive(Arrival(key, data), self.network.now_ns)
        return self.cell.place.complained - before

    @property
    def cell(self) -> ControlledCell:
        """What the controller's process runs now."""
        role = self.roles[f"controller@{self.problem.controller_node}"]
        assert isinstance(role, ControlledCell)
        return role

    @property
    def status(self) -> dict[str, Any]:
        """What the controller says of the cell."""
        clock = self.clocks.get(self.problem.controller_node, Clock())
        return self.cell.status(clock.shown(self.network.now_ns))

    @property
    def stamper(self) -> Stamper:
        return next(role for role in reversed(self.roles.values()) if isinstance(role, Stamper))

    @property
    def sink(self) -> Sink:
        return next(role for role in reversed(self.roles.values()) if isinstance(role, Sink))

    def note(self, who: str) -> str:
        """What a process says in its beats, by the controller."""
        return str(self.status["processes"][who]["note"])

    def worker(self, who: str) -> Worker:
        bench = self.roles[who]
        assert isinstance(bench, Bench)
        return bench.worker

    @property
    def cycles(self) -> list[int]:
        """Cycles that were actuated, in order."""
        return [cycle for cycle, _ in self.arm.applied]


def columns(world: World, table: str, *names: str) -> list[tuple[Any, ...]]:
    """Columns of a table's rows, later rows of a number in the place of earlier ones."""
    order = list(columns_of(world.cell.controller)[table])
    rows = world.recorder.rows[table]
    if table != "decisions":
        rows = list({row[0]: row for row in rows}.values())
    return [tuple(row[order.index(name)] for name in names) for row in rows]


class Recorded(World):
    """A cell in memory whose controller keeps its runs in a folder."""

    def __init__(
        self,
        problem: Problem,
        out: Path,
        *,
        policy: str = "LOC",
        exec_ms: Mapping[str, float] = EXEC_MS,
        **recording: Any,
    ) -> None:
        self.out, self.recording = out, recording
        self.log: list[str] = []
        super().__init__(problem, policy=policy, exec_ms=exec_ms)

    def recorder_of(self, controller: Controller) -> Recorder:
        kept = self.out, self.problem, controller, self.log.append
        self.kept = RunRecorder(*kept, **self.recording)
        return self.kept

    @property
    def windows(self) -> int:
        """How many have closed."""
        assert self.cell.windows is not None
        return int(str(self.cell.windows.status()["windows"]))

    def finish(self) -> Path:
        """End the run as its controller does."""
        assert self.cell.windows is not None
        self.cell.write()
        folder = self.kept.finish(self.cell.finish())
        assert folder is not None
        return folder


class Quiet(Agent):
    """An agent without processes to look after."""

    def __init__(self, place: RolePlace, stages: Callable[[], Iterable[StageCounts]]) -> None:
        supervisor = Supervisor(None, print, PlainLauncher())  # type: ignore[arg-type]
        super().__init__(place, supervisor, lambda: 0, stages=stages)
        self.cpu_clock = lambda: 0
