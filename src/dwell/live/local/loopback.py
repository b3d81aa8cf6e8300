"""Testbed on this machine without root: agents, controller, emulated links, busy threads.

It applies a scenario of the cell file to the links and CPUs. Only the controller moves stages.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.live.host.hosting import clock_of
from dwell.live.host.operator_client import OperatorClient
from dwell.live.local.burner import Burner
from dwell.live.local.conditions import Conditions, fields_of
from dwell.live.local.message_links import LinkFile
from dwell.live.local.process import program
from dwell.live.local.processes import Processes, with_hosts, without_keys
from dwell.live.local.testbed import LocalTestbed
from dwell.live.local.timeline import NodeState, usual_conditions
from dwell.live.wire.wiring import PORTS_PER_ROLE, roles
from dwell.model import Problem

ADDRESS = "127.0.0.1"
#: First ports to try; below the kernel's ephemeral ports.
PORTS = range(10_000, 32_000, 500)
LINK_FILE = "links"


def on_this_machine(problem: Problem) -> Problem:
    """Return the cell with all nodes on free ports of this machine.

    Raises a LiveError if too few consecutive ports are free.
    """
    count = PORTS_PER_ROLE * len(roles(problem))
    # The ports are opened later, so concurrent processes start the search at different ports.
    begin = os.getpid() % max(len(PORTS) // 3, 1)
    for base in (*PORTS[begin:], *PORTS[:begin]):
        if all(_free(port) for port in range(base, base + count)):
            return with_hosts(problem, lambda node: ADDRESS, base)
    raise LiveError(f"no {count} free ports in a row on this machine")


def _free(port: int) -> bool:
    with socket.socket() as one:
        try:
            one.bind((ADDRESS, port))
        except OSError:
            return False
    return True


class Loopback(LocalTestbed):
    """A cell on this machine: agents, controller, links, burners; a context manager.

    Parameters
    ----------
    problem : Problem
        Cell from `on_this_machine`.
    folder : Path
        Folder for the cell file, states, logs and runs.
    cpus : mapping of str to int
        CPU of each node and its burner; a missing node uses any CPU, and has no burner.
    seed : int
        Seed of delays and losses.
    environment : mapping of str to str, optional
        Additional variables of all processes.
    clocks : Path, optional
        `ClockFile` with the errors of the nodes' clocks.

    Attributes
    ----------
    client : OperatorClient
        Client of the controller, after the start.
    world : Path
        Simulated world, which camera and arm share (see `World`).
    """

    own_cpus = False
    start_s = 60.0

    def __init__(
        self,
        problem: Problem,
        folder: Path,
        cpus: Mapping[str, int],
        *,
        seed: int = 0,
        environment: Mapping[str, str] | None = None,
        clocks: Path | None = None,
    ) -> None:
        super().__init__()
        self.problem, self.folder, self.cpus, self.seed = problem, folder, cpus, seed
        self.world = folder / "world"
        self.burners: dict[str, Burner] = {}
        self.processes = Processes(
            problem,
            folder,
            environment={"DWELL_WORLD": str(self.world), **(environment or {})},
            cpus=cpus,
            program=program(links=folder / LINK_FILE, clocks=clocks),
        )
        links = problem.fabric.links.items()
        self.conditions = {name: usual_conditions(link) for name, link in links}
        self._threads: dict[str, int] = {}

    def _start(self) -> None:
        """Start all parts, and wait until all processes are ready; the run begins before that."""
        self.processes.write()
        nodes, links = tuple(self.problem.fabric.nodes), tuple(self.problem.fabric.links.values())
        self._links = LinkFile(self.folder / LINK_FILE, nodes, links, seed=self.seed)
        self._stack.callback(self._links.close)
        for link in links:
            self._links.set(link.source, link.target, **fields_of(self.conditions[link.name]))
        for cpu in sorted(set(self.cpus.values())):
            burner = self._stack.enter_context(Burner([cpu]))
            for node in (node for node, its in self.cpus.items() if its == cpu):
                self.burners[node] = burner
        # The processes end before the links and burners.
        self._stack.callback(self.processes.stop)
        for node in self.problem.fabric.nodes:
            self.processes.start_agent(node)
        self.processes.start_controller()
        self.client = self._stack.enter_context(OperatorClient(self.problem, without_keys()))
        status = self._came_up()
        self.begun_ns = int(status.get("origin_ns") or clock_of(self.problem)())

    def _apply_to_node(self, node: str, state: NodeState) -> None:
        self._threads[node] = state.threads
        burner = self.burners[node]
        nodes = [node for node, its in self.burners.items() if its is burner]
        burner.set(sum(self._threads.get(node, 0) for node in nodes))

    def _apply_to_link(self, name: str, now: Conditions) -> None:
        link, self.conditions[name] = self.problem.fabric.links[name], now
        self._links.set(link.source, link.target, **fields_of(now))

    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction at a time, so its later messages are lost; return the actual time."""
        time.sleep(max(at_ns - time.monotonic_ns(), 0) / 1e9)
        self._links.set(source, target, down=True)
        return time.monotonic_ns()

    def heal(self, source: str, target: str) -> None:
        """End a cut of a direction."""
        self._links.set(source, target, down=False)

    def sample(self, patience_s: float) -> Mapping[str, Any]:
        """Return the status of the cell, from its controller."""
        return self.client.ask("status", patience_s=patience_s)

    def taps(self) -> Mapping[tuple[str, ...], Sequence[str]]:
        """Return the empty command prefix, which reaches all nodes."""
        return {tuple(self.problem.fabric.nodes): ()}
