"""A cell of real processes over real Zenoh, light enough for two cores, and what can befall it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import yaml

import dwell
from dwell.demo.stageplay import Stageplay, on_this_machine
from dwell.errors import LiveError
from dwell.live.visiting import Visitor
from tests.live import real_stages
from tests.live.real_stages import APPLY, HOLD, NODES, RECORD, ZERO

PERIOD_MS = 40
P_NS = PERIOD_MS * 1_000_000
GUARD_CYCLES = 3
MAX_AGE_MS = 120
MIN_DWELL = 2
WINDOW_CYCLES = 3
#: A window with lost cycles closes after the guard has looked: an order that comes of it, and that
#: might be for what has just died, finds another term.
GRACE_MS = GUARD_CYCLES * PERIOD_MS
#: Cycles without a fault after which the next one is no relapse: ten windows, and one.
HEALTH_CYCLES = 11 * WINDOW_CYCLES
#: Where each cell's controller wants to be, and what makes it want that.
HOMES = ("SO", "LOC")
EXEC_MS = {
    "SO": {"perception": {"R1": 8.0, "E": 3.0}, "planning": {"R2": 14.0, "E": 3.0}},
    "LOC": {"perception": {"R1": 3.0, "E": 14.0}, "planning": {"R2": 3.0, "E": 8.0}},
}
DELAY_MS = {"SO": {"R1-E": 1, "E-R2": 1, "R1-R2": 4}, "LOC": {"R1-E": 2, "E-R2": 2, "R1-R2": 1}}
CANDIDATES = {
    "LOC": {"perception": "R1", "planning": "R2"},
    "SO": {"perception": "E", "planning": "E"},
    "HYB": {"perception": "E", "planning": "R2"},
}


def exec_ms(home: str) -> dict[str, dict[str, float]]:
    """How long each task takes on each node."""
    return {"sensing": {"R1": 1.0}, **EXEC_MS[home], "control": {"R2": 0.5}}


def document(home: str, *, standby: bool = True) -> dict[str, Any]:
    """The cell file of a cell whose controller wants to be at `home`."""
    tasks: dict[str, Any] = {}
    for task, nodes in exec_ms(home).items():
        spare = {"standby": 1} if standby and len(nodes) == 1 else {}
        on = {node: {"exec_ms": ms, **spare} for node, ms in nodes.items()}
        tasks[task] = {"run": f"real_stages:{task.capitalize()}", "on": on}
    links = [
        {"from": a, "to": b, "both_ways": True, "delay_ms": ms, "rate_mbps": 1000}
        for pair, ms in DELAY_MS[home].items()
        for a, b in [pair.split("-")]
    ]
    return {
        "dwell": 1,
        "name": f"real-{home}",
        "period_ms": PERIOD_MS,
        "deadline_ms": PERIOD_MS,
        "window_cycles": WINDOW_CYCLES,
        "warmup_windows": 0,
        "nodes": {node: {"tier": "edge" if node == "E" else "robot", "cores": 2} for node in NODES},
        "links": links,
        "tasks": tasks,
        "flows": [
            {"from": "sensing", "to": "perception", "bytes": real_stages.FRAME_BYTES},
            {"from": "perception", "to": "planning", "bytes": 18},
            {"from": "planning", "to": "control", "bytes": 18},
        ],
        "candidates": CANDIDATES,
        "objective": {
            "weights": {
                "latency": 1.0, "violations": 0.5, "robot": 0.0, "edge": 0.0, "switching": 0.05,
            },
            "targets": {"latency_ms": PERIOD_MS / 2, "robot": 0.9, "edge": 0.9},
            "caps": {"latency_ms": 3 * PERIOD_MS},
        },
        "controller": {
            "on": "E", "policy": "dtp", "initial": home, "min_dwell": MIN_DWELL,
            "min_improvement": 0.4, "estimator": "profile", "guard_cycles": GUARD_CYCLES,
            "fallbacks": ["LOC", "HYB", "SO"], "close_grace_ms": GRACE_MS,
        },
        "live": {
            "max_age_ms": MAX_AGE_MS, "silence": "hold",
            "actuators": {"control": "real_stages:Observer"},
        },
    }  # fmt: skip


# ------------------------------------------------------------------------------- observer


@dataclass(frozen=True, slots=True)
class Seen:
    """A call of the actuator."""

    what: int
    placement: str
    pid: int
    cycle: int
    said: int
    released_ns: int
    at_ns: int

    @property
    def age_ms(self) -> float:
        return (self.at_ns - self.released_ns) / 1e6


PLACEMENTS = {(p["perception"], p["planning"]): name for name, p in CANDIDATES.items()}


class Observed:
    """What the actuator has written, as far as it has been read."""

    def __init__(self, path: Path) -> None:
        self.path, self.all = path, list[Seen]()
        self._read = 0

    def look(self) -> None:
        """Read what is new."""
        if not self.path.exists():
            return
        with self.path.open("rb") as file:
            file.seek(self._read)
            data = file.read()
        whole = len(data) - len(data) % RECORD.size
        self._read += whole
        for at in range(0, whole, RECORD.size):
            what, perception, planning, pid, *numbers = RECORD.unpack_from(data, at)
            where = PLACEMENTS.get((NODES[perception], NODES[planning]), "?")
            self.all.append(Seen(what, where, pid, *numbers))

    @property
    def applied(self) -> list[Seen]:
        return [seen for seen in self.all if seen.what == APPLY]

    def healthy(self, home: str) -> int:
        """Cycles since the last one that was lost, or took another placement."""
        self.look()
        count, following = 0, None
        for seen in reversed(self.all):
            if seen.what != APPLY:
                continue
            gap = following is not None and following - seen.cycle > 1
            if gap or seen.placement != home:
                break
            count, following = count + 1, seen.cycle
        return count

    def last(self) -> Seen | None:
        self.look()
        return next((seen for seen in reversed(self.all) if seen.what == APPLY), None)

    def since(self, at_ns: int) -> list[Seen]:
        """Calls of the actuator from an instant on."""
        self.look()
        found = []
        for seen in reversed(self.all):
            if seen.at_ns < at_ns:
                break
            found.append(seen)
        return found[::-1]

    def faults(self) -> list[str]:
        """What must never be: something twice, out of order, too old, or another cycle's."""
        applied = self.applied
        found = [
            f"cycle {later.cycle} after {before.cycle}"
            for before, later in pairwise(applied)
            if later.cycle <= before.cycle
        ]
        found += [f"cycle {s.cycle} carries {s.said}" for s in applied if s.cycle != s.said]
        # The gate looks a little before the actuator is called, which may be scheduled out between.
        limit_ms = MAX_AGE_MS + PERIOD_MS
        found += [f"cycle {s.cycle}: {s.age_ms:.0f} ms" for s in applied if s.age_ms > limit_ms]
        return found


