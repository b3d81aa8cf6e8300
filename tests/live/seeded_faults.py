"""Faults by seed: whole cells in memory, what befalls them drawn, the chaos's judge on every run.

``python -m tests.live.seeded_faults --seed 7`` plays the faults of a seed on the light cell, for
some hundred cycles. Where something is wrong, it looks for fewer and shorter faults that show it
too, and prints the command that plays those.

``--faults 100000 --out FOLDER`` plays seed after seed until there were so many faults, goes on
where it was stopped, and ends with a table by kind.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import re
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import islice, takewhile
from pathlib import Path
from random import Random
from typing import Any, Self

from dwell.cellfile import from_document
from dwell.control import Controller
from dwell.errors import UnwritableError, describe_raised
from dwell.live.roles.controlled_cell import Recorder
from dwell.live.roles.recording import RunRecorder
from dwell.live.roles.run_rows import Rows
from dwell.live.roles.stamper import StamperState
from dwell.live.stage import CellActuator, CellStage, Message
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role
from dwell.model import Problem, QoS
from dwell_lab.chaos.actuations import Seen, out_of_order
from dwell_lab.chaos.faults import Fault, PlannedFault, bound_of, faults_of, planned, struck
from dwell_lab.chaos.harness import RECENT_PERIODS, away_from_home
from dwell_lab.chaos.invariants import Judge
from dwell_lab.chaos.light_cell import CANDIDATES, WINDOW_CYCLES, document, exec_ms
from dwell_lab.chaos.stages import APPLY, FRAME_BYTES, HOLD, NODES, SAID, ZERO
from dwell_lab.chaos.strike import (
    RECOVERED_S,
    Outcome,
    beyond,
    moved_in_vain,
    recovered,
    too_old,
    weigh,
)
from tests.live.memory_transport import Clock, MemoryTransport, NetworkConditions
from tests.live.real_cell import wrong_record
from tests.live.small_world import MS, World, columns, on

#: How many faults a run has, and how often.
COUNTS, SHARES = (1, 2, 3, 4), (6, 2, 1, 1)
#: Which candidate the controller wants to be at; nothing where it goes round all of them.
WISHES = ("LOC", "SO", "HYB", "")
#: Candidate with replicas, at which the cells of a share of the seeds stay.
BOTH, REPLICATED = "BOTH", 0.15
#: What the clocks show at first: none is set back beyond 0.
START_NS = 1_000_000_000_000
#: Time in which a cell has to be at home after its start.
STARTED_S = 10.0
#: How soon a killed process is back, if its agent lives.
BACK_MS = 100.0, 400.0
#: How long the processes of a node that starves get no CPU, and then get one.
STARVED_MS, FED_MS = (20.0, 200.0), (2.0, 20.0)
#: What befalls the messages of a direction, by kind and amount: ms, or probability.
ON_THE_WAY = {
    "delay": (5.0, 60.0, 300.0),
    "lose": (0.05, 0.3, 0.9),
    "double": (0.5,),
    "reorder": (0.5,),
}
#: Frames per period of a camera at another rate, in a cell whose cycles begin with its frames.
FRAMES = (0.27, 0.67, 1.7)
#: Age of the files that a node finds after a loss of power, time in which its first command
#: arrives, and time that its monotonic clock shows at the start.
OLD_S, COMMAND_S, UP_NS = 30.0, 8.0, 20_000_000_000
#: Time of day at the start, and the difference of a clock that was never set.
TODAY_NS = 1_700_000_000_000_000_000
#: Periods between two looks at the status.
LOOK = 2
#: Outcomes of the messages of a flow.
ENDS = "taken", "replaced", "dropped", "lost", "in_flight"
#: Words of the keys that the judge hears.
HEARD = frozenset({"stamped", "order", "accepted", "done", "in"})


@cache
def light_cell() -> Problem:
    """Return the light cell."""
    return from_document(document("SO"))


@cache
def replicated_cell() -> Problem:
    """Return the light cell with a candidate with replicas."""
    given = document("SO")
    candidates = {**given["candidates"], BOTH: {"replicas": ["LOC", "SO"]}}
    return from_document({**given, "candidates": candidates})


@cache
def faults_in_memory() -> tuple[Fault, ...]:
    """Return every fault that can be brought about in memory."""
    problem = light_cell()
    faults = [fault for fault in faults_of(problem, disks=False) if fault.how != "hog"]
    for link in problem.fabric.links.values():
        for kind, amounts in ON_THE_WAY.items():
            for amount in amounts:
                name = f"{kind} {link.name} {amount:g}"
                faults.append(Fault(name, "slow", (link.name,), amount, kind))
    for node in problem.fabric.nodes:
        faults += [Fault(f"{how} {node}", how, (f"*{node}",)) for how in ("power", "blank")]
    paces = (Fault(f"camera {share:g}", "pace", ("sensing@R1",), share) for share in FRAMES)
    return *faults, *paces


# ------------------------------------------------------------------------------------ the draw


@dataclass(frozen=True, slots=True)
class Plan:
    """Faults of one run.

    Parameters
    ----------
    wish : str
        One of `WISHES`, or `BOTH`.
    delay_ms : float
        Of every message.
    decide_cycles : int
        Cycles between two decisions.
    """

    seed: int
    wish: str
    delay_ms: float
    faults: tuple[PlannedFault, ...]
    decide_cycles: int = WINDOW_CYCLES

    @classmethod
    def of(cls, seed: int) -> Self:
        """Draw the faults of a seed; most often one, which has a bound."""
        draw = Random(f"plan {seed}")
        wish, delay_ms = draw.choice(WISHES), draw.choice((0.2, 1.0, 4.0))
        if Random(f"replicas {seed}").random() < REPLICATED:
            wish = BOTH
        (count,) = draw.choices(COUNTS, SHARES)
        faults = tuple(islice(planned(seed, faults_in_memory()), count))
        every = Random(f"decisions {seed}").randint(1, WINDOW_CYCLES)
        return cls(seed, wish, delay_ms, faults, every)

    def command(self) -> str:
        """Return the command that plays it."""
        words = ["python", "-m", "tests.live.seeded_faults", "--seed", str(self.seed)]
        if self != Plan.of(self.seed):
            words += ["--wish", self.wish, "--delay-ms", str(self.delay_ms)]
            words += ["--decide-cycles", str(self.decide_cycles)]
            words += ["--play", *map(_written, self.faults)]
        return shlex.join(words)


def unbalanced(status: Mapping[str, Any]) -> dict[str, Any]:
    """Return the flows of a status whose messages do not add up."""
    return {
        name: one
        for name, one in status["flows"].items()
        if one["sent"] != sum(one[end] for end in ENDS) or min(one[end] for end in ENDS) < 0
    }


def _written(one: PlannedFault) -> str:
    return f"{one.number};{one.fault.name};{one.phase!r};{one.lasts_s!r};{one.rests_s!r}"


def _read(text: str) -> PlannedFault:
    """Read a fault as `_written` gives it; a ValueError where it is none."""
    number, name, phase, lasts_s, rests_s = text.split(";")
    (fault,) = (fault for fault in faults_in_memory() if fault.name == name)
    return PlannedFault(int(number), fault, float(phase), float(lasts_s), float(rests_s))


# ----------------------------------------------------------------------------------- the cell


class Touring:
    """A policy that goes round all candidates, and stays at each for some windows."""

    STAY = 4

    def __init__(self) -> None:
        self.names = tuple(CANDIDATES)
        self.place = self.stayed = self.stay = self.least = 0

    def start(self, problem: Problem) -> None:
        self.place = self.names.index(problem.initial)
        self.stay = int(self.STAY * problem.decisions_per_window)
        self.least = problem.min_dwell_decisions

    def adopt(self, name: str) -> None:
        # It goes on from there as soon as any policy may.
        self.place, self.stayed = self.names.index(name), self.stay - self.least

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        self.stayed += 1
        if self.stayed > self.stay:
            self.place, self.stayed = (self.place + 1) % len(self.names), 0
        return self.names[self.place]


class TellingStage(CellStage):
    """A stage of the light cell: passes on what the source says of the cycle, and where it ran."""

    def __init__(self, role: Role, failing: set[str]) -> None:
        self.role, self.failing = role, failing

    def process(self, inputs: Mapping[str, Message]) -> Message:
        if self.role.who in self.failing:
            raise RuntimeError("told to fail")
        message = next(iter(inputs.values()))
        if self.role.task == "sensing":
            said = SAID.pack(message.cycle, message.released_ns, 0, 0)
            return Message(said.ljust(FRAME_BYTES, b"\0"))
        cycle, released_ns, perception, planning = SAID.unpack_from(message.payload)
        node = NODES.index(self.role.node)
        if self.role.task == "perception":
            perception = node
        elif self.role.task == "planning":
            planning = node
        return Message(SAID.pack(cycle, released_ns, perception, planning))


class SeeingActuator(CellActuator):
    """The actuator: notes every call, on the true clock, as the chaos's witness does."""

    def __init__(self, world: FaultyWorld, who: str) -> None:
        self.world, self.who = world, who

    def apply(self, command: Message) -> None:
        cycle, released_ns, perception, planning = SAID.unpack(command.payload)
        self._note(APPLY, perception, planning, command.cycle, cycle, released_ns)
        if self.who in self.world.failing:
            raise RuntimeError("told to fail")

    def hold(self) -> None:
        self._note(HOLD, 0, 0, 0, 0, 0)

    def zero(self) -> None:
        self._note(ZERO, 0, 0, 0, 0, 0)

    def _note(self, what: int, perception: int, planning: int, *numbers: int) -> None:
        at_ns = self.world.network.now_ns
        self.world.seen.append(Seen.of(what, perception, planning, 0, *numbers, at_ns))


