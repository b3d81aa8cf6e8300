"""Scenario: what happens to the fabric over time, one disturbance an item.

A disturbance is on from `at_s` for `for_s` seconds: all the time, in drawn `episodes`, or growing
and falling along a ramp of `ramp_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

from dwell.model.bounds import (
    ADDED_LOSS,
    AT_S,
    EPISODE_MEAN_S,
    FOR_S,
    FOREIGN_THREADS,
    RAMP_S,
    RATE_MBPS,
    require,
)
from dwell.model.process import Process, require_mean

# Equal steps in which a ramp reaches its full strength. Their number has that many binary digits,
# and every digit of the strength is a layer of extra delay that is on or off.
RAMP_LAYERS = 5
RAMP_STEPS = 2**RAMP_LAYERS - 1
# Layers of extra delay on one link: bits of a whole number of 64 that is not negative.
MAX_LAYERS = 63


@dataclass(frozen=True, slots=True)
class Episodes:
    """An alternating renewal process: off for `every_s` seconds, then on for `for_s`, and so on.

    Parameters
    ----------
    name : str
        Name of the random streams; disturbances of one scenario whose episodes have the same name
        come and go together.
    every_s, for_s : Process
        Seconds, independent of each other; their means are above 1e-5.
    """

    name: str
    every_s: Process
    for_s: Process

    def __post_init__(self) -> None:
        for path, process in (("every_s", self.every_s), ("for_s", self.for_s)):
            require_mean(EPISODE_MEAN_S, f"episodes.{path}", process)


@dataclass(frozen=True, slots=True)
class NodeDisturbance:
    """Foreign CPU load on a node, or the node down.

    Parameters
    ----------
    at_s, for_s : float
        Begin and duration, seconds.
    stress_threads : int
        Foreign threads; along a ramp, rounded to whole ones.
    episodes : Episodes, optional
        When it is on within that time; all the time where None.
    ramp_s : float
        Time in which it grows to its full strength, and in which it falls to nothing at its end.
    """

    node: str
    at_s: float = 0.0
    for_s: float = math.inf
    stress_threads: int = 0
    down: bool = False
    episodes: Episodes | None = None
    ramp_s: float = 0.0

    def __post_init__(self) -> None:
        _check_time(self)
        FOREIGN_THREADS.check("stress_threads", self.stress_threads)

    @property
    def end_s(self) -> float:
        """End, seconds; infinite where it lasts."""
        return self.at_s + self.for_s

    @property
    def place(self) -> str:
        """The node's name."""
        return self.node


@dataclass(frozen=True, slots=True)
class LinkDisturbance:
    """Extra delay, loss or another rate on a directed link, or the link down.

    Loss probabilities of disturbances at the same time, and the link's own, combine as
    independent; extra delays add up; the lowest rate counts. Time, episodes and ramp are those of
    `NodeDisturbance`; along a ramp the extra delay, the loss, and the time that a bit takes at
    `rate_mbps` beyond what it takes at the link's own rate are what grows.
    """

    source: str
    target: str
    at_s: float = 0.0
    for_s: float = math.inf
    add_delay_ms: Process | None = None
    loss: float = 0.0
    rate_mbps: float = math.inf
    down: bool = False
    episodes: Episodes | None = None
    ramp_s: float = 0.0

    def __post_init__(self) -> None:
        _check_time(self)
        ADDED_LOSS.check("loss", self.loss)
        RATE_MBPS.check("rate_mbps", self.rate_mbps)

    @property
    def end_s(self) -> float:
        """End, seconds; infinite where it lasts."""
        return self.at_s + self.for_s

    @property
    def link(self) -> str:
        """``R1->E``."""
        return f"{self.source}->{self.target}"

    @property
    def place(self) -> str:
        """The link's name."""
        return self.link

    @property
    def layers(self) -> int:
        """Layers of extra delay that it takes of the link's `MAX_LAYERS`."""
        if self.add_delay_ms is None:
            return 0
        return RAMP_LAYERS if self.ramp_s else 1


Disturbance: TypeAlias = NodeDisturbance | LinkDisturbance
Scenario: TypeAlias = tuple[Disturbance, ...]


def is_always_on(item: Disturbance) -> bool:
    """Whether a disturbance is on, at its full strength, from the first cycle to the last."""
    whole = item.at_s == 0 and math.isinf(item.for_s)
    return whole and item.episodes is None and not item.ramp_s


def _check_time(item: Disturbance) -> None:
    AT_S.check("at_s", item.at_s)
    FOR_S.check("for_s", item.for_s)
    RAMP_S.check("ramp_s", item.ramp_s)
    if item.ramp_s == 0:
        return
    half = f"at most half of for_s = {item.for_s:g}: it grows, and it falls"
    require(2 * item.ramp_s <= item.for_s, "ramp_s", item.ramp_s, half)
    require(item.episodes is None, "ramp_s", item.ramp_s, "left out where there are `episodes`")
    require(not item.down, "ramp_s", item.ramp_s, "left out of what is `down`: it has no strength")
