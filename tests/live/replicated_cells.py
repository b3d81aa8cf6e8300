"""Cells whose candidates include replicas, for live tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dwell.live.wire.messages import Completion, Header, decode
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import Role
from dwell.model import Problem, Replicas
from tests.live.small_world import EXEC_MS, MS, World, canonical


def replicated(
    *, after_ms: float = 0.0, initial: str = "BOTH", window_cycles: int = 20, **settings: Any
) -> Problem:
    """Return the canonical cell with a candidate BOTH: LOC, and SO on the edge server E."""
    cell = canonical(window_cycles)
    members = {name: cell.candidates[name] for name in ("LOC", "SO")}
    both = Replicas(members, after_ms)
    cell = replace(cell, candidates={**cell.candidates, "BOTH": both})
    controller = replace(cell.controller, initial=initial, **{"fallbacks": (), **settings})
    return replace(cell, controller=controller)


class ReplicatedWorld(World):
    """A cell in memory whose jobs may take longer on some nodes; it keeps reports of jobs."""

    def __init__(
        self, problem: Problem, exec_ms: Mapping[tuple[str, str], float] | None = None, **more: Any
    ) -> None:
        self.site_ms = exec_ms or {}
        self.ended: list[Completion] = []
        #: Workers to which an input was sent, and the time since the release, ms.
        self.inputs: list[tuple[str, float]] = []
        super().__init__(problem, **more)
        self.network.taps.append(self._hear)

    def exec_ns_of(self, role: Role) -> int:
        ms = self.site_ms.get((role.task, role.node), EXEC_MS[role.task])
        return round(ms * MS)

    def _hear(self, sample: Arrival) -> None:
        word = self.keys.word(sample.key)
        if word == "ended":
            self.ended.append(decode(sample.payload, Completion))
        elif word == "in":
            _, task, node, _ = sample.key.removeprefix(f"{self.keys.root}/").split("/")
            released_ns = decode(sample.header, Header).stamp.released_ns
            self.inputs.append((f"{task}@{node}", (self.network.now_ns - released_ns) / MS))

    def outcomes(self, task: str, node: str) -> dict[str, int]:
        """Return how many reports of a task on a node there are, by outcome."""
        found: dict[str, int] = {}
        for done in self.ended:
            if (done.sink, done.node) == (task, node):
                found[done.outcome] = found.get(done.outcome, 0) + 1
        return found

    def inputs_of(self, who: str) -> int:
        """Return how many inputs a worker was sent."""
        return sum(name == who for name, _ in self.inputs)
