"""Placement: which node each task runs on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from dwell.errors import PlacementError
from dwell.model.frozen import FrozenDict


class Placement(FrozenDict[str, str]):
    """An immutable mapping of every task of a pipeline to the node it runs on.

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

    def __init__(self, nodes: Mapping[str, str] | Iterable[tuple[str, str]]) -> None:
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

    def moved(self, other: Placement) -> tuple[str, ...]:
        """Tasks that change node between the two, in this placement's order."""
        return tuple(task for task, node in self.items() if other[task] != node)
