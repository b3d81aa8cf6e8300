"""A cell that is observed, without a cell: what a test says that an observer has heard."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

from dwell.dash.feed import Feed
from dwell.dash.observer import ObservedCell, ObservedCycle, ObservedWindow, Observer
from dwell.live.security import Security
from dwell.model import Problem
from tests.cells.small import make_problem

PERIOD_NS = 33_000_000


@dataclass
class StandIn:
    """See the module; it says of itself what an `Observer` does."""

    problem: Problem = field(default_factory=make_problem)
    status: Mapping[str, Any] = field(default_factory=lambda: {"health": "ok"})
    placement: str = "LOC"
    at_s: float = 1.0
    outcomes: dict[str, int] = field(default_factory=dict)
    missed: int = 0
    most_cycles: int = 10_000

    def __post_init__(self) -> None:
        self.cycles: Feed[ObservedCycle] = Feed(self.most_cycles)
        self.windows: Feed[ObservedWindow] = Feed(100)
        self.security = Security(self.problem)

    def now(self) -> ObservedCell:
        return ObservedCell(
            self.at_s, self.status, 0.0, self.placement, dict(self.outcomes), self.missed
        )

    def cycle(self, number: int, latency_ms: float | None, **more: Any) -> None:
        """Have a cycle heard of."""
        latency_ns = None if latency_ms is None else round(latency_ms * 1e6)
        told = {
            "run": 7,
            "number": number,
            "term": 1,
            "placement": self.placement,
            "release_ns": number * PERIOD_NS,
            "latency_ns": latency_ns,
            "missed": latency_ns is None or latency_ns > self.problem.pipeline.deadline_ms * 1e6,
            "known": True,
            "outcome": "lost" if latency_ns is None else "actuated",
        }
        cycle = ObservedCycle(**{**told, **more})
        self.cycles.append(cycle)
        self.outcomes[cycle.outcome] = self.outcomes.get(cycle.outcome, 0) + 1
        self.missed += cycle.missed
        self.at_s = max(self.at_s, (number + 1) * PERIOD_NS / 1e9)

    @property
    def observer(self) -> Observer:
        return cast("Observer", self)
