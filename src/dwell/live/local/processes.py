"""Processes of a cell that a testbed starts: an agent on every node, and the controller.

All others are started by the agents. They end with the process that made this, whatever
becomes of those in between, and leave no shared memory.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from dwell.cellfile.yaml_text import yaml_of
from dwell.live.host.parent_death import OPTION, end_those_of, start_sweeper
from dwell.live.local.trace_names import move_traces
from dwell.live.transport.orphans import remove_orphans
from dwell.live.trust import KEYS
from dwell.live.wire.wiring import PORTS_PER_ROLE, roles
from dwell.model import Host, Problem
from dwell.model.document import to_document

#: Takes a node and the words of a command; returns those that run it there, in the same process.
Inside: TypeAlias = Callable[[str, Sequence[str]], Sequence[str]]

STOP_S = 5.0
#: A controller writes its run before it ends.
CONTROLLER_STOP_S = 30.0
KILL_S = 10.0


def outright(node: str, words: Sequence[str]) -> Sequence[str]:
    """Return a command as it is: the node is this computer."""
    return words


def without_keys() -> dict[str, str]:
    """Return this process's environment but for the keyring, which is of a cell of its own."""
    return {name: value for name, value in os.environ.items() if name != KEYS}


def expected(problem: Problem, node: str | None = None) -> list[str]:
    """Return the agent of a node and all that it starts; those of all nodes if none is named."""
    return [
        role.who
        for role in roles(problem)
        if node in (None, role.node) and role.kind != "controller"
    ]


def with_hosts(problem: Problem, address: Callable[[str], str], first_port: int) -> Problem:
    """Return a cell that knows where its nodes are.

    Parameters
    ----------
    address : callable
        Returns the address of a node.
    first_port : int
        First one of the first node of an address; others have the ones behind.
    """
    counts = Counter(role.node for role in roles(problem))
    hosts, following = {}, defaultdict[str, int](lambda: first_port)
    for node in problem.fabric.nodes:
        place = address(node)
        hosts[node] = Host(place, following[place])
        following[place] += PORTS_PER_ROLE * counts[node]
    return replace(problem, live=replace(problem.live, hosts=hosts))


class Processes:
    """Agents and controller of a cell.

    Parameters
    ----------
    problem : Problem
        With every node among `live.hosts`.
    folder : Path
        For cell file, states and logs; the runs are in ``runs``.
    inside : callable, optional
        Has a command run on a node; on this computer if left out.
    environment : mapping of str to str, optional
        Variables that all processes get as well. A keyring that this process has is of another
        cell, and not theirs.
    cpus : mapping of str to int, optional
        CPU of each node; a node that is not there uses any.
    more : sequence of str
        Further arguments of the controller.
    program : sequence of str
        Module, and its first arguments, that runs agents and controllers.
    popen : callable
        Starts a command, as `Popen`.
    owner : str, optional
        Process id, where they run, of the one that they end with; this process's own if left out.

    Attributes
    ----------
    running : dict of str to Popen
        By name: ``agent@R1``, ``controller@E``.
    file : Path
        The cell's.
    """

    def __init__(
        self,
        problem: Problem,
        folder: Path,
        *,
        inside: Inside = outright,
        environment: Mapping[str, str] | None = None,
        cpus: Mapping[str, int] | None = None,
        more: Sequence[str] = (),
        program: Sequence[str] = ("dwell",),
        popen: Callable[..., subprocess.Popen[bytes]] = subprocess.Popen,
        owner: str | None = None,
    ) -> None:
        self.problem, self.folder, self.file = problem, folder, folder / "cell.yaml"
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        # Processes find modules beside the cell file.
        paths = [problem.folder, os.environ.get("PYTHONPATH")] if problem.folder else []
        modules = {"PYTHONPATH": os.pathsep.join(filter(None, paths))} if paths else {}
        self.environment = {**modules, **(environment or {})}
        self._program = tuple(program)
        self._popen = popen
        self._owner = str(os.getpid()) if owner is None else owner
        self._inside, self._cpus, self._more = inside, dict(cpus or {}), tuple(more)
        self._sweeper: subprocess.Popen[bytes] | None = None

    def write(self) -> None:
        """Write the cell file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        document = to_document(self.problem)
        move_traces(document, Path(self.problem.folder or "").resolve())
        self.file.write_text(yaml_of(document), encoding="utf-8")

    def start_agent(self, node: str) -> None:
        """Start a node's agent, or start it again."""
        self._start("agent", node, ["--node", node, "--state", str(self.folder / node)])

    def start_controller(self, *, out: Path | None = None, more: Sequence[str] = ()) -> None:
        """Start the controller, or start it again.

        Parameters
        ----------
        out : Path, optional
            Where the runs' folders go; ``runs`` if left out.
        more : sequence of str
            Further arguments.
        """
        runs = self.folder / "runs" if out is None else out
        words = ["--out", str(runs), "--state", str(self.folder), *self._more, *more]
        self._start("controller", self.problem.controller_node, words)

    def _start(self, kind: str, node: str, words: Sequence[str]) -> None:
        if self._sweeper is None:
            self._sweeper = start_sweeper()
        command = [sys.executable, "-m", *self._program, kind, *words, OPTION, self._owner]
        if node in self._cpus:
            command += ["--cpus", str(self._cpus[node])]
        command += ["--cell", str(self.file)]
        who = f"{kind}@{node}"
        with (self.folder / f"{who}.log").open("ab") as log:
            self.running[who] = self._popen(
                self._inside(node, command),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**without_keys(), **self.environment},
                process_group=0,
            )

    def forget(self, node: str) -> None:
        """Take note that everything on a node has been killed."""
        for who in list(self.running):
            if who.partition("@")[2] == node:
                self.running.pop(who).wait(KILL_S)

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        self._end("controller@", CONTROLLER_STOP_S)

    def stop(self) -> None:
        """End all processes, the agents after the controller, and remove their shared memory."""
        self.stop_controller()
        self._end("", STOP_S)
        # On a full machine those of the lowest class outlive an agent that is killed.
        end_those_of(self._owner, self.file, KILL_S)
        if self._sweeper is not None:
            self._sweeper.kill()
            self._sweeper.wait()
            self._sweeper = None
        remove_orphans()

    def _end(self, begin: str, patience_s: float) -> None:
        """End the processes whose names begin so."""
        names = [who for who in self.running if who.startswith(begin)]
        end_all([self.running.pop(who) for who in names], patience_s)


def end_all(processes: Iterable[subprocess.Popen[bytes]], patience_s: float) -> None:
    """Tell processes to end, and kill those that have not when patience is over."""
    ending = list(processes)
    for process in ending:
        process.terminate()
    deadline = time.monotonic() + patience_s
    for process in ending:
        try:
            process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
