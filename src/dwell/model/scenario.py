"""Scenario: a list of disturbances of the fabric over time.

A disturbance lasts from `at_s` for `for_s` seconds: continuously, in random `episodes`, or growing
and falling along ramps of `ramp_s`.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

from dwell.model.bounds import FOREIGN_THREADS, LARGEST, RATE_MBPS, Bound, require
from dwell.model.declaration import declared, key
from dwell.model.fabric import Fabric
from dwell.model.process import Process, require_mean

# Equal steps in which a ramp reaches its full strength. Their number has that many binary digits,
# and every digit of the strength is a layer of extra delay that is on or off.
RAMP_LAYERS = 5
RAMP_STEPS = 2**RAMP_LAYERS - 1
# Layers of extra delay on one link: bits of a whole number of 64 that is not negative.
MAX_LAYERS = 63


EPISODE_MEAN_S, ADDED_LOSS = Bound(1e-5, LARGEST), Bound(0, 1)


@declared("episodes")
class Episodes:
    """Alternating episodes: off for `every_s` seconds, then on for `for_s`."""

    name: str = key(
        "Name of the episodes, and of their random streams; what shares it in a scenario comes and "
        "goes together."
    )
    every_s: Process = key("Time between episodes, s; mean above 1e-5.")
    for_s: Process = key("Duration of an episode, s; mean above 1e-5.")

    def __post_init__(self) -> None:
        for path, process in (("every_s", self.every_s), ("for_s", self.for_s)):
            require_mean(EPISODE_MEAN_S, f"episodes.{path}", process)


def _at_s() -> Any:
    return key(
        "Begin, seconds from the start of the run.",
        Bound(0, LARGEST, below=True),
        default=0.0,
        tier="first",
    )


def _for_s() -> Any:
    return key(
        "Duration, seconds.",
        Bound(0, above=True),
        default=math.inf,
        usual="to the end",
        tier="first",
    )


def _down() -> Any:
    return key(
        "Whether the node or the link is down during the disturbance.", default=False, tier="first"
    )


def _episodes() -> Any:
    return key(
        "Random intervals within that time in which it is on.", default=None, usual="all the time"
    )


def _ramp_s() -> Any:
    return key(
        "Time in which it grows from nothing, and in which it falls again at its end, in 31 equal "
        "steps each, seconds.",
        Bound(0, LARGEST),
        default=0.0,
    )


class _Timed:
    """Base of disturbances: begin, duration, episodes and ramp."""

    __slots__ = ()
    at_s: float
    for_s: float
    down: bool
    episodes: Episodes | None
    ramp_s: float

    def __post_init__(self) -> None:
        if self.ramp_s == 0:
            return
        ramp_s = self.ramp_s
        half = f"at most half of for_s = {self.for_s:g}: it grows, and it falls"
        require(2 * ramp_s <= self.for_s, "ramp_s", ramp_s, half)
        require(self.episodes is None, "ramp_s", ramp_s, "left out with `episodes`")
        require(not self.down, "ramp_s", ramp_s, "left out with `down`, which has no strength")

    @property
    def end_s(self) -> float:
        """End, seconds; infinite if the disturbance lasts to the end of the run."""
        return self.at_s + self.for_s


@declared()
class NodeDisturbance(_Timed):
    """Foreign CPU load on a node, or the node down."""

    node: str = key("Disturbed node.", tier="first")
    at_s: float = _at_s()
    for_s: float = _for_s()
    stress_threads: int = key(
        "Foreign threads on the node; rounded to integers along a ramp.",
        FOREIGN_THREADS,
        default=0,
        tier="first",
    )
    down: bool = _down()
    episodes: Episodes | None = _episodes()
    ramp_s: float = _ramp_s()

    @property
    def place(self) -> str:
        """The node's name."""
        return self.node


@declared()
class LinkDisturbance(_Timed):
    """Extra delay, loss or another rate on a directed link, or the link down.

    Loss probabilities of disturbances at the same time, and the link's own, combine as
    independent; extra delays add up; the lowest rate counts. A ramp scales the extra delay, the
    loss, and the increase of the transmission time per bit from the link's own rate to `rate_mbps`.
    """

    source: str
    target: str
    at_s: float = _at_s()
    for_s: float = _for_s()
    add_delay_ms: Process | None = key(
        "Added to the delay of every message on the link, ms.",
        default=None,
        tier="first",
    )
    loss: float = key(
        "Probability of loss on the link, in addition to its own.",
        ADDED_LOSS,
        default=0.0,
        tier="first",
    )
    rate_mbps: float = key(
        "Upper bound of the link's rate during the disturbance, Mbit/s.",
        RATE_MBPS,
        default=math.inf,
        usual="the link's",
    )
    down: bool = _down()
    episodes: Episodes | None = _episodes()
    ramp_s: float = _ramp_s()

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
        """Number of layers of extra delay that it uses, of the link's `MAX_LAYERS`."""
        if self.add_delay_ms is None:
            return 0
        return RAMP_LAYERS if self.ramp_s else 1


Disturbance: TypeAlias = NodeDisturbance | LinkDisturbance
Scenario: TypeAlias = tuple[Disturbance, ...]


def is_always_on(item: Disturbance) -> bool:
    """Return whether a disturbance has full strength from the first cycle to the last."""
    whole = item.at_s == 0 and math.isinf(item.for_s)
    return whole and item.episodes is None and not item.ramp_s


def acts(item: Disturbance, fabric: Fabric) -> bool:
    """Return whether a disturbance has any effect."""
    if isinstance(item, NodeDisturbance):
        return item.down or item.stress_threads > 0
    delays = item.add_delay_ms is not None and item.add_delay_ms.expectation > 0
    slows = item.rate_mbps < fabric.links[item.link].rate_mbps
    return item.down or delays or slows or item.loss > 0