# --------------------------------------------------------------------------------- stalls


class StallDetector:
    """Threads, one pinned to each CPU, that note when they were not scheduled: the machine's doing.

    The cell's processes have the same priority: where a thread that only sleeps comes too late,
    theirs do, too.
    """

    STEP_S = 0.004

    def __init__(self) -> None:
        self.stalls: list[tuple[int, int]] = []
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=self._watch, args=(cpu,), daemon=True)
            for cpu in sorted(os.sched_getaffinity(0))
        ]

    def __enter__(self) -> StallDetector:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()

    def _watch(self, cpu: int) -> None:
        os.sched_setaffinity(0, {cpu})
        before_ns = time.monotonic_ns()
        while not self._stopped.is_set():
            time.sleep(self.STEP_S)
            now_ns = time.monotonic_ns()
            if now_ns - before_ns > 3 * self.STEP_S * 1e9:
                self.stalls.append((before_ns, now_ns))
            before_ns = now_ns

    def worst_ms(self, since_ns: int, until_ns: int) -> float:
        """Longest stall that touches a time."""
        lengths = [b - a for a, b in self.stalls if b >= since_ns and a <= until_ns]
        return max(lengths, default=0) / 1e6


# ----------------------------------------------------------------------------------- cell


class RealCell(Stageplay):
    """A cell on this machine, with the means to harm it."""

    def __init__(self, home: str, folder: Path, *, standby: bool = True, seed: int = 0) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        written = folder / "written.yaml"
        written.write_text(yaml.safe_dump(document(home, standby=standby)))
        self.home = home
        told = {"observed": str(folder / "observed"), "exec_ms": exec_ms(home)}
        environment = {"REAL_CELL": json.dumps(told)}
        problem = on_this_machine(dwell.load(written))
        super().__init__(problem, folder, {}, seed=seed, environment=environment)
        shutil.copy(Path(real_stages.__file__), folder / "real_stages.py")
        self.observed = Observed(folder / "observed")
        self.visitor: Visitor | None = None

    def __enter__(self) -> RealCell:
        super().__enter__()
        try:
            self.visitor = Visitor(self.problem)
            self.wait_for("the whole cell at home", self.at_home, 40.0)
        except BaseException:
            self.close()
            raise
        return self

    def close(self) -> None:
        """End everything, also what is frozen or has no parent any more."""
        if self.visitor is not None:
            self.visitor.__exit__()
            self.visitor = None
        pids = [*self._marked(), *(p.pid for p in self.processes.values() if p.poll() is None)]
        for pid in pids:
            self._send(pid, signal.SIGCONT)
        super().close()
        for pid in self._marked():
            self._send(pid, signal.SIGKILL)

    @property
    def runs(self) -> list[Path]:
        """Folders of the runs."""
        return sorted((self.folder / "runs").iterdir())

    @property
    def everybody(self) -> list[str]:
        return [who for node in NODES for who in self.expected(node)]

    def _marked(self) -> list[int]:
        found = (pid_of(mark) for mark in self.folder.glob("*/*.pid"))
        return [pid for pid in found if pid is not None]

    def pid(self, who: str) -> int:
        """Process id of one of the cell's processes."""
        if who in self.processes:
            return self.processes[who].pid
        node = who.partition("@")[2].partition(".")[0]
        pid = pid_of(self.folder / node / f"{who}.pid")
        if pid is None:
            raise LiveError(f"{who} does not run")
        return pid

    def signal(self, names: Sequence[str], number: int) -> None:
        """Send a signal to processes, all at once."""
        for pid in [self.pid(who) for who in names]:
            self._send(pid, number)

    @staticmethod
    def _send(pid: int, number: int) -> None:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            return

    def start_again(self, who: str) -> None:
        """Start an agent or the controller again, as an init system does."""
        self.processes.pop(who).wait(10)
        kind, _, node = who.partition("@")
        if kind == "agent":
            self.start_agent(node)
        else:
            self.start_controller()

    # ------------------------------------------------------------------------- events

    def wait_for(self, what: str, event: Callable[[], str], patience_s: float) -> None:
        """Wait for an event: until it returns nothing that is missing.

        Raises
        ------
        LiveError
            With what is missing after `patience_s`.
        """
        until = time.monotonic() + patience_s
        while missing := event():
            if time.monotonic() > until:
                raise LiveError(f"waited {patience_s:g} s for {what}: {missing}")
            time.sleep(0.002)

    def status(self) -> dict[str, Any]:
        """Return what the controller says; nothing where it does not answer."""
        if self.visitor is None:
            return {}
        try:
            return self.visitor.ask("status", patience_s=0.4)
        except LiveError:
            return {}

    def at_home(self) -> str:
        """Look whether all are well and the cell is where its controller wants it."""
        now_ns = time.monotonic_ns()
        lately = [s for s in self.observed.since(now_ns - 6 * P_NS) if s.what == APPLY]
        if len(lately) < 4:
            return f"{len(lately)} actuations in six periods"
        if lately[-1].placement != self.home:
            return f"it is at {lately[-1].placement}"
        said = self.status()
        if not said:
            return "the controller does not answer"
        for key, wanted in {"placement": self.home, "fallback": False, "moving_to": None}.items():
            if said[key] != wanted:
                return f"{key} is {said[key]}"
        return "; ".join(self._unwell(said["processes"]))

    def healthy(self) -> str:
        """Look whether the guard takes the next fault for no relapse."""
        count = self.observed.healthy(self.home)
        return "" if count >= HEALTH_CYCLES else f"{count} of {HEALTH_CYCLES} cycles"

    def check_run(self) -> list[str]:
        """Return what is wrong with the record of the run, as far as it goes."""
        if len(self.runs) != 1:
            return [f"{len(self.runs)} runs instead of one"]
        run = dwell.open_run(self.runs[0])
        found = []
        for table, column in ((run.cycles, "number"), (run.windows, "window")):
            numbers = table[column].to_list()
            if any(later <= before for before, later in pairwise(numbers)):
                found.append(f"{column} does not grow")
        ordered = run.decisions.filter(
            run.decisions["migrated"] & (run.decisions["reason"] != "guard")
        )
        windows = ordered["window"].to_list()
        found += [
            f"migrations after windows {before} and {later}"
            for before, later in pairwise(windows)
            if later - before < MIN_DWELL + 1
        ]
        self.observed.look()
        applied = {seen.cycle for seen in self.observed.applied}
        told = run.cycles.filter(run.cycles["actuated"].cast(bool, strict=False))
        unknown = set(told["number"].to_list()) - applied
        if unknown:
            found.append(f"actuated by the record, not by the actuator: {sorted(unknown)[:5]}")
        return found

    def _unwell(self, processes: dict[str, Any]) -> Iterator[str]:
        for who in self.everybody:
            told = processes.get(who)
            if told is None:
                yield f"{who} has not been heard"
            elif not told["ready"]:
                yield f"{who} is not ready: {told['note']}"
            elif told["age_ms"] > 15 * PERIOD_MS:
                yield f"{who} was heard {told['age_ms']:.0f} ms ago"


