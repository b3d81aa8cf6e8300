"""Testbed: where a cell of real processes runs, and a scenario is played on it.

Three there are: processes without root (`loopback`), hosts on this machine (`netns_testbed`), and
the hosts of an inventory (`real_hosts`).
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

#: Takes for how many seconds to wait, and returns how the cell is; a LiveError if nobody answers.
Ask: TypeAlias = Callable[[float], Mapping[str, Any]]
#: A folder with this file is a testbed's, and may be replaced by its next run.
MARK = ".dwell-testbed"
#: Folder of what the cell did until everybody was there.
STARTING = "starting"


def come_up(
    ask: Ask, awaited: Sequence[str], folder: Path, *, patience_s: float
) -> Mapping[str, Any]:
    """Wait until all processes are ready; returns the status of the cell then.

    Parameters
    ----------
    ask : callable
    awaited : sequence of str
        Names of processes.
    folder : Path
        Where the logs are, for the message.

    Raises
    ------
    LiveError
        If they are not, with what is known of those that are missing.
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

    `start` starts everything, waits until every process is ready, and begins a run; `stop` ends
    everything, the controller first, so that the run is written, and leaves nothing behind. It is
    safe to call twice.

    Attributes
    ----------
    problem : Problem
        The cell, with its hosts.
    folder : Path
        Folder of cell file, states, logs and runs on this computer.
    processes : Processes
        Agents and controller, once it has been started.
    begun_ns : int
        First release of the run, by the clock that processes on this computer read.
    """

    problem: Problem
    folder: Path
    processes: Processes
    begun_ns: int
    #: How long its processes may take to be ready: with a share of a CPU they take a while, s.
    start_s = 120.0
    #: Run that is no part of any measurement any more.
    _past: object = None

    def apply(self, change: Change) -> None:
        """Have a node or a link be as a change says, from now on."""
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
        """Return the status of the cell, from its controller.

        Raises
        ------
        LiveError
            If nobody answers in time.
        """

    def _came_up(self) -> Mapping[str, Any]:
        """Return the status of the cell once all its processes are ready."""
        return come_up(self.sample, expected(self.problem), self.folder, patience_s=self.start_s)

    def _come_up(self) -> None:
        """Wait until all processes are ready, with the cell on its initial placement.

        A controller that never moves anything looks after the cell until then; the run that it
        writes is in `STARTING`, and no part of any measurement.
        """
        more = ["--policy", self.problem.initial]
        self.processes.start_controller(out=self.folder / STARTING, more=more)
        self._past = self._came_up()["run"]

    def begin(self) -> int:
        """Begin a new run, with a controller that knows nothing of the time before.

        Returns
        -------
        int
            First release, on the stamper's clock.

        Raises
        ------
        LiveError
            If the run does not begin, or somebody is missing.
        """
        self.processes.stop_controller()
        self._restart_stamper()
        self.processes.start_controller()
        until = time.monotonic() + self.start_s
        while time.monotonic() < until:
            status = self._came_up()
            # A late answer of the controller before tells of the run before.
            new = status["run"] not in (None, self._past)
            if new and status.get("origin_ns") is not None:
                self._past = status["run"]
                return int(status["origin_ns"])
            time.sleep(0.05)
        cell = f"cell {self.problem.name!r}"
        raise LiveError(f"{cell} releases no cycles; see the logs in {self.folder}")

    @abstractmethod
    def _restart_stamper(self) -> None:
        """Have the stamper begin anew, as if its cell had never run."""


class LocalTestbed(Testbed):
    """A testbed on this machine: its links can be cut, and its nodes listened to.

    Attributes
    ----------
    own_cpus : bool
        Whether every node has CPU time of its own, which foreign threads can load.
    conditions : dict of str to Conditions
        Conditions that hold now, by link.
    """

    own_cpus: bool
    conditions: dict[str, Conditions]

    def _restart_stamper(self) -> None:
        node = self.problem.stamper_node
        state = self.folder / node
        mark = state / f"stamper@{node}.pid"
        pid = int(json.loads(mark.read_text(encoding="utf-8"))["pid"])
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)  # so that it writes no book any more
        (state / f"stamper@{node}.book").unlink(missing_ok=True)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)

    @abstractmethod
    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link at an instant of the monotonic clock; returns when that was."""

    @abstractmethod
    def heal(self, source: str, target: str) -> None:
        """End a cut."""

    @abstractmethod
    def taps(self) -> Mapping[tuple[str, ...], Sequence[str]]:
        """Return how to run a command that reaches nodes directly: words to put first, by nodes."""