class MemoryJournal:
    """A run's journal that outlives its controller, on a disk that can be full."""

    folder = Path("memory")

    def __init__(self) -> None:
        self.full = False
        self.rows: dict[str, list[tuple[Any, ...]]] = {}
        self.meta: dict[str, Any] = {}

    def following(self, table: str) -> int:
        return max((row[0] + 1 for row in self.rows.get(table, [])), default=0)

    def append(self, rows: Rows, **meta: object) -> None:
        if self.full:
            raise UnwritableError("no space left")
        self.meta |= meta
        for table, found in rows.items():
            self.rows.setdefault(table, []).extend(found)


class MemoryRunRecorder(RunRecorder):
    """Keeps the runs of a controller in a `MemoryJournal`."""

    def __init__(self, journal: MemoryJournal, problem: Problem, controller: Controller) -> None:
        super().__init__(journal.folder, problem, controller, lambda _: None)
        self._kept = journal

    def _opened(self, run: int, *, new: bool = False) -> Any:
        return self._kept


class FaultyWorld(World):
    """The light cell in memory, which faults befall; what it says and does is held against it."""

    def __init__(self, plan: Plan) -> None:
        self.seen: list[Seen] = []
        self.failing: set[str] = set()
        self.journal = MemoryJournal()
        self.exec_of = exec_ms("SO")
        self._freezes: Counter[MemoryTransport] = Counter()
        # Nodes whose time of day was never set.
        self.unset: set[str] = set()
        cell = replicated_cell() if plan.wish == BOTH else light_cell()
        problem = on(cell, plan.wish or "SO")
        self.frames_per_period = 1.0
        paced = any(one.fault.how == "pace" for one in plan.faults)
        if paced:
            problem = replace(problem, live=replace(problem.live, release="frames"))
        settings = replace(problem.controller, decide_cycles=plan.decide_cycles)
        problem = replace(problem, controller=settings)
        super().__init__(
            problem,
            delay_ms=plan.delay_ms,
            policy=plan.wish or Touring(),
            seed=plan.seed,
            start_ns=START_NS,
        )
        self.recorder.rows = self.journal.rows
        renews = any(one.fault.how in ("power", "blank") for one in plan.faults)
        self.judge = Judge(self.problem, renews)
        self.wrong: list[str] = []
        self.network.taps.append(self._hear)
        self._look()
        if paced:
            self._frame()

    def _look(self) -> None:
        """Hold the status against what the actuator has seen, again and again."""
        self.network.call_at(self.network.now_ns + LOOK * self.period_ns, self._look)
        if status := self._status():
            self.wrong += self.judge.looked(status, self.seen)
            self.wrong += map(str, unbalanced(status).items())

    def _frame(self) -> None:
        """Have the source's camera bring a frame, again and again."""
        every_ns = round(self.period_ns / self.frames_per_period)
        self.network.call_at(self.network.now_ns + every_ns, self._frame)
        end = self.network.end("sensing@R1")
        if end is not None and not end.frozen:
            self.worker("sensing@R1").framed(end.now_ns)

    def life_of(self, role: Role) -> int:
        return self.time_of_day(role) + self.lives

    def time_of_day(self, role: Role) -> int:
        passed_ns = self.network.now_ns - START_NS
        return passed_ns if role.node in self.unset else TODAY_NS + passed_ns

    def stage_of(self, role: Role) -> CellStage:
        return TellingStage(role, self.failing)

    def exec_ns_of(self, role: Role) -> int:
        return round(self.exec_of[role.task][role.node] * MS)

    def actuator_of(self, role: Role) -> CellActuator:
        return SeeingActuator(self, role.who)

    def recorder_of(self, controller: Controller) -> Recorder:
        return MemoryRunRecorder(self.journal, self.problem, controller)

    def _hear(self, sample: Arrival) -> None:
        if self.keys.word(sample.key) in HEARD:
            heard, run = (sample.key, sample.payload, sample.header), self.judge.run
            self.wrong += self.judge.hear(self.network.now_ns, *heard)
            if -1 < run < self.judge.run:
                # Numbers of cycles begin again.
                self.wrong += out_of_order([one for one in self.seen if one.what == APPLY])
                self.seen.clear()

    def away(self, home: str | None) -> str:
        """Return what keeps it from being whole, watched, and where its controller wants it."""
        since_ns = self.network.now_ns - RECENT_PERIODS * self.period_ns
        recent = takewhile(lambda one: one.at_ns >= since_ns, reversed(self.seen))
        applied = [one for one in recent if one.what == APPLY]
        if home == BOTH:
            # The nodes of a command show only the copy that came first.
            if (where := self._status().get("placement")) != BOTH:
                return f"it is at {where}"
            home = None
        return away_from_home(self.problem, home, applied[::-1], self._status)

    def _status(self) -> Mapping[str, Any]:
        end = self.network.end(f"controller@{self.problem.controller_node}")
        return {} if end is None or end.frozen else self.status

    @property
    def period_ns(self) -> int:
        """P."""
        return self.problem.pipeline.period_ns

    # ------------------------------------------------------------------------------- faults

    def begin(self, one: PlannedFault, draw: Random) -> Callable[[], None]:
        """Have a fault befall it now; returns what ends it."""
        fault = one.fault
        match fault.how:
            case "kill":
                return self._kill(struck(self.problem, fault), draw)
            case "freeze":
                return self._freeze(struck(self.problem, fault))
            case "power" | "blank":
                return self._cut_power(fault, draw)
            case "starve":
                names = struck(self.problem, replace(fault, whom=(f"*{fault.whom[0]}",)))
                return self._starve(names, draw)
            case "cut" | "slow":
                conditions = _conditions(fault)
                rules = [self.network.impair(conditions, *way.split("->")) for way in fault.whom]

                def heal() -> None:
                    for rule in rules:
                        self.network.heal(rule)

                return heal
            case "fail":
                self.failing.update(fault.whom)
                return lambda: self.failing.difference_update(fault.whom)
            case "jump":
                self._set_clock(fault.whom[0], jump_ns=round(fault.amount * MS))
                return lambda: None
            case "drift":
                self._set_clock(fault.whom[0], drift_ppm=fault.amount)
                return lambda: self._set_clock(fault.whom[0])
            case "pace":
                self.frames_per_period = fault.amount
                return lambda: setattr(self, "frames_per_period", 1.0)
            case "fill":
                self.journal.full = True
                return lambda: setattr(self.journal, "full", False)
        raise ValueError(f"{fault.name}: not in memory")

    def _kill(self, names: Sequence[str], draw: Random) -> Callable[[], None]:
        """End processes; those whose agent lives are back soon, the others at the end."""
        for who in names:
            if self.network.end(who) is not None:
                self.kill(who)
        soon = [who for who in names if not who.startswith(("agent", "controller"))]
        for who in soon:
            at_ns = self.network.now_ns + round(draw.uniform(*BACK_MS) * MS)
            self.network.call_at(at_ns, lambda who=who: self._come_back(who))  # type: ignore[misc]

        def bring_back() -> None:
            for who in names:
                if self.network.end(who) is None:
                    self.start(who)

        return bring_back

    def _cut_power(self, fault: Fault, draw: Random) -> Callable[[], None]:
        """Cut a node's power; at the end it boots, with old files or none."""
        (node,) = (who[1:] for who in fault.whom)
        start = self._kill(names := struck(self.problem, fault), draw)

        def boot() -> None:
            for who in names:
                if self.network.end(who) is not None:
                    self.kill(who)
            blank = fault.how == "blank"
            (self.unset.add if blank else self.unset.discard)(node)
            if node == self.problem.stamper_node:
                self.boot = f"boot {self.lives}"
                self.book.entry = None if blank else self._old_entry()
            for task, highest in self.highest.items():
                if node in self.problem.pipeline.tasks[task].on:
                    run, cycle = highest.highest
                    highest.highest = (-1, -1) if blank else (run, max(cycle - self.old, -1))
            shown_ns = self.clocks.get(node, Clock()).shown(self.network.now_ns)
            self._set_clock(node, jump_ns=UP_NS - shown_ns)
            start()

        return boot

    @property
    def old(self) -> int:
        """Cycles within `OLD_S`."""
        return round(OLD_S * 1e9 / self.period_ns)

    def _old_entry(self) -> StamperState | None:
        """Return the stamper's book as it may have been `OLD_S` ago."""
        first = self.book.first
        cycle = max(self.judge.stamped_ns, default=0)
        return None if first is None else replace(first, reserved=max(cycle - self.old, 1))

    def _come_back(self, who: str) -> None:
        node = who.partition("@")[2].partition(".")[0]
        agent = self.network.end(f"agent@{node}")
        if self.network.end(who) is None and agent is not None:
            self.start(who)

    def _freeze(self, names: Sequence[str]) -> Callable[[], None]:
        ends = [end for who in names if (end := self.network.end(who)) is not None]
        for end in ends:
            self._freezes[end] += 1
            self.network.freeze(end.who)

        def thaw() -> None:
            for end in ends:
                self._freezes[end] -= 1
                if not self._freezes[end] and not end.closed:
                    self.network.thaw(end.who)

        return thaw

    def _starve(self, names: Sequence[str], draw: Random) -> Callable[[], None]:
        """Have processes wait for a CPU most of the time, each by itself."""
        hungry = True

        def wait(who: str) -> None:
            if not hungry:
                return
            thaw = self._freeze([who])
            run_ns = self.network.now_ns + round(draw.uniform(*STARVED_MS) * MS)

            def go_on() -> None:
                thaw()
                wait_ns = self.network.now_ns + round(draw.uniform(*FED_MS) * MS)
                self.network.call_at(wait_ns, lambda: wait(who))

            self.network.call_at(run_ns, go_on)

        def fed() -> None:
            nonlocal hungry
            hungry = False

        for who in names:
            wait(who)
        return fed

    def _set_clock(self, node: str, *, jump_ns: int = 0, drift_ppm: float = 0.0) -> None:
        now_ns, clock = self.network.now_ns, self.clocks.get(node, Clock())
        changed = Clock(0, drift_ppm)
        offset_ns = clock.shown(now_ns) + jump_ns - changed.shown(now_ns)
        self.clocks[node] = changed = replace(changed, offset_ns=offset_ns)
        self.network.set_clock(node, changed)