def pid_of(mark: Path) -> int | None:
    """Process that an agent's mark tells of, if it lives."""
    try:
        told = json.loads(mark.read_text())
        process = psutil.Process(told["pid"])
        same = abs(process.create_time() - told["started"]) < 0.05
        return process.pid if same and process.status() != psutil.STATUS_ZOMBIE else None
    except (OSError, ValueError, psutil.Error):
        return None


# --------------------------------------------------------------------------------- faults


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that befalls a cell.

    Parameters
    ----------
    name : str
    home : str
        Of the cell that it befalls.
    how : {"kill", "freeze", "cut"}
    whom : tuple of str
        Processes; ``*E`` for all of a node; of a cut, the directions, as ``R1->E``.
    bound : int, optional
        Consecutive cycles that may be lost; None where no fallback can be whole.
    """

    name: str
    home: str
    how: str
    whom: tuple[str, ...]
    bound: int | None = GUARD_CYCLES + 1

    def names(self, cell: RealCell) -> list[str]:
        """Processes that it strikes."""
        found = []
        for who in self.whom:
            if not who.startswith("*"):
                found.append(who)
                continue
            node = who[1:]
            # The agent first: it must not bring back what dies next.
            found += sorted(cell.expected(node), key=lambda one: not one.startswith("agent"))
            if node == cell.problem.controller_node:
                found.append(f"controller@{node}")
        return found


def _faults() -> Iterator[Fault]:
    anchored = ("sensing@R1", "control@R2")
    for how in ("kill", "freeze"):
        for who, home in (
            ("controller@E", "SO"),
            ("agent@E", "SO"),
            ("agent@R1", "SO"),
            ("agent@R2", "SO"),
            ("perception@E", "SO"),
            ("planning@E", "SO"),
            ("perception@R1", "LOC"),
            ("planning@R2", "LOC"),
            *((one, "SO") for one in anchored),
        ):
            yield Fault(f"{how} {who}", home, how, (who,))
        yield Fault(f"{how} all of E", "SO", how, ("*E",))
        # No fallback is without these.
        for who in anchored:
            both = (who, f"{who}.1")
            yield Fault(f"{how} {who} and its standby", "LOC", how, both, None)
        yield Fault(f"{how} stamper@R1", "LOC", how, ("stamper@R1",), None)
        yield Fault(f"{how} sink.control@R2", "LOC", how, ("sink.control@R2",), None)
        yield Fault(f"{how} all of R2", "LOC", how, ("*R2",), None)
    for a, b, home in (("R1", "E", "SO"), ("E", "R2", "SO"), ("R1", "R2", "LOC")):
        yield Fault(f"cut {a}->{b}", home, "cut", (f"{a}->{b}",))
        yield Fault(f"cut {b}->{a}", home, "cut", (f"{b}->{a}",))
        yield Fault(f"cut {a}-{b}", home, "cut", (f"{a}->{b}", f"{b}->{a}"))


FAULTS = {fault.name: fault for fault in _faults()}


def moves(fault: Fault) -> bool:
    """Whether the guard has to move the cell, for which it should have been healthy before."""
    if fault.how == "cut":
        return True
    relocatable = any(who.startswith(("perception", "planning", "*E")) for who in fault.whom)
    return fault.bound is not None and relocatable


def mixed(home: str) -> list[Fault]:
    """Return a home's faults, those that make the cell move apart from one another."""
    mine = [fault for fault in FAULTS.values() if fault.home == home]
    moving = [fault for fault in mine if moves(fault)]
    others = [fault for fault in mine if not moves(fault)]
    placed = [(index / len(moving), fault) for index, fault in enumerate(moving)]
    placed += [((index + 0.5) / len(others), fault) for index, fault in enumerate(others)]
    return [fault for _, fault in sorted(placed, key=lambda item: item[0])]


