"""Testbed on this machine: a cell on network namespaces as hosts, with links and CPU quotas.

The testbed applies the disturbances of a scenario to nodes and links. Only the controller moves
stages.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

from dwell.errors import LiveError
from dwell.live.host.security import INSECURE
from dwell.live.local.burner import Burner, stress
from dwell.live.local.conditions import Conditions, fields_of
from dwell.live.local.message_links import LinkFile
from dwell.live.local.playing import undisturbed
from dwell.live.local.process import program
from dwell.live.local.processes import Processes, with_hosts
from dwell.live.local.testbed import LocalTestbed
from dwell.live.local.timeline import NodeState, usual_conditions
from dwell.live.transport.orphans import remove_orphans
from dwell.model import Node, Problem
from dwell_lab.testbed.allotment import allot
from dwell_lab.testbed.groups import PROBES, Groups, Share
from dwell_lab.testbed.hosts import Hosts
from dwell_lab.testbed.leftovers import Claim
from dwell_lab.testbed.link import TunLink
from dwell_lab.testbed.watcher import Watcher

FIRST_PORT = 7_450
LINK_FILE = "links"


def require_playable(problem: Problem) -> None:
    """Raise a LiveError that lists all features of a cell that a testbed does not support."""
    faults = [
        f"nodes.{node.name}.bursts: drawn foreign work is not played"
        for node in problem.fabric.nodes.values()
        if node.bursts is not None
    ]
    faults += [
        f"links {link.name}: bursts of extra delay are not played"
        for link in problem.fabric.links.values()
        if link.bursts is not None
    ]
    if faults:
        raise LiveError("; ".join(faults))


class NetnsTestbed(LocalTestbed):
    """Context manager that runs a cell on emulated hosts of this machine.

    Parameters
    ----------
    problem : Problem
        The cell; the attribute `problem` becomes a copy with the addresses of the hosts.
    folder : Path
        Folder for the cell file, states, logs and runs.
    name : str
        Name of this testbed, unique on this machine.
    seed : int
        Seed of delays and losses.
    more : sequence of str
        Further arguments of the controller.
    environment : mapping of str to str, optional
        Additional environment variables of all processes.
    clocks : Path, optional
        File of a `ClockFile` with the errors of the nodes' clocks.

    Attributes
    ----------
    links : dict of frozenset of str to TunLink
        Links by pair of nodes.
    watcher : Watcher
        Process that requests the status of the cell.

    Raises
    ------
    LiveError
        If the testbed does not support the cell, or this machine has too few CPUs for its nodes.
    """

    own_cpus = True

    def __init__(
        self,
        problem: Problem,
        folder: Path,
        *,
        name: str,
        seed: int = 0,
        more: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
        clocks: Path | None = None,
    ) -> None:
        super().__init__()
        self.problem = problem
        require_playable(problem)
        self.shares = allot([problem], sorted(os.sched_getaffinity(0)))
        self.nodes: Mapping[str, Node] = problem.fabric.nodes
        self.folder, self.name, self.seed = folder.resolve(), name, seed
        self.links: dict[frozenset[str], TunLink] = {}
        self.stress: dict[str, Burner] = {}
        self._usual = problem.fabric.links
        self._more = tuple(more)
        self._environment, self._clocks = dict(environment or {}), clocks
        self.conditions = {name: usual_conditions(link) for name, link in self._usual.items()}
        self._down: set[str] = set()
        self._claim = Claim(name, list(self.nodes))

    # --------------------------------------------------------------------- up and down

    def claim(self) -> None:
        """Take the name, and remove the leftovers of a dead testbed of this name.

        Raises
        ------
        LiveError
            If a testbed of this name runs, or other namespaces or groups use the name.
        """
        self._stack.enter_context(self._claim)

    def _start(self) -> None:
        """Create hosts, links and groups, start all processes, and begin a run."""
        self.claim()
        self._stack.callback(remove_orphans)
        self._make()
        for node in self.nodes:
            self.processes.start_agent(node)
        # Under a small robot's quota, starting the interpreters would take most of a minute.
        with self._groups.unlimited():
            self._come_up()
        self.begun_ns = self.begin()

    def _make(self) -> None:
        enter = self._stack.enter_context
        # Every agent of a cell communicates with every other.
        nodes, pairs = list(self.nodes), list(combinations(self.nodes, 2))
        self._hosts = enter(Hosts(self.name, nodes, pairs))
        self._groups = enter(Groups(self.name, {**self.shares, PROBES: Share()}))
        self.problem = with_hosts(self.problem, self._hosts.address, FIRST_PORT)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._losses = enter(closing(LinkFile(self.folder / LINK_FILE, nodes, seed=self.seed)))
        for number, pair in enumerate(pairs):
            self.links[frozenset(pair)] = enter(self._link(pair, number))
        for link in self._usual.values():
            if link.retransmit_ms is None:
                self._losses.set(link.source, link.target, loss=link.loss)
        for node in nodes:
            self._start_stress(node)
        self._stack.callback(self._stop_stress)
        environment = {
            "DWELL_WORLD": str(self.folder / "world"),
            # The hosts can reach only each other.
            INSECURE: "1",
            **self._environment,
        }
        self.processes = Processes(
            self.problem,
            self.folder,
            inside=self._inside,
            environment=environment,
            more=self._more,
            program=program(links=self._losses.path, clocks=self._clocks),
        )
        self.processes.write()
        self._stack.callback(self.processes.stop)
        beside_controller = self.beside(self.problem.controller_node)
        self.watcher = enter(Watcher(self.processes.file, beside_controller))

    @property
    def probing(self) -> list[str]:
        """Command prefix that runs a process outside all nodes, with a node's CPU weight."""
        return self._groups.inside(PROBES, [])

    def beside(self, node: str) -> list[str]:
        """Return a command prefix that runs a process on a node's host, outside its group."""
        return self._hosts.inside(node, [])

    def _inside(self, node: str, words: Sequence[str]) -> Sequence[str]:
        return self._groups.inside(node, self._hosts.inside(node, words))

    def _link(self, pair: tuple[str, str], number: int) -> TunLink:
        """Return the link of a pair of nodes; directions that the cell lacks have no delay."""
        usual: dict[tuple[str, str], Conditions] = {}
        retransmit_ms: dict[tuple[str, str], float] = {}
        for link in self._usual.values():
            if {link.source, link.target} != set(pair):
                continue
            way = link.source, link.target
            usual[way] = usual_conditions(link)
            if link.retransmit_ms is None:
                usual[way] = replace(usual[way], loss=0.0)
            else:
                retransmit_ms[way] = link.retransmit_ms
        one, other = pair
        devices = {one: self._hosts.tun(one, other), other: self._hosts.tun(other, one)}
        seed = self.seed * len(self.nodes) ** 2 + number
        return TunLink(pair, devices, usual, retransmit_ms=retransmit_ms, seed=seed)

    def _start_stress(self, node: str) -> None:
        self.stress[node] = stress(self._groups.inside(node, []), self.shares[node].cpus)
        self.stress[node].start()

    def _stop_stress(self) -> None:
        for node in list(self.stress):
            self.stress.pop(node).stop()

    def stop(self) -> None:
        """End all processes, and remove hosts, links and groups; may be called twice."""
        with undisturbed():
            super().stop()

    # ------------------------------------------------------------------------- running

    def sample(self, patience_s: float) -> Mapping[str, Any]:
        """Return the status of the cell, from its controller."""
        return self.watcher.status(patience_s)

    # --------------------------------------------------------------------- disturbances

    def _apply_to_node(self, node: str, state: NodeState) -> None:
        was_down = node in self._down
        if state.down and not was_down:
            self._down.add(node)
            # Kill all processes at once, like a loss of power.
            self._groups.kill(node)
            self.processes.forget(node)
            with suppress(LiveError):
                self.stress.pop(node).stop()
        elif not state.down:
            if was_down:
                self._down.remove(node)
                self._start_stress(node)
            self.stress[node].set(state.threads)
            if was_down:
                self.processes.start_agent(node)
                if node == self.problem.controller_node:
                    self.processes.start_controller()

    def _apply_to_link(self, name: str, now: Conditions) -> None:
        link, self.conditions[name] = self._usual[name], now
        if link.retransmit_ms is None:
            self._losses.set(link.source, link.target, loss=now.loss)
            now = replace(now, loss=0.0)
        way = self.links[frozenset((link.source, link.target))]
        way.set(link.source, link.target, **fields_of(now))

    def cut(self, source: str, target: str, at_ns: int) -> int:
        """Cut a direction of a link; return the instant of the cut."""
        way = self.links[frozenset((source, target))]
        return way.set(source, target, at_ns=at_ns, down=True)

    def heal(self, source: str, target: str) -> None:
        """End a cut."""
        self.links[frozenset((source, target))].set(source, target, down=False)

    # ---------------------------------------------------------------------------- facts

    def taps(self) -> Mapping[tuple[str, ...], Sequence[str]]:
        """Return the command prefix for each node that runs a process on its host."""
        return {(node,): self.beside(node) for node in self.problem.fabric.nodes}

    @property
    def used_ns(self) -> dict[str, Callable[[], int]]:
        """Functions that return the CPU time of a node so far, by node."""
        return {node: partial(self._groups.used_ns, node) for node in self.nodes}

    @property
    def switches(self) -> dict[str, Callable[[], dict[int, int]]]:
        """Functions that return how often each thread of a node has slept so far, by node."""
        return {node: partial(self._groups.switches, node) for node in self.nodes}

    @property
    def cpus(self) -> list[int]:
        """CPUs that nodes use."""
        return sorted({cpu for share in self.shares.values() for cpu in share.cpus})

    def facts(self) -> dict[str, Any]:
        """Return a description of the testbed for the record of a run, as a JSON document."""
        return {
            "name": self.name,
            "kernel": os.uname().release,
            "cpus": os.cpu_count(),
            "nodes": {
                node: {
                    "cpus": list(share.cpus),
                    "quota": share.quota
                    and {"cpu": share.quota.cpu, "period_ms": share.quota.period_ms},
                }
                for node, share in self.shares.items()
            },
            "links": {
                "-".join(link.nodes): {"scheduling": link.scheduling}
                for link in self.links.values()
            },
        }
