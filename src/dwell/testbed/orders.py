"""What the parent of a link's process asks of it: other conditions, at an instant, and counters."""

from __future__ import annotations

import select
import time
from collections.abc import Sequence
from typing import Protocol, TypedDict, cast

from dwell.errors import DwellError
from dwell.testbed.child import Json, Parent
from dwell.testbed.conditions import Conditions, changed
from dwell.testbed.event_loop import Loop

__all__ = ["Orders", "Set"]


class Set(TypedDict):
    """A change of the direction from a node, as `to_json` has written it."""

    source: str
    changes: dict[str, object]


class Directed(Protocol):
    """The two directions of a link."""

    loop: Loop

    def conditions_from(self, source: str) -> Conditions:
        """Those of the direction from a node."""
        ...

    def apply(self, sets: Sequence[Set]) -> None:
        """Change conditions."""
        ...

    def stats(self, *, reset: bool) -> Json:
        """Return the counters of both directions."""
        ...


class Orders:
    """Carries out the parent's requests as they come in a loop."""

    served_ns = 0

    def __init__(self, parent: Parent, link: Directed) -> None:
        self._parent, self._link = parent, link
        link.loop.watch(parent.fileno(), select.EPOLLIN, self)

    def ready(self, _events: int) -> None:
        """Carry out a request; an `EOFError` ends the process."""
        request = self._parent.receive()
        try:
            self._parent.answer(self._answer(request))
        except DwellError as error:
            self._parent.answer({"error": str(error)})

    def _answer(self, request: Json) -> Json:
        link = self._link
        if request["do"] == "stats":
            return {"stats": link.stats(reset=bool(request["reset"]))}
        sets = cast("list[Set]", request["sets"])
        for item in sets:  # all faults before anything has changed
            changed(link.conditions_from(item["source"]), item["changes"])
        at_ns = cast("int | None", request["at_ns"]) or 0
        now_ns = time.monotonic_ns()
        if at_ns <= now_ns:
            link.apply(sets)
            return {"at_ns": now_ns}
        link.loop.at(at_ns, lambda _: link.apply(sets))
        return {"at_ns": at_ns}