def _conditions(fault: Fault) -> NetworkConditions:
    """Return what a fault has messages meet on their way."""
    match fault.kind:
        case "slow":
            return NetworkConditions(rate_mbps=fault.amount)
        case "delay":
            return NetworkConditions(delay_ns=round(fault.amount * MS))
        case "lose":
            return NetworkConditions(loss=fault.amount)
        case "double":
            return NetworkConditions(duplication=fault.amount)
        case "reorder":
            return NetworkConditions(reordering=fault.amount, reorder_ns=30 * MS)
    return NetworkConditions(loss=1.0)


# ------------------------------------------------------------------------------------ the run


class MissingError(Exception):
    """What is waited for does not come."""


@dataclass(slots=True)
class Played:
    """What came of a run.

    Parameters
    ----------
    wrong : list of str
        Violations.
    digest : str
        Of all that the actuator was told and the judge heard.
    """

    plan: Plan
    outcome: Outcome
    cycles: int = 0
    digest: str = ""
    wrong: list[str] = field(default_factory=list)


def play(plan: Plan) -> Played:
    """Play the faults of a plan, until the cell has recovered, and judge all of it."""
    names = " + ".join(one.fault.name for one in plan.faults)
    played = Played(plan, Outcome(names, plan.seed, plan.faults[0].phase if plan.faults else 0.0))
    world = FaultyWorld(plan)
    try:
        _play(world, played)
    except MissingError as error:
        played.wrong.append(str(error))
    except Exception as error:  # a role that fails ends its process
        played.wrong.append(f"a process has ended by itself: {describe_raised(error)}")
    played.wrong = [*world.wrong, *played.wrong, *played.outcome.wrong, *played.outcome.late]
    played.cycles = world.judge.counts["stamped"]
    heard = world.seen, sorted(world.judge.counts.items()), world.judge.stamped_ns
    played.digest = hashlib.sha256(repr(heard).encode()).hexdigest()[:16]
    return played