@dataclass(slots=True)
class Outcome:
    """What a fault has cost.

    Parameters
    ----------
    lost, lost_after : int
        Most consecutive cycles without an actuation, by their numbers: from the fault to its end,
        and from there to the recovery. A stamper that starts anew leaves numbers out: -1.
    gap_ms, gap_after_ms : float
        Longest time between two actuations, likewise.
    recovery_ms : float
        From the end of the fault until the cell was whole and at home.
    silences : int
        Times that the actuator was told that no command came.
    moved : str
        Placements that were actuated, in order.
    stall_ms : float
        Longest time that the machine kept a thread waiting meanwhile.
    wrong : list of str
        What should not be.
    """

    fault: str
    seed: int
    phase: float
    lost: int = 0
    lost_after: int = 0
    gap_ms: float = 0.0
    gap_after_ms: float = 0.0
    recovery_ms: float = 0.0
    silences: int = 0
    moved: str = ""
    stall_ms: float = 0.0
    wrong: list[str] = field(default_factory=list)


def strike(
    cell: RealCell, fault: Fault, stalls: StallDetector, *, phase: float, seed: int, lasts: int
) -> Outcome:
    """Have a fault befall a cell, end it, and wait until the cell has recovered.

    Parameters
    ----------
    phase : float
        Of the period, after a release.
    seed : int
        That `phase` and `lasts` were drawn with.
    lasts : int
        Periods until what is frozen or cut is so no more.

    Raises
    ------
    LiveError
        If an event that it waits for does not come.
    """
    cell.wait_for("the whole cell at home", cell.at_home, 30.0)
    if moves(fault):
        cell.wait_for("health", cell.healthy, 30.0)
    last = cell.observed.last()
    assert last is not None
    names = fault.names(cell) if fault.how != "cut" else []
    at_ns = last.released_ns + round(phase * P_NS)
    while at_ns < time.monotonic_ns() + 5_000_000:
        at_ns += P_NS
    begin_ns = _act(cell, fault, names, at_ns)
    _last(cell, fault, begin_ns, lasts)
    end_ns = time.monotonic_ns()
    _end(cell, fault, names)
    if fault.how == "kill" and fault.bound is None:
        # Its end is the first cycle again.
        cell.wait_for("a cycle after it", lambda: _few(cell, end_ns, 1), 30.0)
        end_ns = time.monotonic_ns()
    recovered = f"the whole cell at home after '{fault.name}'"
    cell.wait_for(recovered, cell.at_home, 60.0)
    back_ns = time.monotonic_ns()
    # What is on its way when the cell is back is seen, too.
    cell.wait_for("five more cycles", lambda: _few(cell, back_ns, 5), 5.0)
    return _weigh(cell, fault, stalls, seed, phase, (begin_ns, end_ns, back_ns))


