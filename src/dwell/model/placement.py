"""Placement: which node each task runs on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeAlias, cast

from dwell.errors import PlacementError
from dwell.model.frozen import FrozenDict

#: Node of a task, or the nodes of its two copies.
Nodes: TypeAlias = str | tuple[str, str]
#: Node of each task for one copy of a cycle.
Copy: TypeAlias = FrozenDict[str, str]


class Placement(FrozenDict[str, Nodes]):
    """An immutable mapping of every task of a pipeline to the node it runs on.

    Only in `Replicas` a task may have two nodes.

    Parameters
    ----------
    nodes : mapping of str to str, or pairs
        Task name to node name; at least one task.

    Raises
    ------
    PlacementError
        If it is empty, or a task or node is not a non-empty string.
    """

    __slots__ = ()

    def __init__(
        self, nodes: Mapping[str, str] | Mapping[str, Nodes] | Iterable[tuple[str, str]]
    ) -> None:
        super().__init__(nodes)
        if not self:
            raise PlacementError("a placement must place at least one task; it is empty")
        for task, node in self.items():
            for word, what in ((task, "task"), (node, "node")):
                if not isinstance(word, str) or not word:
                    raise PlacementError(
                        f"placement {dict(self)!r}: {what} {word!r} must be a non-empty name"
                    )

    def __repr__(self) -> str:
        """Return ``Placement({'perception': 'E', ...})``."""
        return f"Placement({dict(self)!r})"

    @property
    def copies(self) -> tuple[Copy, ...]:
        """The placement of each copy of a cycle: one, or two for `Replicas`."""
        return (cast("Copy", self),)

    @property
    def first(self) -> Copy:
        """The placement of the first copy, which is the only copy except for `Replicas`."""
        return self.copies[0]

    @property
    def second(self) -> Copy | None:
        """The placement of the second copy; None except for `Replicas`."""
        return None

    @property
    def sites(self) -> tuple[tuple[str, str], ...]:
        """Task and node of each job of a cycle, the first copy's first."""
        return tuple(dict.fromkeys(site for copy in self.copies for site in copy.items()))

    @property
    def nodes(self) -> frozenset[str]:
        """The nodes on which its tasks run."""
        return frozenset(node for copy in self.copies for node in copy.values())

    def moved(self, other: Placement) -> tuple[str, ...]:
        """Tasks whose set of nodes changes between the two, in this placement's order."""
        return tuple(
            task
            for task, nodes in self.items()
            if other[task] != nodes and {*nodes_of(other[task])} != {*nodes_of(nodes)}
        )


class Replicas(Placement):
    """A placement that sends each cycle through two copies, under two other candidates.

    Parameters
    ----------
    members : mapping of str to Placement
        The two candidates, by name; the first copy runs under the first.
    after_ms : float
        Time from a cycle's release until messages go to the second copy.

    Raises
    ------
    PlacementError
        If there are not two members, a member has replicas itself, or both are equal.
    """

    __slots__ = ("_copies", "after_ms", "members")

    def __init__(self, members: Mapping[str, Placement], after_ms: float = 0.0) -> None:
        if len(members) != 2 or any(isinstance(one, Replicas) for one in members.values()):
            raise PlacementError(f"replicas need two plain placements; they are {[*members]}")
        first, second = (one.first for one in members.values())
        if first.keys() != second.keys() or first == second:
            raise PlacementError(f"replicas {[*members]} must place the same tasks differently")
        # The values of a dict are set once, by its constructor.
        dict.__init__(
            self,
            {
                task: node if second[task] == node else (node, second[task])
                for task, node in first.items()
            },
        )
        self.members = tuple(members)
        self._copies = first, second
        self.after_ms = after_ms

    def __repr__(self) -> str:
        """Return ``Replicas({'LOC': Placement(...), 'SO': Placement(...)}, after_ms=10.0)``."""
        members = dict(zip(self.members, map(Placement, self._copies), strict=True))
        return f"Replicas({members!r}, after_ms={self.after_ms!r})"

    def __eq__(self, other: object) -> bool:
        """Whether the members are equal in order, and `after_ms` is."""
        if not isinstance(other, Replicas):
            return False
        mine, theirs = ((one.members, one.copies, one.after_ms) for one in (self, other))
        return mine == theirs

    def __ne__(self, other: object) -> bool:
        """Whether they are not equal."""
        return not self == other

    def __hash__(self) -> int:  # type: ignore[override]
        """Hash what `__eq__` compares."""
        return hash((self.members, self._copies, self.after_ms))

    def __reduce__(self) -> tuple[type, tuple[dict[str, Placement], float]]:  # type: ignore[override]
        """Pickle and copy through the constructor."""
        placements = [Placement(dict(one)) for one in self._copies]
        return type(self), (dict(zip(self.members, placements, strict=True)), self.after_ms)

    @property
    def copies(self) -> tuple[Copy, ...]:
        """The placements of the first and of the second copy."""
        return self._copies

    @property
    def second(self) -> Copy:
        """The placement of the second copy."""
        return self._copies[1]

    @property
    def doubled(self) -> tuple[str, ...]:
        """Tasks that run once per copy, on two nodes."""
        return tuple(task for task, nodes in self.items() if isinstance(nodes, tuple))


def nodes_of(nodes: Nodes) -> tuple[str, ...]:
    """Return the nodes of a task, of the first copy first."""
    return nodes if isinstance(nodes, tuple) else (nodes,)


def plain_candidates(candidates: Mapping[str, Placement]) -> dict[str, Placement]:
    """Return the candidates with one copy of each cycle."""
    return {name: one for name, one in candidates.items() if one.second is None}


def written_nodes(nodes: Nodes) -> str:
    """Return the nodes of a task as text: ``E``, or ``R1 + E`` for two copies."""
    return " + ".join(nodes_of(nodes))