def _wait(world: FaultyWorld, what: str, home: str | None, patience_s: float) -> None:
    until_ns = world.network.now_ns + round(patience_s * 1e9)
    while missing := world.away(home):
        if world.network.now_ns > until_ns:
            raise MissingError(f"waited {patience_s:g} s for {what}: {missing}")
        world.network.advance(world.network.now_ns + world.period_ns)


def _play(world: FaultyWorld, played: Played) -> None:
    plan, outcome, network = played.plan, played.outcome, world.network
    problem, judge, home = world.problem, world.judge, plan.wish or None
    _wait(world, "the whole cell at home", home, STARTED_S)
    network.advance(network.now_ns + 2 * RECENT_PERIODS * world.period_ns)
    term = max(judge.terms)
    faults = [one.fault for one in plan.faults]
    if len(faults) == 1 and home is not None:
        outcome.bound = bound_of(problem, faults[0], judge.terms[term].placement)
    begin_ns = network.now_ns
    agenda: list[tuple[int, list[Callable[[], None]]]] = []
    for one in plan.faults:
        phase_ns = round(one.phase * world.period_ns)
        begin_ns += phase_ns + (round(one.rests_s * 1e9) if agenda else 0)
        end_ns = begin_ns + round(one.lasts_s * 1e9)
        agenda.append((end_ns, _staged(world, one, begin_ns)))
        outcome.begin_ns = outcome.begin_ns or begin_ns
    for end_ns, end in sorted(agenda, key=lambda item: item[0]):
        network.advance(end_ns)
        end[0]()
    outcome.end_ns = network.now_ns
    # The guard may still move for cycles that were lost.
    network.advance(network.now_ns + (problem.controller.guard_cycles + 1) * world.period_ns)
    _wait(world, "the whole cell at home after it", home, RECOVERED_S)
    outcome.back_ns = network.now_ns
    network.advance(network.now_ns + 5 * world.period_ns)
    weigh(problem, faults, world.seen, outcome)
    recovered(judge, outcome, home)
    outcome.late += beyond(outcome)
    if len(faults) == 1 and faults[0].how in ("power", "blank"):
        outcome.wrong += _late_command(world, outcome)
    if len(faults) == 1:
        outcome.late += moved_in_vain(judge, faults[0], term)
    if not any(fault.how in ("jump", "drift") for fault in faults):
        outcome.late += too_old(problem, world.seen, judge.stamped_ns)
    world.wrong += judge.migrations()
    played.wrong += _wrong_record(world)


