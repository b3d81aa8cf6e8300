"""Runs the demo's processes on this machine, and plays a scenario on their links and CPUs.

Nothing here moves a stage: it plays a scenario of the cell file on the links and CPUs, and what the
controller makes of it is the controller's.
"""

from __future__ import annotations

import socket
import subprocess
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from dwell.demo.link import Forward, LinkProcess
from dwell.errors import LiveError
from dwell.live.wiring import PORTS_PER_ROLE, roles, wire
from dwell.model import Endpoint, Host, Problem
from dwell.testbed.burner import Burner
from dwell.testbed.conditions import Conditions
from dwell.testbed.process import program
from dwell.testbed.processes import Processes, expected
from dwell.testbed.timeline import Change, differing, usual_conditions

__all__ = ["Loopback", "on_this_machine"]

#: Where ports are looked for; below what the kernel gives out by itself.
PORTS = range(10_000, 32_000, 500)


def on_this_machine(problem: Problem) -> Problem:
    """Return the cell with all its nodes on this machine, and links in between.

    Every node gets ports that are free now, and is reached from the others through the ports of a
    `LinkProcess`.

    Raises
    ------
    LiveError
        If there are not enough ports.
    """
    nodes = list(problem.fabric.nodes)
    counts = {
        node: PORTS_PER_ROLE * sum(role.node == node for role in roles(problem)) for node in nodes
    }
    size = sum(counts.values())
    # A block for the nodes themselves, and one for what each of them is reached by from others.
    for base in PORTS:
        blocks = range(base, base + (1 + len(nodes)) * size, size)
        if not all(_free(port) for port in range(blocks[0], blocks[-1] + size)):
            continue
        first, hosts = 0, {}
        for node in nodes:
            seen = {
                other: Endpoint("127.0.0.1", block + first)
                for other, block in zip(nodes, blocks[1:], strict=True)
                if other != node
            }
            hosts[node] = Host("127.0.0.1", base + first, seen)
            first += counts[node]
        return replace(problem, live=replace(problem.live, hosts=hosts))
    raise LiveError(f"no {(1 + len(nodes)) * size} free ports in a row on this machine")


def _free(port: int) -> bool:
    with socket.socket() as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class Loopback:
    """A cell on this machine: agents, controller, links, burners; a context manager.

    Parameters
    ----------
    problem : Problem
        From `on_this_machine`.
    folder : Path
        For the cell file, states, logs and runs.
    cpus : mapping of str to int
        Of each node, and of its burners; a node that is not there uses any, and has none.
    seed : int
        Of delays and losses.
    environment : mapping of str to str, optional
        Variables that all processes get as well.
    clocks : Path, optional
        What is wrong with the nodes' clocks, of a `ClockFile`.

    Attributes
    ----------
    world : Path
        Where the world is that its camera and arm share (see `World`).
    """

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
        self.problem, self.folder, self.cpus, self.seed = problem, folder, cpus, seed
        self.world = folder / "world"
        self.links: dict[frozenset[str], LinkProcess] = {}
        self.burners: dict[str, Burner] = {}
        self._processes = Processes(
            [problem],
            folder,
            environment={"DWELL_WORLD": str(self.world), **(environment or {})},
            cpus=cpus,
            program=program(clocks=clocks),
        )
        links = problem.fabric.links.items()
        self._conditions = {name: usual_conditions(link) for name, link in links}
        self._threads: dict[str, int] = {}
        self._stack = ExitStack()

    @property
    def processes(self) -> dict[str, subprocess.Popen[bytes]]:
        """Agents and controller, by name."""
        return self._processes.running

    def __enter__(self) -> Loopback:
        """Start everything."""
        try:
            self._processes.write()
            self._start_links()
            for cpu in sorted(set(self.cpus.values())):
                burner = Burner([cpu])
                burner.start()
                self._stack.callback(burner.stop)
                for node in (node for node, its in self.cpus.items() if its == cpu):
                    self.burners[node] = burner
            for node in self.problem.fabric.nodes:
                self.start_agent(node)
            self.start_controller()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End everything."""
        self.close()

    def _start_links(self) -> None:
        by_pair: dict[frozenset[str], list[Forward]] = {}
        for passage in wire(self.problem).passages:
            pair = frozenset((passage.source, passage.target))
            to, seen = passage.to, passage.seen
            forward = Forward(passage.source, to.address, to.port, seen.port)
            by_pair.setdefault(pair, []).append(forward)
        for one, other in combinations(self.problem.fabric.nodes, 2):
            pair = frozenset((one, other))
            if pair not in by_pair:
                continue
            link = LinkProcess((one, other), by_pair[pair], self._usual(one, other), seed=self.seed)
            link.start()
            self._stack.callback(link.stop)
            self.links[pair] = link

    def _usual(self, one: str, other: str) -> dict[tuple[str, str], Conditions]:
        links = self.problem.fabric.links.values()
        return {
            (link.source, link.target): usual_conditions(link)
            for link in links
            if {link.source, link.target} == {one, other}
        }

    def expected(self, node: str) -> list[str]:
        """Return the processes of a node that its agent starts, and the agent."""
        return expected(self.problem, node)

    def start_agent(self, node: str) -> None:
        """Start a node's agent, or start it again."""
        self._processes.start_agent(node)

    def start_controller(self) -> None:
        """Start the controller, or start it again."""
        self._processes.start_controllers()

    def apply(self, change: Change) -> None:
        """Have a link, or a node's CPU, be as a change says."""
        place, state = change.place, change.state
        if not isinstance(state, Conditions):
            self._threads[place] = state.threads
            burner = self.burners[place]
            nodes = [node for node, its in self.burners.items() if its is burner]
            burner.set(sum(self._threads.get(node, 0) for node in nodes))
            return
        link = self.problem.fabric.links[place]
        changes = differing(self._conditions[place], state)
        self._conditions[place] = state
        if changes:
            way = self.links[frozenset((link.source, link.target))]
            way.set(link.source, link.target, **changes)

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        self._processes.stop_controllers()

    def close(self) -> None:
        """End every process, links and burners last."""
        self._processes.stop()
        self._stack.close()
