"""Emulated link: the parent's side of a process that delays and loses what two nodes send."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import cast

from dwell.errors import LiveError
from dwell.testbed.child import Child, Json, Started
from dwell.testbed.conditions import Conditions, Scheduling, to_json

__all__ = ["EmulatedLink"]


class EmulatedLink(Started):
    """A link between two nodes whose conditions can be changed at any time; a context manager.

    Parameters
    ----------
    module : str
        Of the process.
    nodes : pair of str
    descriptors : sequence of int
        Open files that it has under the same numbers.
    """

    def __init__(
        self, module: str, nodes: tuple[str, str], descriptors: Sequence[int] = ()
    ) -> None:
        self.nodes = nodes
        self.name = f"link {nodes[0]}-{nodes[1]}"
        #: How well it can keep its instants beside busy threads.
        self.scheduling: Scheduling = "usual"
        self._child = Child(module, self.name, descriptors)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    @property
    def ways(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Both directions, as (source, target)."""
        first, second = self.nodes
        return (first, second), (second, first)

    def stop(self) -> None:
        """End it; what is on its way is lost. Safe to call twice."""
        self._child.stop()

    def set(self, source: str, target: str, *, at_ns: int | None = None, **changes: object) -> int:
        """Change some conditions of a direction for what begins its way from then on.

        Parameters
        ----------
        source, target : str
        at_ns : int, optional
            When, by the monotonic clock; at once if left out or past.
        **changes
            Fields of `Conditions`.

        Returns
        -------
        int
            The instant from which they hold, ns of the monotonic clock.

        Raises
        ------
        LiveError
            If there is no such direction or field, a value is out of its bounds or none that this
            kind of link has, or the process has ended.
        """
        return self._send([self._change(source, target, changes)], at_ns)

    def _started(self, settings: Json) -> Json:
        """Start the process; returns what it says of itself."""
        answer = self._child.start(settings)
        self.scheduling = cast("Scheduling", answer["scheduling"])
        return answer

    def _usual(self, conditions: Mapping[tuple[str, str], Conditions]) -> list[Json]:
        """Return the changes that make up the conditions at the beginning."""
        return [
            self._change(*way, {name: getattr(each, name) for name in Conditions.__slots__})
            for way, each in conditions.items()
        ]

    def _require(self, source: str, target: str) -> None:
        if (source, target) not in self.ways:
            raise LiveError(f"{self.name} does not go from {source} to {target}")

    def _change(self, source: str, target: str, changes: Mapping[str, object]) -> Json:
        self._require(source, target)
        return {"source": source, "changes": to_json(changes)}

    def _send(self, sets: Iterable[Json], at_ns: int | None) -> int:
        answer = self._child.ask({"do": "set", "sets": list(sets), "at_ns": at_ns})
        return cast("int", answer["at_ns"])
