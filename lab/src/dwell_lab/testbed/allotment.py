"""Allotment: which CPUs of this machine each node gets, and whether they are enough for all.

A node's quota is worth something only if it gets that time whenever it wants it. So some of every
CPU stays free, for the links' processes, the kernel and whoever watches.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from dwell.errors import LiveError
from dwell.model import Node, Problem
from dwell_lab.testbed.groups import Share

#: Of every CPU, and of all together, what no node gets.
FREE_OF_A_CORE, FREE_CORES = 0.2, 0.4
TOLERANCE = 1e-9


@dataclass(slots=True)
class _Cpus:
    """CPUs with the share of each that is left."""

    left: dict[int, float] = field(default_factory=dict)

    def take(self, node: Node) -> tuple[int, ...] | None:
        """Take the CPUs with most left: robots from the first on, other nodes from the last."""
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
    """Return the nodes of some cells; those of one name are one computer.

    Raises
    ------
    LiveError
        If two cells say different things of a node that they share.
    """
    nodes: dict[str, Node] = {}
    faults = [
        f"nodes.{name}: two cells share it and say different things of it"
        for problem in problems
        for name, node in problem.fabric.nodes.items()
        if nodes.setdefault(name, node) != node
    ]
    if faults:
        raise LiveError("; ".join(dict.fromkeys(faults)))
    return nodes


def allot(problems: Sequence[Problem], cpus: Collection[int]) -> dict[str, Share]:
    """Give every node of some cells its share of the CPUs of this machine that may be used.

    Raises
    ------
    LiveError
        With everything that does not fit, and what would help.
    """
    nodes = _nodes_of(problems)
    left = _Cpus(dict.fromkeys(sorted(cpus), 1.0 - FREE_OF_A_CORE))
    # What wants most has the least choice.
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
                f"nodes.{name} has no quota, and would take {node.cores} whole; give it one, as "
                "quota: {cpu: 0.4, period_ms: 4}"
            )
        elif taken[name] is None:
            yield (
                f"nodes.{name}: no CPU has {node.capacity:g} left of the "
                f"{1 - FREE_OF_A_CORE:g} that nodes may have of each"
            )
    wanted, most = sum(node.capacity for node in nodes.values()), cpus - FREE_CORES
    if wanted > most + TOLERANCE:
        yield f"all together want {wanted:g} of {most:g} (what there is, less {FREE_CORES:g})"
