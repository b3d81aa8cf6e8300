"""Processes of a cell that a testbed starts: an agent on every node, and the controller.

All others are started by the agents. They end with the process that made this, whatever
becomes of those in between, and leave no shared memory.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from dwell.cellfile.yaml_text import yaml_of
from dwell.errors import LiveError
from dwell.live.parent_death import OPTION, start_sweeper
from dwell.live.transport.orphans import remove_orphans
from dwell.live.trust import KEYS
from dwell.live.wiring import PORTS_PER_ROLE, roles
from dwell.model import Host, Problem
from dwell.model.document import to_document
from dwell.testbed.trace_names import move_traces

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


def _module_path(problems: Iterable[Problem]) -> dict[str, str]:
    """Return the variable by which processes find modules beside the cell files.

    A testbed writes the cell files of its processes into a folder of its own.
    """
    folders = dict.fromkeys(one.folder for one in problems if one.folder is not None)
    paths = [*folders, *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(paths)} if folders else {}


def expected(problem: Problem, node: str | None = None) -> list[str]:
    """Return the agent of a node and all that it starts; those of all nodes if none is named."""
    return [
        role.who
        for role in roles(problem)
        if node in (None, role.node) and role.kind != "controller"
    ]


def with_hosts(
    problem: Problem, address: Callable[[str], str], following: dict[str, int]
) -> Problem:
    """Return a cell that knows where its nodes are.

    Parameters
    ----------
    address : callable
        Returns the address of a node.
    following : dict of str to int
        Next port by address; those that the nodes take are taken from it.
    """
    counts = Counter(role.node for role in roles(problem))
    hosts = {}
    for node in problem.fabric.nodes:
        place = address(node)
        hosts[node] = Host(place, following[place])
        following[place] += PORTS_PER_ROLE * counts[node]
    return replace(problem, live=replace(problem.live, hosts=hosts))


class Processes:
    """Agents and controllers of cells that share some nodes.

    Parameters
    ----------
    problems : sequence of Problem
        With every node among `live.hosts`, and names of their own.
    folder : Path
        For cell files, states, logs and runs. Where there are several cells, each has a folder of
        its name in it; the runs are in ``runs``.
    inside : callable, optional
        Has a command run on a node; on this computer if left out.
    environment : mapping of str to str, optional
        Variables that all processes get as well. A keyring that this process has is of another
        cell, and not theirs.
    cpus : mapping of str to int, optional
        CPU of each node; a node that is not there uses any.
    more : sequence of str
        Further arguments of the controllers.
    program : sequence of str
        Module, and its first arguments, that runs agents and controllers.
    popen : callable
        Starts a command, as `Popen`.
    owner : str, optional
        Process id, where they run, of the one that they end with; this process's own if left out.

    Attributes
    ----------
    running : dict of str to Popen
        By name: ``agent@R1``, ``controller@E``; of several cells ``agent@R1 of CELL``.
    """

    def __init__(
        self,
        problems: Sequence[Problem],
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
        names = [problem.name for problem in problems]
        if len(set(names)) < len(names):
            raise LiveError(f"two cells have one name: {', '.join(sorted(names))}")
        self.problems, self.folder = tuple(problems), folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.environment = {**_module_path(self.problems), **(environment or {})}
        self._program = tuple(program)
        self._popen = popen
        self._owner = str(os.getpid()) if owner is None else owner
        self._inside, self._cpus, self._more = inside, dict(cpus or {}), tuple(more)
        self._sweeper: subprocess.Popen[bytes] | None = None

    def folder_of(self, problem: Problem) -> Path:
        """Return where a cell's file is, and the states of its nodes."""
        return self.folder if len(self.problems) == 1 else self.folder / problem.name

    def file_of(self, problem: Problem) -> Path:
        """Return a cell's file."""
        return self.folder_of(problem) / "cell.yaml"

    def write(self) -> None:
        """Write the cell files."""
        for problem in self.problems:
            file = self.file_of(problem)
            file.parent.mkdir(parents=True, exist_ok=True)
            document = to_document(problem)
            move_traces(document, Path(problem.folder or "").resolve())
            file.write_text(yaml_of(document), encoding="utf-8")

    def start_agent(self, node: str) -> None:
        """Start a node's agent, or start it again; of every cell that has the node."""
        for problem in self.problems:
            if node not in problem.fabric.nodes:
                continue
            who = f"agent@{node}"
            who = who if len(self.problems) == 1 else f"{who} of {problem.name}"
            state = self.folder_of(problem) / node
            self._start(who, node, ["agent", "--node", node, "--state", str(state)], [problem])

    def start_controllers(self) -> None:
        """Start the controllers, one on every node that decides for cells."""
        for node in dict.fromkeys(problem.controller_node for problem in self.problems):
            self.start_controller(node)

    def start_controller(
        self, node: str, *, out: Path | None = None, more: Sequence[str] = ()
    ) -> None:
        """Start a node's controller, or start it again.

        Parameters
        ----------
        out : Path, optional
            Where the runs' folders go; ``runs`` if left out.
        more : sequence of str
            Further arguments.
        """
        cells = [problem for problem in self.problems if problem.controller_node == node]
        runs = self.folder / "runs" if out is None else out
        words = ["controller", "--out", str(runs), *self._more, *more]
        self._start(f"controller@{node}", node, words, cells)

    def _start(
        self, who: str, node: str, words: Sequence[str], problems: Iterable[Problem]
    ) -> None:
        if self._sweeper is None:
            self._sweeper = start_sweeper()
        command = [sys.executable, "-m", *self._program, *words, OPTION, self._owner]
        if node in self._cpus:
            command += ["--cpus", str(self._cpus[node])]
        for problem in problems:
            command += ["--cell", str(self.file_of(problem))]
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
            if who.partition("@")[2].partition(" of ")[0] == node:
                self.running.pop(who).wait(KILL_S)

    def stop_controllers(self) -> None:
        """End the controllers and wait until they have written their runs."""
        self._end("controller@", CONTROLLER_STOP_S)

    def stop(self) -> None:
        """End all processes, the agents after the controllers, and remove their shared memory."""
        self.stop_controllers()
        self._end("", STOP_S)
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
