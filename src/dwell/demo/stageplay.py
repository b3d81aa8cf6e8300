"""Stageplay: the demo's processes, and what happens to their links and CPUs.

Nothing here moves a stage: it plays a scenario of the cell file on the links and CPUs, and what the
controller makes of it is the controller's.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import yaml

from dwell.demo.link import Forward, LinkProcess
from dwell.errors import LiveError
from dwell.live.leash import OWNER
from dwell.live.transport.orphans import remove_orphans
from dwell.live.wiring import PORTS_PER_ROLE, roles, wire
from dwell.model import (
    Constant,
    Endpoint,
    Host,
    Link,
    LinkDisturbance,
    NodeDisturbance,
    Problem,
)
from dwell.model.document import to_document
from dwell.testbed.burner import Burner
from dwell.testbed.conditions import Conditions

__all__ = ["Change", "Stageplay", "changes_of", "on_this_machine"]

#: Where ports are looked for; below what the kernel gives out by itself.
PORTS = range(10_000, 32_000, 500)
STOP_S = 5.0


@dataclass(frozen=True, slots=True)
class Change:
    """Something that begins or ends in a scenario.

    Parameters
    ----------
    at_s : float
    item : Disturbance
    begins : bool
    """

    at_s: float
    item: NodeDisturbance | LinkDisturbance
    begins: bool


def changes_of(problem: Problem, scenario: str) -> list[Change]:
    """Return what a scenario's disturbances do, in the order of time.

    Raises
    ------
    LiveError
        If it has something that links and CPUs of this machine cannot be made to do.
    """
    found = []
    for item in problem.scenario(scenario):
        if item.down or item.episodes is not None or item.ramp_s:
            raise LiveError(
                f"scenario {scenario!r}: what is down, comes in episodes or has a ramp is not "
                "played here; use at_s and for_s"
            )
        found.append(Change(item.at_s, item, begins=True))
        if item.at_s + item.for_s < float("inf"):
            found.append(Change(item.at_s + item.for_s, item, begins=False))
    return sorted(found, key=lambda change: change.at_s)


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


class Stageplay:
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
    ) -> None:
        self.problem, self.folder, self.cpus, self.seed = problem, folder, cpus, seed
        self.world = folder / "world"
        own = {"DWELL_WORLD": str(self.world), OWNER: str(os.getpid())}
        self.environment = {**own, **(environment or {})}
        self.cell = folder / "cell.yaml"
        self.links: dict[frozenset[str], LinkProcess] = {}
        self.burners: dict[str, Burner] = {}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Stageplay:
        """Start everything."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            text = yaml.safe_dump(to_document(self.problem), sort_keys=False)
            self.cell.write_text(text, encoding="utf-8")
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
        links = self.problem.fabric.links
        return {
            (link.source, link.target): Conditions(
                delay_ms=link.delay_ms, rate_mbps=link.rate_mbps, loss=link.loss
            )
            for link in links.values()
            if {link.source, link.target} == {one, other}
        }

    def expected(self, node: str) -> list[str]:
        """Return the processes of a node that its agent starts, and the agent."""
        return [
            role.who
            for role in roles(self.problem)
            if role.node == node and role.kind != "controller"
        ]

    def start_agent(self, node: str) -> None:
        """Start a node's agent, or start it again."""
        arguments = ["agent", "--node", node, "--state", str(self.folder / node)]
        self._start(f"agent@{node}", [*arguments, *self._on_cpus(node)])

    def start_controller(self) -> None:
        """Start the controller, or start it again."""
        node = self.problem.controller_node
        arguments = ["controller", "--out", str(self.folder / "runs")]
        self._start(f"controller@{node}", [*arguments, *self._on_cpus(node)])

    def _on_cpus(self, node: str) -> list[str]:
        return ["--cpus", str(self.cpus[node])] if node in self.cpus else []

    def _start(self, who: str, arguments: Sequence[str]) -> None:
        command = [sys.executable, "-m", "dwell", *arguments, "--cell", str(self.cell)]
        with (self.folder / f"{who}.log").open("ab") as log:
            self.processes[who] = subprocess.Popen(  # noqa: S603 - our own command
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env={**os.environ, **self.environment},
                process_group=0,
            )

    def apply(self, change: Change) -> None:
        """Have links and CPUs do what begins or ends."""
        item = change.item
        if isinstance(item, NodeDisturbance):
            self.burners[item.node].set(item.stress_threads if change.begins else 0)
            return
        link = self.links[frozenset((item.source, item.target))]
        usual = self.problem.fabric.links[item.link]
        if not change.begins:
            disturbed: dict[str, Any] = {"rate_mbps": usual.rate_mbps, "loss": usual.loss}
            disturbed["add_delay_ms"] = Constant(0.0)
        else:
            disturbed = dict(_disturbed(usual, item))
        link.set(item.source, item.target, **disturbed)

    def stop_controller(self) -> None:
        """End the controller and wait until it has written its run."""
        self._end([who for who in self.processes if who.startswith("controller@")], 30.0)

    def _end(self, names: Sequence[str], patience_s: float) -> None:
        running = [self.processes.pop(who) for who in names]
        for process in running:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + patience_s
        for process in running:
            try:
                process.wait(max(deadline - time.monotonic(), 0.1))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def close(self) -> None:
        """End every process, links and burners last."""
        self.stop_controller()
        self._end(list(self.processes), STOP_S)
        self._stack.close()
        remove_orphans()


def _disturbed(usual: Link, item: LinkDisturbance) -> Iterator[tuple[str, object]]:
    if item.add_delay_ms is not None:
        yield "add_delay_ms", item.add_delay_ms
    if item.loss:
        yield "loss", 1 - (1 - usual.loss) * (1 - item.loss)
    if item.rate_mbps is not None:
        yield "rate_mbps", min(usual.rate_mbps, item.rate_mbps)