def _late_command(world: FaultyWorld, outcome: Outcome) -> list[str]:
    """Return that the first command after a fault came too late."""
    after_ns = [one.at_ns for one in world.seen if one.at_ns > outcome.end_ns]
    first_s = (min(after_ns, default=outcome.back_ns) - outcome.end_ns) / 1e9
    return [f"the first command came after {first_s:.1f} s"] if first_s > COMMAND_S else []


def _staged(world: FaultyWorld, one: PlannedFault, at_ns: int) -> list[Callable[[], None]]:
    """Have a fault begin at an instant; returns where what ends it will be found."""
    draw = Random(f"fault {world.network.seed} {one.number}")
    ends: list[Callable[[], None]] = []
    world.network.call_at(at_ns, lambda: ends.append(world.begin(one, draw)))
    return ends


def _wrong_record(world: FaultyWorld) -> list[str]:
    """Return what is wrong with the record of the run."""
    rows = columns(world, "cycles", "run", "number", "actuated")
    cycles = [(number, actuated) for run, number, actuated in rows if run == world.judge.run]
    decisions = columns(world, "decisions", "last_cycle", "migrated", "cycles")
    return wrong_record(
        [number for number, _ in cycles],
        [window for (window,) in columns(world, "windows", "window")],
        [last for last, migrated, cycles in decisions if migrated and cycles],
        world.problem.stay_cycles,
        [number for number, actuated in cycles if actuated],
        {one.cycle for one in world.seen if one.what == APPLY},
    )


