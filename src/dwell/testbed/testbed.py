"""Testbed: where a cell of real processes runs, and a scenario is played on it.

Three there are: processes without root (`loopback`), hosts on this machine (`netns_testbed`), and
the hosts of an inventory (`real_hosts`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dwell.model import Problem
from dwell.testbed.child import Started
from dwell.testbed.conditions import Conditions
from dwell.testbed.processes import Processes
from dwell.testbed.timeline import Change, NodeState, differing


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


class LocalTestbed(Testbed):
    """A testbed on this machine: its links can be cut, and its nodes listened to.

    Attributes
    ----------
    own_cpus : bool
        Whether every node has CPU time of its own, which foreign threads can load.
    """

    own_cpus: bool
    #: Those that hold now, by link.
    _conditions: dict[str, Conditions]

    def conditions(self, name: str) -> Conditions:
        """Return the conditions of a link that hold now."""
        return self._conditions[name]

    def _changes(self, name: str, now: Conditions) -> dict[str, Any]:
        """Note the conditions of a link that hold now; returns the fields that have changed."""
        before, self._conditions[name] = self._conditions[name], now
        return differing(before, now)

    @abstractmethod
    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link at an instant of the monotonic clock; returns when that was."""

    @abstractmethod
    def heal(self, source: str, target: str) -> None:
        """End a cut."""

    @abstractmethod
    def taps(self) -> Mapping[tuple[str, ...], Sequence[str]]:
        """Return how to run a command that reaches nodes directly: words to put first, by nodes."""
