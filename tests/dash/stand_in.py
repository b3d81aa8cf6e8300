"""A cell that is observed, without a cell: what a test says that an observer has heard.

As a program it serves the page of a cell that has a cycle every 33 ms, with the token that it is
given.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any, cast

from dwell.dash.feed import Feed
from dwell.dash.observer import ObservedCell, ObservedCycle, ObservedWindow, Observer
from dwell.live.failures import start_thread
from dwell.live.host.security import Security
from dwell.live.roles.controlled_cell import MOVED_BY
from dwell.live.wire.wiring import roles
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

    def well(self) -> None:
        """Have its controller say that it is well."""
        members = [role.who for role in roles(self.problem) if role.kind != "controller"]
        self.status = {
            "health": "ok",
            "headline": None,
            "fallback": False,
            "windows": 12,
            "moves": {**dict.fromkeys(MOVED_BY, 0), "migrate": 2, "guard": 1},
            "bound_ms": 0.25,
            "unproven": False,
            "silences": 3,
            "release_ratio": 0.75,
            "stages": {
                "perception@R1": {
                    "exec_median_ms": 12.0,
                    "exec_p95_ms": 20.0,
                    "jobs": 50,
                    "replaced": 4,
                    "dropped": 1,
                    "inputs_total": {"taken": 900, "replaced": 40, "dropped": 10},
                },
                "planning@R2": {
                    "exec_median_ms": None,
                    "exec_p95_ms": None,
                    "jobs": 0,
                    "replaced": 0,
                    "dropped": 0,
                    "inputs_total": {"taken": 0, "replaced": 0, "dropped": 0},
                },
            },
            "flows": {
                "perception@R1->planning@R2": {
                    "sent": 50,
                    "taken": 45,
                    "replaced": 0,
                    "dropped": 1,
                    "lost": 3,
                    "in_flight": 1,
                    "bytes_per_s": 4_000.0,
                    "bytes_total": 123_456,
                },
            },
            "window": {
                "number": 11,
                "last_cycle": 1_199,
                "cycles": 100,
                "violation_rate": 0.1,
                "estimates": {"LOC": 1.5, "SO": None, "HYB": 2.5},
                "utilisation": {"R1": 0.5, "R2": 0.25, "E": None},
                "ages": {
                    "age_l95_reaction": 80.0,
                    "age_missed_reaction": 0.25,
                    "reaction_l95_reaction": math.inf,
                },
            },
            "processes": {who: {"heard": True, "ready": True, "note": ""} for who in members},
            "certificates": {"R1": {"expires": "2030-01-01", "days": 3.5, "soon": True}},
        }


def serve_page(token: str) -> None:
    """Serve the page of a cell that goes on, until this process is told to end."""
    from dwell.dash.metrics import CellMetrics
    from dwell.dash.server import Dash
    from dwell.dash.serving import serve

    cell = StandIn()
    cell.well()

    def go_on() -> None:
        for number in count():
            cell.cycle(number, 10 + number % 7 * 5)
            time.sleep(PERIOD_NS / 1e9)

    start_thread("cycles", go_on)
    serve(
        Dash([], metrics=CellMetrics(cell.observer).page), 0, browser=False, say=print, token=token
    )


if __name__ == "__main__":
    serve_page(sys.argv[1])
