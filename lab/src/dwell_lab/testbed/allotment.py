"""Allotment: the CPUs of this machine for each node, and a check that they are enough.

A node must get its quota whenever it needs it. So part of every CPU stays free for the links'
processes, the kernel and the samplers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from dwell.errors import LiveError
from dwell.model import Node, Problem
from dwell_lab.testbed.groups import Share

#: CPU time that stays free on each CPU, and on all CPUs together.
FREE_OF_A_CORE, FREE_CORES = 0.2, 0.4
TOLERANCE = 1e-9


@dataclass(slots=True)
class _Cpus:
    """CPUs with the free share of each."""

    left: dict[int, float] = field(default_factory=dict)

    def take(self, node: Node) -> tuple[int, ...] | None:
        """Take the CPUs with the largest free share; robots take low numbers first."""
        count = min(node.cores, len(self.left))
        sign = 1 if node.tier == "robot" else -1
        best = sorted(self.left, key=lambda cpu: (-self.left[cpu], sign * cpu))[:count]
        share = node.capacity / count
        if count < node.capacity or any(self.left[cpu] + TOLERANCE < share for cpu in best):
            return None
        for cpu in best:
            self.left[cpu] -= share
        return tuple(sorted(best))


def _nodes_of(problems: Iterable[Problem]) -> dict[str, Node]:
    """Return the nodes of some cells; nodes with the same name are one computer.

    Raises `LiveError` if two cells describe a shared node differently.
    """
    nodes: dict[str, Node] = {}
    faults = [
        f"nodes.{name}: two cells share this node and describe it differently"
        for problem in problems
        for name, node in problem.fabric.nodes.items()
        if nodes.setdefault(name, node) != node
    ]
    if faults:
        raise LiveError("; ".join(dict.fromkeys(faults)))
    return nodes


def allot(problems: Sequence[Problem], cpus: Collection[int]) -> dict[str, Share]:
    """Give every node of some cells its share of the permitted CPUs of this machine.

    Raises `LiveError` with all nodes that do not fit, and remedies.
    """
    nodes = _nodes_of(problems)
    left = _Cpus(dict.fromkeys(sorted(cpus), 1.0 - FREE_OF_A_CORE))
    # Large nodes fit in few places, so they choose first.
    order = sorted(nodes.values(), key=lambda node: (-node.capacity, node.tier == "robot"))
    taken = {node.name: left.take(node) for node in order}
    faults = list(_faults(nodes, taken, len(cpus)))
    if faults:
        raise LiveError(
            f"this machine has {len(cpus)} CPUs, too few for these nodes: {'; '.join(faults)}"
        )
    shares = {name: Share(taken[name] or (), node.quota) for name, node in nodes.items()}
    if faults := [fault for name, share in shares.items() for fault in share.faults(name)]:
        raise LiveError("; ".join(faults))
    return shares


def _faults(
    nodes: Mapping[str, Node], taken: Mapping[str, tuple[int, ...] | None], cpus: int
) -> Iterable[str]:
    for name, node in nodes.items():
        if taken[name] is None and node.quota is None:
            yield (
                f"nodes.{name} has no quota, and would take {node.cores} CPUs; set one: "
                "quota: {cpu: 0.4, period_ms: 4}"
            )
        elif taken[name] is None:
            yield (
                f"nodes.{name}: no CPU has {node.capacity:g} free of the "
                f"{1 - FREE_OF_A_CORE:g} per CPU that nodes may use"
            )
    wanted, most = sum(node.capacity for node in nodes.values()), cpus - FREE_CORES
    if wanted > most + TOLERANCE:
        yield f"all nodes need {wanted:g} CPUs; {most:g} are available ({FREE_CORES:g} stay free)"