# ------------------------------------------------------------------------------------ shrinking


def _signature(wrong: str) -> str:
    """Return a violation without its numbers and names of candidates."""
    return re.sub(r"\d+|LOC|SO|HYB|\(.*\)|: .*", "#", wrong)


def shrunk(plan: Plan, found: Sequence[str]) -> Plan:
    """Return fewer and shorter faults that show one of the same violations."""
    wanted = {_signature(wrong) for wrong in found}

    def shows(smaller: Plan) -> bool:
        return any(_signature(wrong) in wanted for wrong in play(smaller).wrong)

    changed = True
    while changed:
        changed = False
        for smaller in _smaller(plan):
            if shows(smaller):
                plan, changed = smaller, True
                break
    return plan


def _smaller(plan: Plan) -> Iterator[Plan]:
    faults = plan.faults
    for index in range(len(faults)):
        yield replace(plan, faults=faults[:index] + faults[index + 1 :])
    for index, one in enumerate(faults):
        rest = faults[:index], faults[index + 1 :]
        if one.rests_s:
            yield replace(plan, faults=(*rest[0], replace(one, rests_s=0.0), *rest[1]))
        if one.lasts_s > 0.05:
            shorter = round(one.lasts_s / 2, 3)
            yield replace(plan, faults=(*rest[0], replace(one, lasts_s=shorter), *rest[1]))
        if one.phase:
            yield replace(plan, faults=(*rest[0], replace(one, phase=0.0), *rest[1]))


