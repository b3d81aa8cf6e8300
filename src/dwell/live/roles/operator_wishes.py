"""OperatorWishes: the pin and the drained nodes of a cell, and the placements that they allow."""

from __future__ import annotations

from collections.abc import Callable

from dwell.model import Problem


class OperatorWishes:
    """Follows the requests of operators.

    Attributes
    ----------
    pinned : str
        Candidate that the cell must run; empty if none.
    drained : set of str
        Nodes that no placement may need.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.pinned = ""
        self.drained: set[str] = set()

    def take(self, what: str, about: str) -> str:
        """Follow a request; return the reason if it is refused, else an empty string."""
        candidates, nodes = self._problem.candidates, self._problem.fabric.nodes
        match what:
            case "pin":
                if about not in candidates:
                    return f"no candidate {about!r}; there are {', '.join(candidates)}"
                if needed := self.drained & candidates[about].nodes:
                    return f"{about} needs {', '.join(sorted(needed))}, which is drained"
                self.pinned = about
            case "unpin":
                self.pinned = ""
            case "drain" | "undrain" if about not in nodes:
                return f"no node {about!r}; there are {', '.join(nodes)}"
            case "drain":
                drained = {*self.drained, about}
                if all(drained & placed.nodes for placed in candidates.values()):
                    return f"every candidate needs {about}; nothing could run"
                if self.pinned and about in candidates[self.pinned].nodes:
                    return (
                        f"the cell is pinned to {self.pinned}, which needs {about}; unpin it first"
                    )
                self.drained = drained
            case "undrain":
                self.drained.discard(about)
            case _:
                return f"unknown question {what!r}"
        return ""

    def allow(self, name: str) -> bool:
        """Whether a candidate needs no node that is drained."""
        return not self.drained & self._problem.candidates[name].nodes

    def allowed(self, wanted: str, here: str, probed: str, is_ready: Callable[[str], bool]) -> str:
        """Return the placement that pins, drains and the mode allow for a wanted placement.

        If they allow neither this one nor the current placement `here`, a candidate whose workers
        are ready is preferred: the candidate that the stamper probes, else a fallback, else any.
        """
        problem = self._problem
        if self.pinned:
            return self.pinned
        if problem.live.mode == "advise":
            wanted = here
        for name in (wanted, here):
            if self.allow(name):
                return name
        order = (probed, *problem.controller.fallbacks, *problem.candidates)
        clear = [name for name in order if name and self.allow(name)]
        return next((name for name in clear if is_ready(name)), clear[0])

    def why(self) -> str:
        """Return the reason that a decision is not followed."""
        if self.pinned:
            return f"pinned to {self.pinned}"
        return f"{', '.join(sorted(self.drained))} drained" if self.drained else "not proven"
