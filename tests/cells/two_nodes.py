"""A task that may run on two nodes, a policy that follows a script, and runs compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import dwell
from dwell.model import (
    Constant,
    ControllerSettings,
    Decision,
    Execution,
    Node,
    NodeDisturbance,
    Problem,
    QoS,
    Task,
)
from tests.cells.generated import make_problem

TABLES = ("cycles", "windows", "decisions")


class Script:
    """A policy that says its names one after another and then the last one for ever."""

    def __init__(self, *names: str) -> None:
        self.names = names
        self.at = 0
        self.seen: list[QoS] = []

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> Decision | str:
        """Say the next name."""
        self.seen.append(observed)
        name = self.names[min(self.at, len(self.names) - 1)]
        self.at += 1
        return name


def assert_same(one: dwell.Run, other: dwell.Run) -> None:
    """Assert that all tables are equal bit for bit, and of one schema."""
    for name in TABLES:
        a, b = getattr(one, name), getattr(other, name)
        assert a.schema == b.schema
        assert a.equals(b), name


def two_nodes(
    *,
    exec_ms: float = 5.0,
    window_cycles: int = 10,
    workers: int = 1,
    scenario: Sequence[NodeDisturbance] = (),
    **settings: Any,
) -> Problem:
    """Return one task that may run on R or on E, where the controller sits; P = D = 20 ms."""
    execution = Execution(Constant(exec_ms), workers=workers)
    return make_problem(
        [Node("R", "robot", 4), Node("E", "edge", 4)],
        [Task("work", {"R": execution, "E": execution})],
        candidates={"LOC": {"work": "R"}, "OFF": {"work": "E"}},
        period_ms=20.0,
        window_cycles=window_cycles,
        scenario=scenario,
        controller=ControllerSettings(**settings),
    )


def first_cycles(run: dwell.Run, placement: str) -> list[int]:
    """Return where runs of cycles with a placement begin."""
    names = run.cycles["placement"].cast(str).to_list()
    return [
        i
        for i, name in enumerate(names)
        if name == placement and (i == 0 or names[i - 1] != placement)
    ]