# ---------------------------------------------------------------------------------- the campaign


def campaign(out: Path, faults: int) -> list[dict[str, Any]]:
    """Play seed after seed until there were so many faults; goes on where it was stopped."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "runs.jsonl"
    rows = read(path)
    count = sum(len(row["kinds"]) for row in rows)
    seed = max((row["seed"] for row in rows), default=-1) + 1
    gc.collect()
    gc.freeze()
    with path.open("a", encoding="utf-8") as file:
        while count < faults:
            played = play(Plan.of(seed))
            row = _row(played)
            file.write(json.dumps(row) + "\n")
            file.flush()
            rows.append(row)
            count += len(played.plan.faults)
            if played.wrong:
                tell(played)
            seed += 1
    return rows


def _row(played: Played) -> dict[str, Any]:
    outcome = asdict(played.outcome)
    kept = ("lost", "lost_after", "bound", "gap_ms", "gap_after_ms", "recovery_ms", "silences")
    return {
        "seed": played.plan.seed,
        "kinds": [one.fault.kind for one in played.plan.faults],
        "wish": played.plan.wish,
        "cycles": played.cycles,
        **{name: outcome[name] for name in kept},
        "wrong": played.wrong,
    }


def read(path: Path) -> list[dict[str, Any]]:
    """Return the runs of a file; a line that was being written is left out."""
    rows = []
    with suppress(FileNotFoundError):
        for line in path.read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):
                rows.append(json.loads(line))
    return rows


def table(rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a table by kind, of faults alone and beside others."""
    yield (
        "| kind | faults | alone | with a bound | most cycles lost, where bounded | "
        "slowest recovery, s | runs with a violation |"
    )
    yield "|---|---|---|---|---|---|---|"
    rows = list(rows)
    kinds = sorted({kind for row in rows for kind in row["kinds"]})
    for kind in [*kinds, "all"]:
        mine = [row for row in rows if kind in (*row["kinds"], "all")]
        alone = [row for row in mine if len(row["kinds"]) == 1]
        bounded = [row for row in alone if row["bound"] is not None]
        most = max((max(row["lost"], row["lost_after"]) for row in bounded), default=0)
        slowest_s = max((row["recovery_ms"] for row in mine), default=0.0) / 1e3
        count = sum(len(row["kinds"]) if kind == "all" else 1 for row in mine)
        wrong = sum(bool(row["wrong"]) for row in mine)
        yield (
            f"| {kind} | {count} | {len(alone)} | {len(bounded)} | {most} | "
            f"{slowest_s:.1f} | {wrong} |"
        )


