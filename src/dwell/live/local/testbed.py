"""Testbed: runs a cell of real processes under a scenario.

The three kinds are processes without root (`loopback`), hosts on this machine (`netns_testbed`),
and the hosts of an inventory (`real_hosts`).
"""

from __future__ import annotations

import json
import os
import signal
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from dwell.errors import LiveError
from dwell.live.local.child import Started
from dwell.live.local.conditions import Conditions
from dwell.live.local.processes import Processes, expected
from dwell.live.local.timeline import Change, NodeState
from dwell.model import Problem

#: Function of a time-out in s; returns the status of the cell, or raises a LiveError.
Ask: TypeAlias = Callable[[float], Mapping[str, Any]]
#: File that marks a folder of a testbed, which the next run may replace.
MARK = ".dwell-testbed"
#: Folder of the run before all processes were ready.
STARTING = "starting"


def come_up(
    ask: Ask, awaited: Sequence[str], folder: Path, *, patience_s: float
) -> Mapping[str, Any]:
    """Wait until all awaited processes are ready; return the status of the cell.

    After `patience_s`, raises a LiveError with the state of the missing processes and the folder of
    the logs.
    """
    until = time.monotonic() + patience_s
    missing: Mapping[str, str] = {"the controller": "has not answered"}
    while True:
        if time.monotonic() > until:
            found = "; ".join(f"{who} {why}" for who, why in sorted(missing.items()))
            raise LiveError(
                f"after {patience_s:.0f} s the cell is not complete: {found}; see the logs in "
                f"{folder}"
            )
        try:
            status = ask(1.0)
        except LiveError:
            continue
        heard = status["processes"]
        missing = {
            who: heard[who]["note"] or "is not ready" if who in heard else "has not been heard"
            for who in awaited
            if who not in heard or not heard[who]["ready"]
        }
        if not missing:
            return status
        time.sleep(0.1)


class Testbed(Started):
    """A cell on hosts, links and CPUs that can be disturbed; a context manager.

    `start` starts all parts, waits until all processes are ready, and begins a run. `stop` ends all
    parts and removes their traces, the controller first, as it writes the run. `stop` may be called
    twice.

    Attributes
    ----------
    problem : Problem
        The cell, with its hosts.
    folder : Path
        Folder of cell file, states, logs and runs on this computer.
    processes : Processes
        Agents and controller, after the start.
    begun_ns : int
        First release of the run, on the clock of the processes on this computer.
    """

    problem: Problem
    folder: Path
    processes: Processes
    begun_ns: int
    #: Longest time until all processes are ready, s; long, as they may have a share of a CPU only.
    start_s = 120.0
    #: Previous run, which is not part of the measurement.
    _past: object = None

    def apply(self, change: Change) -> None:
        """Apply a change to a node or a link."""
        if isinstance(change.state, Conditions):
            self._apply_to_link(change.place, change.state)
        else:
            self._apply_to_node(change.place, change.state)

    @abstractmethod
    def _apply_to_node(self, node: str, state: NodeState) -> None: ...

    @abstractmethod
    def _apply_to_link(self, name: str, now: Conditions) -> None: ...

    @abstractmethod
    def sample(self, patience_s: float) -> Mapping[str, Any]:
        """Return the status from the cell's controller; raises a LiveError after the time-out."""

    def _came_up(self) -> Mapping[str, Any]:
        """Wait until all processes are ready; return the status of the cell."""
        return come_up(self.sample, expected(self.problem), self.folder, patience_s=self.start_s)

    def _come_up(self) -> None:
        """Wait until all processes are ready, with the cell on its initial placement.

        Until then a controller with a fixed placement runs. Its run, in `STARTING`, is not part of
        the measurement.
        """
        more = ["--policy", self.problem.initial]
        self.processes.start_controller(out=self.folder / STARTING, more=more)
        self._past = self._came_up()["run"]

    def begin(self) -> int:
        """Begin a new run with a new controller; return the first release, on the stamper's clock.

        Raises a LiveError if the run does not begin, or a process is missing.
        """
        self.processes.stop_controller()
        self._restart_stamper()
        self.processes.start_controller()
        until = time.monotonic() + self.start_s
        while time.monotonic() < until:
            status = self._came_up()
            # A late answer of the previous controller names the previous run.
            new = status["run"] not in (None, self._past)
            if new and status.get("origin_ns") is not None:
                self._past = status["run"]
                return int(status["origin_ns"])
            time.sleep(0.05)
        cell = f"cell {self.problem.name!r}"
        raise LiveError(f"{cell} releases no cycles; see the logs in {self.folder}")

    @abstractmethod
    def _restart_stamper(self) -> None:
        """Restart the stamper without its saved state."""


class LocalTestbed(Testbed):
    """A testbed on this machine, whose links can be cut and whose nodes commands can reach.

    Attributes
    ----------
    own_cpus : bool
        Whether each node has its own CPU time, which foreign threads can load.
    conditions : dict of str to Conditions
        Present conditions by link.
    """

    own_cpus: bool
    conditions: dict[str, Conditions]

    def _restart_stamper(self) -> None:
        node = self.problem.stamper_node
        state = self.folder / node
        mark = state / f"stamper@{node}.pid"
        pid = int(json.loads(mark.read_text(encoding="utf-8"))["pid"])
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)  # it must not save its state again
        (state / f"stamper@{node}.book").unlink(missing_ok=True)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)

    @abstractmethod
    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link at a time of the monotonic clock; return the actual time."""

    @abstractmethod
    def heal(self, source: str, target: str) -> None:
        """End a cut."""

    @abstractmethod
    def taps(self) -> Mapping[tuple[str, ...], Sequence[str]]:
        """Return command prefixes by groups of nodes, which the prefixed command can reach."""
