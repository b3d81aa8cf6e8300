"""Scenario: what happens to the fabric over time, one disturbance an item."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

from dwell.model.bounds import ADDED_LOSS, AT_S, FOR_S, FOREIGN_THREADS, RATE_MBPS
from dwell.model.process import Process

__all__ = ["Disturbance", "LinkDisturbance", "NodeDisturbance", "Scenario"]


def _interval(at_s: float, for_s: float) -> None:
    AT_S.check("at_s", at_s)
    FOR_S.check("for_s", for_s)


@dataclass(frozen=True, slots=True)
class NodeDisturbance:
    """Foreign CPU load on a node, or the node down, from `at_s` for `for_s` seconds."""

    node: str
    at_s: float = 0.0
    for_s: float = math.inf
    stress_threads: int = 0
    down: bool = False

    def __post_init__(self) -> None:
        _interval(self.at_s, self.for_s)
        FOREIGN_THREADS.check("stress_threads", self.stress_threads)


@dataclass(frozen=True, slots=True)
class LinkDisturbance:
    """Extra delay, loss or another rate on a directed link, or the link down, for a while.

    Loss probabilities of disturbances at the same time, and the link's own, combine as
    independent; extra delays add up; the lowest rate counts.
    """

    source: str
    target: str
    at_s: float = 0.0
    for_s: float = math.inf
    add_delay_ms: Process | None = None
    loss: float = 0.0
    rate_mbps: float = math.inf
    down: bool = False

    def __post_init__(self) -> None:
        _interval(self.at_s, self.for_s)
        ADDED_LOSS.check("loss", self.loss)
        RATE_MBPS.check("rate_mbps", self.rate_mbps)

    @property
    def link(self) -> str:
        """``R1->E``."""
        return f"{self.source}->{self.target}"


Disturbance: TypeAlias = NodeDisturbance | LinkDisturbance
Scenario: TypeAlias = tuple[Disturbance, ...]