def tell(played: Played) -> None:
    """Print what was wrong, and the command that shows it with fewer and shorter faults."""
    smaller = shrunk(played.plan, played.wrong)
    print(f"seed {played.plan.seed}: {played.outcome.fault}")
    for wrong in played.wrong[:5]:
        print(f"    VIOLATION {wrong}")
    print(f"    again: {smaller.command()}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="play the faults of this seed")
    parser.add_argument("--wish", choices=(*WISHES, BOTH), help="where the controller wants to be")
    parser.add_argument("--delay-ms", type=float, help="of every message")
    parser.add_argument("--decide-cycles", type=int, help="cycles between two decisions")
    parser.add_argument("--play", nargs="*", type=_read, help="play these faults instead")
    parser.add_argument("--faults", type=int, default=0, help="so many, seed after seed")
    parser.add_argument("--out", type=Path, default=Path("build/seeded-faults"))
    asked = parser.parse_args(arguments)
    if asked.seed is None:
        rows = campaign(asked.out, asked.faults)
        print("\n".join(table(rows)))
        return int(any(row["wrong"] for row in rows))
    plan = Plan.of(asked.seed)
    plan = replace(
        plan,
        wish=plan.wish if asked.wish is None else asked.wish,
        delay_ms=plan.delay_ms if asked.delay_ms is None else asked.delay_ms,
        decide_cycles=asked.decide_cycles or plan.decide_cycles,
        faults=plan.faults if asked.play is None else tuple(asked.play),
    )
    played = play(plan)
    print(json.dumps({**_row(played), "digest": played.digest}, indent=1))
    if played.wrong:
        tell(played)
    return int(bool(played.wrong))


if __name__ == "__main__":
    sys.exit(main())
