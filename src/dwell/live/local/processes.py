"""Processes that a testbed starts: the agent of each node, and the controller.

The agents start the other processes. All end with the process that made `Processes`, even if an
agent has died, and leave no shared memory.
"""

from __future__ import annotations

import os
import subprocess
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from dwell.cellfile.yaml_text import yaml_of
from dwell.live.host.node_processes import NodeProcesses
from dwell.live.host.parent_death import OPTION, end_those_of, start_sweeper
from dwell.live.local.trace_names import move_traces
from dwell.live.transport.orphans import remove_orphans
from dwell.live.trust import KEYS
from dwell.live.wire.wiring import PORTS_PER_ROLE, roles
from dwell.model import Host, Problem
from dwell.model.document import to_document

#: Function of a node and a command; returns a command that runs it there, in the same process.
Inside: TypeAlias = Callable[[str, Sequence[str]], Sequence[str]]

STOP_S = 5.0
#: Longest time for the end of a controller, which writes its run before.
CONTROLLER_STOP_S = 30.0
KILL_S = 10.0


def outright(node: str, words: Sequence[str]) -> Sequence[str]:
    """Return a command unchanged, as the node is this computer."""
    return words


def without_keys() -> dict[str, str]:
    """Return this process's environment without the keyring, which belongs to another cell."""
    return {name: value for name, value in os.environ.items() if name != KEYS}


def expected(problem: Problem, node: str | None = None) -> list[str]:
    """Return the names of a node's agent and its processes [default: of all nodes]."""
    return [
        role.who
        for role in roles(problem)
        if node in (None, role.node) and role.kind != "controller"
    ]


def with_hosts(problem: Problem, address: Callable[[str], str], first_port: int) -> Problem:
    """Return a cell with the addresses and ports of its nodes in `live.hosts`.

    `address` returns the address of a node. Nodes of the same address get consecutive ranges of
    ports from `first_port` on.
    """
    counts = Counter(role.node for role in roles(problem))
    hosts, following = {}, defaultdict[str, int](lambda: first_port)
    for node in problem.fabric.nodes:
        place = address(node)
        hosts[node] = Host(place, following[place])
        following[place] += PORTS_PER_ROLE * counts[node]
    return replace(problem, live=replace(problem.live, hosts=hosts))


class Processes(NodeProcesses):
    """Agents and controller of a cell in a testbed; all end with their owner.

    Parameters
    ----------
    problem : Problem
        Cell with all nodes in `live.hosts`.
    folder : Path
        Folder for cell file, states and logs; the runs are in ``runs``.
    inside : callable, optional
        Returns a command that runs a command on a node [default: on this computer].
    environment : mapping of str to str, optional
        Additional variables of all processes, which do not get the keyring of this process.
    cpus : mapping of str to int, optional
        CPU of each node; a missing node uses any CPU.
    more : sequence of str
        Further arguments of the controller.
    program, popen : optional
        See `NodeProcesses`.
    owner : str, optional
        Id of the process, on the computer of the nodes, with which all processes end [default: this
        process].
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
        # Processes import modules from the folder of the original cell file.
        paths = [problem.folder, os.environ.get("PYTHONPATH")] if problem.folder else []
        modules = {"PYTHONPATH": os.pathsep.join(filter(None, paths))} if paths else {}
        super().__init__(
            *(folder / "cell.yaml", folder),
            root=folder,
            environment={**without_keys(), **modules, **(environment or {})},
            program=program,
            popen=popen,
            process_group=0,
        )
        self.problem = problem
        self._owner = str(os.getpid()) if owner is None else owner
        self._inside, self._cpus, self._more = inside, dict(cpus or {}), tuple(more)
        self._sweeper: subprocess.Popen[bytes] | None = None

    def write(self) -> None:
        """Write the cell file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        document = to_document(self.problem)
        move_traces(document, Path(self.problem.folder or "").resolve())
        self.file.write_text(yaml_of(document), encoding="utf-8")

    def start_controller(self, *, out: Path | None = None, more: Sequence[str] = ()) -> None:
        """Start or restart the controller, with further arguments `more`.

        `out` is the folder for the runs' folders [default: ``runs``].
        """
        runs = self.folder / "runs" if out is None else out
        self.start_controller_on(self.problem.controller_node, runs, [*self._more, *more])

    def _start(self, who: str, words: Sequence[str]) -> None:
        if self._sweeper is None:
            self._sweeper = start_sweeper()
        cpu = self._cpus.get(who.partition("@")[2])
        cpus = [] if cpu is None else ["--cpus", str(cpu)]
        super()._start(who, [*words, OPTION, self._owner, *cpus])

    def _on(self, node: str, command: Sequence[str]) -> Sequence[str]:
        return self._inside(node, command)

    def forget(self, node: str) -> None:
        """Remove the processes of a node that have all been killed."""
        for who in list(self.running):
            if who.partition("@")[2] == node:
                self.running.pop(who).wait(KILL_S)

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        self.end("controller@", CONTROLLER_STOP_S)

    def stop(self) -> None:
        """End all processes, the agents after the controller, and remove their shared memory."""
        self.stop_controller()
        self.end("", STOP_S)
        # On a busy machine, processes of the lowest scheduling class outlive a killed agent.
        end_those_of(self._owner, self.file, KILL_S)
        if self._sweeper is not None:
            self._sweeper.kill()
            self._sweeper.wait()
            self._sweeper = None
        remove_orphans()