def _act(cell: RealCell, fault: Fault, names: list[str], at_ns: int) -> int:
    """Strike at an instant; returns when it was."""
    if fault.how == "cut":
        moments = []
        for direction in fault.whom:
            source, target = direction.split("->")
            link = cell.links[frozenset((source, target))]
            moments.append(link.cut(source, at_ns=at_ns))
        return min(moments)
    pids = [cell.pid(who) for who in names]
    wait_s = (at_ns - time.monotonic_ns()) / 1e9 - 0.001
    if wait_s > 0:
        time.sleep(wait_s)
    while time.monotonic_ns() < at_ns:
        pass
    begin_ns = time.monotonic_ns()
    number = signal.SIGKILL if fault.how == "kill" else signal.SIGSTOP
    for pid in pids:
        os.kill(pid, number)
    return begin_ns


def _last(cell: RealCell, fault: Fault, begin_ns: int, lasts: int) -> None:
    """Wait for the event that the fault's end waits for."""
    over_ns = begin_ns + lasts * P_NS
    if fault.bound is not None:
        cell.wait_for(
            f"ten cycles released after '{fault.name}'", lambda: _few(cell, begin_ns, 10), 20.0
        )
    elif fault.how == "kill":
        return
    cell.wait_for(
        f"{lasts} periods of it", lambda: "" if time.monotonic_ns() >= over_ns else "not yet", 20.0
    )


