"""Harness: runs a cell, injects faults, and detects when the cell has recovered."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.files import write_whole
from dwell.live.host.hosting import clock_of
from dwell.live.host.supervision import survivor
from dwell.live.local.burner import Burner
from dwell.live.local.child import Started
from dwell.live.local.clocks import ClockFile
from dwell.live.local.conditions import Conditions
from dwell.live.local.processes import expected
from dwell.live.local.testbed import LocalTestbed
from dwell.live.local.timeline import Change, NodeState
from dwell.model import Problem
from dwell_lab.chaos.actuations import Actuations, Seen
from dwell_lab.chaos.disk import DiskHog, SmallDisk, limit_file_size
from dwell_lab.chaos.faults import Fault, struck
from dwell_lab.chaos.stages import APPLY, TOLD

OBSERVED, CLOCK_FILE, FAILING = "observed", "clocks", "failing"
#: Longest healthy time to wait for before a fault; short windows need less (`Harness.healthy`).
HEALTH_S = 5.0
#: Number of past periods whose actuations show whether a cell works.
RECENT_PERIODS = 6
#: Busy threads that compete with the processes of a starved node.
STARVING_THREADS = 32


def environment_of(folder: Path, exec_ms: Mapping[str, object], **more: object) -> dict[str, str]:
    """Return the environment variables for the stages and the actuator of a cell."""
    folder = folder.resolve()
    files = {"observed": str(folder / OBSERVED), "failing": str(folder / FAILING)}
    return {TOLD: json.dumps({**files, "exec_ms": exec_ms, **more})}


def away_from_home(
    problem: Problem,
    home: str | None,
    applied: Sequence[Seen],
    status: Callable[[], Mapping[str, Any]],
) -> str:
    """Return why a cell is not complete and at home; an empty text if it is.

    With a home, the guard may have moved the cell there: `fallback` is not checked.

    Parameters
    ----------
    applied : sequence of Seen
        Commands of the last `RECENT_PERIODS`.
    status : callable
        Returns the controller's status; an empty mapping if the controller does not answer.
    """
    if len(applied) < 4:
        return f"{len(applied)} actuations in six periods"
    if home is not None and applied[-1].placement != home:
        return f"it is at {applied[-1].placement}"
    told = status()
    if not told:
        return "the controller does not answer"
    wanted: dict[str, object] = {"wanted": None, "moving_to": None, "resting": False}
    if home is not None:
        wanted["placement"] = home
    else:
        wanted["fallback"] = False
    for key, value in wanted.items():
        if told[key] != value:
            return f"{key} is {told[key]}"
    return "; ".join(_unwell(problem, told["processes"]))


def _unwell(problem: Problem, processes: Mapping[str, Any]) -> Iterator[str]:
    for who in expected(problem):
        process = processes.get(who)
        if process is None:
            yield f"{who} has not been heard"
        elif not process["ready"]:
            yield f"{who} is not ready: {process['note']}"
        elif process["age_ms"] > 15 * problem.pipeline.period_ms:
            yield f"{who} was heard {process['age_ms']:.0f} ms ago"


class Harness(Started):
    """Context manager that runs a cell and injects faults.

    Parameters
    ----------
    testbed : LocalTestbed
        Its environment contains the variables of `environment_of`.
    home : str, optional
        Candidate to which the cell must return; if omitted, any that the controller chooses.
    disks : bool
        Whether each node and the folder of runs gets a small disk that `fill` faults can fill.
    """

    def __init__(
        self, testbed: LocalTestbed, *, home: str | None = None, disks: bool = False
    ) -> None:
        super().__init__()
        self.testbed, self.home, self.disks = testbed, home, disks
        self.folder = testbed.folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self.actuations = Actuations(self.folder / OBSERVED)
        self.starved_cpus: frozenset[int] = frozenset()
        #: Answers to `status` that are not judged yet, with their instants on the true clock.
        self.looks: list[tuple[int, Mapping[str, Any]]] = []
        self._small: dict[str, SmallDisk] = {}
        self._hog: DiskHog | None = None
        self._burner: Burner | None = None
        self._stressed = ""
        self._usual: dict[str, Conditions] = {}
        self._living: dict[str, int] = {}

    @property
    def problem(self) -> Problem:
        """The cell."""
        return self.testbed.problem

    @property
    def period_ns(self) -> int:
        """The pipeline's period P."""
        return self.problem.pipeline.period_ns

    def _start(self) -> None:
        """Start all processes, and wait until the cell is at home."""
        nodes = list(self.problem.fabric.nodes)
        for name in ("runs", *nodes) if self.disks else ():
            self._small[name] = self._stack.enter_context(SmallDisk(self.folder / name))
        self._clocks = ClockFile(self.folder / CLOCK_FILE, nodes, clock_of(self.problem))
        self._stack.callback(self._clocks.close)
        self._stack.callback(self._end_all)
        self.testbed.start()
        self.wait_for("the whole cell at home", self.at_home, 60.0)

    def _end_all(self) -> None:
        """End all processes, including frozen processes and processes without a parent."""
        self._feed()
        if self._hog is not None:
            self._hog.stop()
            self._hog = None
        running = self.testbed.processes.running.values()
        for pid in [*self._marked(), *(p.pid for p in running if p.poll() is None)]:
            _send(pid, signal.SIGCONT)
        self.testbed.stop()
        for pid in self._marked():
            _send(pid, signal.SIGKILL)

    # ---------------------------------------------------------------------- processes

    @property
    def runs(self) -> list[Path]:
        """Folders of the recorded runs."""
        folder = self.folder / "runs"
        return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []

    def _marked(self) -> list[int]:
        found = (survivor(mark) for mark in self.folder.glob("*/*.pid"))
        return [process.pid for process in found if process is not None]

    def pid(self, who: str) -> int:
        """Return the process id of a process of the cell; raise LiveError if it does not run."""
        if who in self.testbed.processes.running:
            return self.testbed.processes.running[who].pid
        node = who.partition("@")[2].partition(".")[0]
        process = survivor(self.folder / node / f"{who}.pid")
        if process is None:
            raise LiveError(f"{who} does not run")
        return process.pid

    def _running(self) -> dict[str, int]:
        """Return the ids of all running processes, including the controller."""
        ours = self.testbed.processes.running
        everybody = {who for node in self.problem.fabric.nodes for who in self._all_of(node)}
        running = {}
        for who in everybody - {who for who, one in ours.items() if one.poll() is not None}:
            with suppress(LiveError):
                running[who] = self.pid(who)
        return running

    def ended(self, fault: Fault) -> list[str]:
        """Return a violation for each process that ended after a fault began but was not killed."""
        running = self._running()
        ended = struck(self.problem, fault) if fault.how == "kill" else []
        return [
            f"{who} has ended by itself"
            for who, pid in self._living.items()
            if who not in ended and running.get(who) != pid
        ]

    def start_again(self, who: str) -> None:
        """Restart an agent or the controller, as an init system does."""
        process = self.testbed.processes.running.pop(who, None)
        if process is not None:
            process.wait(10)
        kind, _, node = who.partition("@")
        if kind == "agent":
            self.testbed.processes.start_agent(node)
        else:
            self.testbed.processes.start_controller()

    def _all_of(self, node: str) -> list[str]:
        """Return the processes of a node, including the controller."""
        controller = [f"controller@{node}"] if node == self.problem.controller_node else []
        return [*expected(self.problem, node), *controller]

    # ------------------------------------------------------------------------- clocks

    def set_clock(self, node: str, *, jump_ms: float = 0.0, drift_ppm: float = 0.0) -> None:
        """Make a node's clock jump, and set its drift."""
        self._clocks.set(node, jump_ns=round(jump_ms * 1e6), drift_ppb=round(drift_ppm * 1e3))

    # --------------------------------------------------------------------------- CPUs

    def starve(self, node: str) -> None:
        """Move a node's processes to one CPU with busy threads, and the other nodes off that CPU.

        If every node has its own CPUs, the busy threads run on them and no process moves. On a
        machine with only one CPU all nodes starve.
        """
        if self.testbed.own_cpus:
            self._stressed = node
            self._stress(node, STARVING_THREADS)
            return
        cpus = sorted(os.sched_getaffinity(0))
        self._burner = Burner(cpus[:1])
        self._burner.start(STARVING_THREADS)
        self.starved_cpus = frozenset(cpus[:1])
        for other in self.problem.fabric.nodes:
            self._pin(other, cpus[:1] if other == node else cpus[1:] or cpus)

    def _stress(self, node: str, threads: int) -> None:
        self.testbed.apply(Change(0, node, NodeState(threads)))

    def _feed(self) -> None:
        if self._stressed:
            self._stress(self._stressed, 0)
            self._stressed = ""
        if self._burner is None:
            return
        self._burner.stop()
        self._burner = None
        for node in self.problem.fabric.nodes:
            self._pin(node, sorted(os.sched_getaffinity(0)))
        self.starved_cpus = frozenset()

    def _pin(self, node: str, cpus: Sequence[int]) -> None:
        for who in self._all_of(node):
            with suppress(LiveError, OSError):
                for task in Path(f"/proc/{self.pid(who)}/task").iterdir():
                    with suppress(ProcessLookupError):
                        os.sched_setaffinity(int(task.name), cpus)

    # -------------------------------------------------------------------------- disks

    def _fill(self, what: str) -> None:
        if what in self._small:
            self._small[what].fill()
        elif what == "runs":
            longest = max((f.stat().st_size for f in self.folder.glob("runs/*/*")), default=0)
            limit_file_size(self.pid(f"controller@{self.problem.controller_node}"), longest)
        else:
            raise LiveError(f"the disk of {what} cannot be made full without root")

    def _clear(self, what: str) -> None:
        if what in self._small:
            self._small[what].clear()
        else:
            limit_file_size(self.pid(f"controller@{self.problem.controller_node}"), None)

    # ------------------------------------------------------------------------- faults

    def begin(self, fault: Fault, at_ns: int) -> int:
        """Begin a fault at an instant of the true clock; return the actual instant."""
        self._living = self._running()
        if fault.how == "cut":
            ways = [way.split("->") for way in fault.whom]
            return min(self.testbed.cut(source, target, at_ns) for source, target in ways)
        pids = (
            [self.pid(who) for who in struck(self.problem, fault)] if fault.how in _SIGNALS else []
        )
        wait_s = (at_ns - time.monotonic_ns()) / 1e9 - 0.001
        if wait_s > 0:
            time.sleep(wait_s)
        while time.monotonic_ns() < at_ns:
            pass
        begin_ns = time.monotonic_ns()
        for pid in pids:
            _send(pid, _SIGNALS[fault.how])
        for what in fault.whom:
            match fault.how:
                case "slow":
                    self._usual[what] = usual = self.testbed.conditions[what]
                    slow = replace(usual, rate_mbps=fault.amount)
                    self.testbed.apply(Change(0, what, slow))
                case "fail":
                    write_whole(self.folder / FAILING, what, durable=False)
                case "jump":
                    self.set_clock(what, jump_ms=fault.amount)
                case "drift":
                    self.set_clock(what, drift_ppm=fault.amount)
                case "starve":
                    self.starve(what)
                case "fill":
                    self._fill(what)
                case "hog":
                    self._hog = DiskHog(self.folder)
                    self._hog.start()
        return begin_ns

    def end(self, fault: Fault) -> str:
        """End a fault; return a note about its effect, or an empty text."""
        match fault.how:
            case "cut":
                for way in fault.whom:
                    self.testbed.heal(*way.split("->"))
            case "slow":
                for way in fault.whom:
                    self.testbed.apply(Change(0, way, self._usual.pop(way)))
            case "fail":
                (self.folder / FAILING).unlink()
            case "freeze":
                for pid in [self.pid(who) for who in struck(self.problem, fault)]:
                    _send(pid, signal.SIGCONT)
            case "kill":
                for who in struck(self.problem, fault):
                    if who.startswith(("agent", "controller")):
                        self.start_again(who)
            case "drift":
                for node in fault.whom:
                    self.set_clock(node)
            case "starve":
                self._feed()
            case "fill":
                for what in fault.whom:
                    self._clear(what)
            case "hog" if self._hog is not None:
                self._hog.stop()
                hog, self._hog = self._hog, None
                return f"a page took {hog.wait_ms:.1f} ms to the disk, {hog.usual_ms:.1f} before"
        return ""

    # ------------------------------------------------------------------------- events

    def wait_for(self, what: str, event: Callable[[], str], patience_s: float) -> None:
        """Poll `event` until it returns an empty text; other texts name the missing condition.

        Raises
        ------
        LiveError
            If the event does not happen within `patience_s`; the message contains the last text.
        """
        until = time.monotonic() + patience_s
        while missing := event():
            if time.monotonic() > until:
                raise LiveError(f"waited {patience_s:g} s for {what}: {missing}")
            time.sleep(0.01)

    def status(self) -> Mapping[str, Any]:
        """Return the controller's status, or an empty mapping if it does not answer."""
        try:
            told = self.testbed.sample(0.4)
        except LiveError:
            return {}
        if not self.looks or self.looks[-1][1].get("windows") != told.get("windows"):
            self.looks.append((time.monotonic_ns(), told))
        return told

    def at_home(self) -> str:
        """Return why the cell is not complete and at home; an empty text if it is."""
        seen = self.actuations.since(time.monotonic_ns() - RECENT_PERIODS * self.period_ns)
        applied = [one for one in seen if one.what == APPLY]
        return away_from_home(self.problem, self.home, applied, self.status)

    def healthy(self) -> str:
        """Return the count of healthy cycles while it is too small; else an empty text.

        After 11 healthy windows the guard does not count the next fault as a relapse. If windows
        are long, cycles worth `HEALTH_S` are enough.
        """
        ten = 11 * self.problem.window_cycles
        needed = min(ten, round(HEALTH_S * 1e9 / self.period_ns))
        count = self.actuations.healthy(self.home)
        return "" if count >= needed else f"{count} of {needed} cycles"


_SIGNALS = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}


def _send(pid: int, number: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, number)
