"""Agents and controller that one process starts, for a testbed or for `dwell live up`."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from dwell.live.host.state_files import open_own


def agent_words(node: str, cell: Path, state: Path | str) -> list[str]:
    """Return the arguments of `dwell` that run the agent of a node."""
    return ["agent", "--node", node, "--cell", str(cell), "--state", str(state)]


def controller_words(cell: Path, out: Path | str, state: Path | str) -> list[str]:
    """Return the arguments of `dwell` that run the controller of a cell."""
    return ["controller", "--cell", str(cell), "--out", str(out), "--state", str(state)]


class NodeProcesses:
    """Agents and controller of a cell, each with its log in one folder.

    Parameters
    ----------
    file : Path
        Cell file.
    folder : Path
        Folder of the logs, and of a state folder per agent.
    root : Path
        State folder of the controller (see `state_root`).
    environment : mapping of str to str
        Environment of the processes.
    program : sequence of str
        Module that runs agents and controllers, and its first arguments.
    popen : callable
        Starts a command like `Popen`.
    options
        Further options of `popen`.

    Attributes
    ----------
    running : dict of str to Popen
        Running processes by name, such as ``agent@R1`` and ``controller@E``.
    """

    def __init__(
        self,
        file: Path,
        folder: Path,
        *,
        root: Path,
        environment: Mapping[str, str],
        program: Sequence[str] = ("dwell",),
        popen: Callable[..., subprocess.Popen[bytes]] = subprocess.Popen,
        **options: Any,
    ) -> None:
        self.file, self.folder = file, folder
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._root, self._program = root, tuple(program)
        self._popen = partial(popen, stdin=subprocess.DEVNULL, env=dict(environment), **options)

    def start_agent(self, node: str) -> None:
        """Start or restart a node's agent."""
        self._start(f"agent@{node}", agent_words(node, self.file, self.folder / node))

    def start_controller_on(self, node: str, out: Path, more: Sequence[str] = ()) -> None:
        """Start or restart the controller, which writes its runs to `out`."""
        words = controller_words(self.file, out, self._root)
        self._start(f"controller@{node}", [*words, *more])

    def _start(self, who: str, words: Sequence[str]) -> None:
        command = self._on(who.partition("@")[2], [sys.executable, "-m", *self._program, *words])
        with open(self.log(who), "ab", opener=open_own) as log:
            self.running[who] = self._popen(command, stdout=log, stderr=log)

    def _on(self, node: str, command: Sequence[str]) -> Sequence[str]:
        """Return a command that runs a command on a node."""
        return command

    def log(self, who: str) -> Path:
        """Return the log of a process."""
        return self.folder / f"{who}.log"

    def end(self, begin: str, patience_s: float) -> None:
        """End the processes whose names begin with a prefix."""
        names = [who for who in self.running if who.startswith(begin)]
        end_all([self.running.pop(who) for who in names], patience_s)


def end_all(processes: Sequence[subprocess.Popen[bytes]], patience_s: float) -> None:
    """Send SIGTERM to processes, and kill the processes that still run after `patience_s`."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + patience_s
    for process in processes:
        try:
            process.wait(max(deadline - time.monotonic(), 0.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