def _end(cell: RealCell, fault: Fault, names: list[str]) -> None:
    if fault.how == "cut":
        for direction in fault.whom:
            source, target = direction.split("->")
            cell.links[frozenset((source, target))].heal(source)
    elif fault.how == "freeze":
        cell.signal(names, signal.SIGCONT)
    else:
        for who in names:
            if who.startswith(("agent", "controller")):
                cell.start_again(who)


def _few(cell: RealCell, since_ns: int, count: int) -> str:
    found = sum(
        seen.what == APPLY and seen.released_ns > since_ns for seen in cell.observed.since(since_ns)
    )
    return "" if found >= count else f"{found} of {count} cycles actuated"


def _unsafe(seen: Sequence[Seen], limit_ms: float) -> list[str]:
    """Silences in which the actuator was not told in time that no command comes.

    A sink that is dead or frozen itself tells it nothing; of that no more is asked than that it
    never applies what has become old.
    """
    found = []
    commands = [place for place, one in enumerate(seen) if one.what == APPLY]
    for before, later in pairwise(commands):
        gap_ms = (seen[later].at_ns - seen[before].at_ns) / 1e6
        told = [one.at_ns for one in seen[before + 1 : later] if one.what in (HOLD, ZERO)]
        if gap_ms <= limit_ms:
            continue
        waited_ms = (told[0] - seen[before].at_ns) / 1e6 if told else gap_ms
        if waited_ms > limit_ms:
            found.append(
                f"no command for {gap_ms:.0f} ms after cycle {seen[before].cycle}, "
                f"and no hold() within {limit_ms:.0f} ms"
            )
    return found


def _weigh(
    cell: RealCell,
    fault: Fault,
    stalls: StallDetector,
    seed: int,
    phase: float,
    times: tuple[int, int, int],
) -> Outcome:
    begin_ns, end_ns, back_ns = times
    found = Outcome(fault.name, seed, phase)
    seen = cell.observed.since(begin_ns - 10 * P_NS)
    applied = [one for one in seen if one.what == APPLY]
    for before, later in pairwise(applied):
        if later.at_ns < begin_ns:
            continue
        lost, gap_ms = later.cycle - before.cycle - 1, (later.at_ns - before.at_ns) / 1e6
        if before.at_ns < end_ns:
            found.lost, found.gap_ms = max(found.lost, lost), max(found.gap_ms, gap_ms)
        else:
            found.lost_after = max(found.lost_after, lost)
            found.gap_after_ms = max(found.gap_after_ms, gap_ms)
    found.recovery_ms = (back_ns - end_ns) / 1e6
    found.silences = sum(one.what in (HOLD, ZERO) for one in seen if one.at_ns >= begin_ns)
    steps = [one.placement for one in applied]
    found.moved = " ".join(b for a, b in pairwise(["", *steps]) if a != b)
    found.stall_ms = stalls.worst_ms(begin_ns - P_NS, back_ns)
    if fault.how == "kill" and "stamper" in fault.name:
        found.lost = -1
    found.wrong = cell.observed.faults()
    if not set(fault.whom) & {"sink.control@R2", "*R2"}:
        during = [one for one in seen if one.at_ns >= begin_ns - P_NS]
        found.wrong += _unsafe(during, MAX_AGE_MS + PERIOD_MS + found.stall_ms)
    if fault.bound is not None:
        for when, lost in (("by it", found.lost), ("after it", found.lost_after)):
            if lost > fault.bound:
                found.wrong.append(f"{lost} consecutive cycles lost {when}, not {fault.bound}")
    return found
