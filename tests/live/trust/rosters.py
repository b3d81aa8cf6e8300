"""A roster with everybody who takes part in a cell, and people."""

from __future__ import annotations

from dwell.live.trust.roster import Roster, Subject
from dwell.live.wire.keys import CONTROLLER
from dwell.model import Problem

PEOPLE = {"operator": "operator", "observer": "observer"}

#: When certificates begin and end.
LIFE = "2029-01-01T00:00:00+00:00", "2030-01-01T00:00:00+00:00"


def roster_of(problem: Problem, *, without: str = "", generation: int = 1) -> Roster:
    """A roster with every node, the controller, and people."""
    known = {**dict.fromkeys(problem.fabric.nodes, "node"), CONTROLLER: "controller", **PEOPLE}
    made = {
        name: Subject(name, role, generation, serial, "", *LIFE)  # type: ignore[arg-type]
        for serial, (name, role) in enumerate(known.items(), 1)
        if name != without
    }
    return Roster(problem.name, 1, made)
