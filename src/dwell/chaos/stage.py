"""Stage: where a cell runs that faults befall; this computer's loopback, or hosts of a testbed."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from dwell.errors import LiveError
from dwell.live.operator_client import OperatorClient
from dwell.model import Problem
from dwell.testbed.loopback import Loopback
from dwell.testbed.netns_testbed import NetnsTestbed
from dwell.testbed.processes import without_keys

__all__ = ["CLOCK_FILE", "OnHosts", "OnLoopback", "Stage"]

#: What is wrong with the clocks of a stage's nodes, in its folder.
CLOCK_FILE = "clocks"


class Stage(Protocol):
    """What a cell runs on, as far as faults need it; a context manager."""

    @property
    def problem(self) -> Problem:
        """The cell, with its hosts."""
        ...

    @property
    def folder(self) -> Path:
        """Of cell file, states, logs and runs."""
        ...

    @property
    def processes(self) -> dict[str, subprocess.Popen[bytes]]:
        """Agents and controller, by name."""
        ...

    def begin(self) -> None:
        """Start everything."""
        ...

    def start_agent(self, node: str) -> None:
        """Start a node's agent again."""
        ...

    def start_controller(self) -> None:
        """Start the controller again."""
        ...

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        ...

    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link; returns when that was."""
        ...

    def heal(self, source: str, target: str) -> None:
        """End that."""
        ...

    def stress(self, node: str, threads: int) -> bool:
        """Have busy threads share a node's CPUs; False where nodes have none of their own."""
        ...

    def ask(self, patience_s: float) -> Mapping[str, Any]:
        """Return what the controller says; a LiveError if it does not."""
        ...

    def taps(self) -> Mapping[str, Sequence[str]]:
        """Return how to run a command that reaches nodes directly: by name, prefix of the words.

        One name for each place that a listener is needed at; the nodes it is for are `heard_at`.
        """
        ...

    def heard_at(self, tap: str) -> Sequence[str]:
        """Return the nodes that are listened to from there."""
        ...

    def close(self) -> None:
        """End everything."""
        ...


class OnLoopback:
    """All nodes on this computer's loopback; links are of messages.

    Parameters
    ----------
    problem : Problem
        From `on_this_machine`.
    folder : Path
    seed : int
        Of delays and losses.
    environment : mapping of str to str
        Of all processes.
    """

    def __init__(
        self, problem: Problem, folder: Path, *, seed: int, environment: Mapping[str, str]
    ) -> None:
        self._problem, self._folder = problem, folder
        self._play = Loopback(
            *(problem, folder, {}),
            seed=seed,
            environment=environment,
            clocks=folder.resolve() / CLOCK_FILE,
        )
        self._visitor: OperatorClient | None = None

    @property
    def problem(self) -> Problem:
        """The cell, with its hosts."""
        return self._problem

    @property
    def folder(self) -> Path:
        """Of cell file, states, logs and runs."""
        return self._folder

    @property
    def processes(self) -> dict[str, subprocess.Popen[bytes]]:
        """Agents and controller, by name."""
        return self._play.processes

    def begin(self) -> None:
        """Start everything."""
        self._play.__enter__()
        self._visitor = OperatorClient(self.problem, without_keys())

    def start_agent(self, node: str) -> None:
        """Start a node's agent again."""
        self._play.start_agent(node)

    def start_controller(self) -> None:
        """Start the controller again."""
        self._play.start_controller()

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        self._play.stop_controller()

    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link; returns when that was."""
        return self._play.cut(source, target, at_ns)

    def heal(self, source: str, target: str) -> None:
        """End that."""
        self._play.heal(source, target)

    def stress(self, node: str, threads: int) -> bool:
        """Do nothing: all nodes share the CPUs."""
        return False

    def ask(self, patience_s: float) -> Mapping[str, Any]:
        """Return what the controller says."""
        if self._visitor is None:
            raise LiveError("nobody has been asked yet")
        return self._visitor.ask("status", patience_s=patience_s)

    def taps(self) -> Mapping[str, Sequence[str]]:
        """Return one place, from which all are reached."""
        return {"loopback": ()}

    def heard_at(self, tap: str) -> Sequence[str]:
        """Return all nodes."""
        return tuple(self.problem.fabric.nodes)

    def close(self) -> None:
        """End everything."""
        if self._visitor is not None:
            self._visitor.__exit__()
            self._visitor = None
        self._play.close()


class OnHosts:
    """Every node on a host of its own of a testbed on this machine.

    Parameters
    ----------
    testbed : NetnsTestbed
        Of one cell; not entered yet.
    """

    def __init__(self, testbed: NetnsTestbed) -> None:
        self._testbed = testbed

    @property
    def folder(self) -> Path:
        """Of cell file, states, logs and runs."""
        return self._testbed.folder

    @property
    def problem(self) -> Problem:
        """The cell, with its hosts."""
        return self._testbed.problems[0]

    @property
    def processes(self) -> dict[str, subprocess.Popen[bytes]]:
        """Agents and controller, by name."""
        return self._testbed.processes.running

    def begin(self) -> None:
        """Start everything."""
        self._testbed.__enter__()
        self._testbed.come_up()
        self._testbed.begin()

    def start_agent(self, node: str) -> None:
        """Start a node's agent again."""
        self._testbed.processes.start_agent(node)

    def start_controller(self) -> None:
        """Start the controller again."""
        self._testbed.processes.start_controllers()

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        self._testbed.stop_controllers()

    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link; returns when that was."""
        return self._testbed.links[frozenset((source, target))].down(
            source, target, True, at_ns=at_ns
        )

    def heal(self, source: str, target: str) -> None:
        """End that."""
        self._testbed.links[frozenset((source, target))].down(source, target, False)

    def stress(self, node: str, threads: int) -> bool:
        """Have so many busy threads share a node's CPUs."""
        self._testbed.stress[node].set(threads)
        return True

    def ask(self, patience_s: float) -> Mapping[str, Any]:
        """Return what the controller says."""
        return self._testbed.watchers[0].status(patience_s)

    def taps(self) -> Mapping[str, Sequence[str]]:
        """Return the hosts: what a node's processes say is listened to beside them."""
        return {node: self._testbed.beside(node) for node in self.problem.fabric.nodes}

    def heard_at(self, tap: str) -> Sequence[str]:
        """Return the node."""
        return (tap,)

    def close(self) -> None:
        """End everything."""
        self._testbed.close()
