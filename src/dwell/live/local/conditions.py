"""Conditions of one direction of an emulated link, and what is drawn from them on the way."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import cycle
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import LiveError, ProblemError
from dwell.model import bounds
from dwell.model.instants import NEVER_NS
from dwell.model.process import AR1, Constant, LogNormal, Process, Trace
from dwell.model.scenario import ADDED_LOSS

#: How a link's process gets the CPU: by real-time priority, with short time slices, as any other.
Scheduling: TypeAlias = Literal["fifo", "short slices", "usual"]

# Drawn at a time: a draw of one costs a hundred times as much a value.
BLOCK = 256
NS_PER_MS = 1e6
#: Attempts at a message on a link that retransmits.
MOST_ATTEMPTS = 20


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions that a message meets on its way.

    Parameters
    ----------
    delay_ms : Process
        Propagation delay, one value a message.
    add_delays_ms : tuple of Process
        Extra delays of the link's disturbances, whether they are on or not.
    shares : tuple of float
        How much of each of them is added now, in [0, 1].
    rate_mbps : float
        Serialisation rate that all connections share, Mbit/s; infinite where nothing queues.
    loss : float
        Probability that a message of data is lost, in [0, 1].
    down : bool
        Whether nothing begins its way. Data is lost, or waits until the link is up again where that
        retransmits; what keeps the sessions going always waits.
    """

    delay_ms: Process = field(default_factory=lambda: Constant(0.0))
    add_delays_ms: tuple[Process, ...] = ()
    shares: tuple[float, ...] = ()
    rate_mbps: float = math.inf
    loss: float = 0.0
    down: bool = False

    def __post_init__(self) -> None:
        named = [("add_delays_ms", process) for process in self.add_delays_ms]
        for name, value in (("delay_ms", self.delay_ms), *named):
            bounds.require(isinstance(value, Process), name, value, "a random process")
        good = len(self.shares) == len(self.add_delays_ms) and all(0 <= s <= 1 for s in self.shares)
        bounds.require(good, "shares", self.shares, "one from 0 to 1 for each of add_delays_ms")
        bounds.RATE_MBPS.check("rate_mbps", self.rate_mbps)
        ADDED_LOSS.check("loss", self.loss)


def transmission_ns(size_bytes: int, rate_mbps: float) -> int:
    """Return how long bytes take at a rate; no time at an infinite one."""
    return round(size_bytes * 8e3 / rate_mbps)


def fields_of(conditions: Conditions) -> dict[str, Any]:
    """Return all fields by their names, as the links' `set` takes them."""
    return {item.name: getattr(conditions, item.name) for item in fields(conditions)}


def changed(way: str, conditions: Conditions, changes: Mapping[str, Any]) -> Conditions:
    """Return conditions with some fields changed.

    Raises
    ------
    LiveError
        If a value is out of its bounds.
    """
    try:
        return replace(conditions, **changes)
    except ProblemError as error:
        raise LiveError(f"{way}: {error}") from None


# ---------------------------------------------------------------------------------- delays


def delays_ns(process: Process, rng: np.random.Generator) -> Iterator[int]:
    """Draw one delay after another, for ever.

    An `ar1` process has its memory, a trace is replayed from a random row and begins again at its
    end; the values of all others are independent.
    """
    if isinstance(process, Constant):
        value = round(process.value * NS_PER_MS)
        while True:
            yield value
    if isinstance(process, Trace):
        values = _whole_ns(process.values)
        yield from cycle(np.roll(values, -rng.integers(len(values))).tolist())
    if isinstance(process, AR1) and process.cv > 0:
        yield from _remembering(process, rng)
    while True:
        yield from _whole_ns(process.marginal(rng, BLOCK)).tolist()


def _whole_ns(delays_ms: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return delays in nanoseconds; one longer than a century is for ever."""
    return np.rint(np.minimum(delays_ms * NS_PER_MS, NEVER_NS)).astype(np.int64)


def _remembering(process: AR1, rng: np.random.Generator) -> Iterator[int]:
    mu, sigma = LogNormal(process.mean, process.cv).log_parameters
    r = process.log_correlation
    fresh = math.sqrt(1 - r * r)
    state = rng.standard_normal()
    while True:
        for noise in rng.standard_normal(BLOCK).tolist():
            yield round(math.exp(mu + sigma * state) * NS_PER_MS)
            state = r * state + fresh * noise


class Draws:
    """Conditions that may change, and streams of their own for each delay and for losses.

    A stream goes on for as long as its process stays, whether it counts or not.

    Parameters
    ----------
    seed : (int, int)
        Seed of the link, and number of the direction.
    """

    def __init__(self, seed: tuple[int, int]) -> None:
        self.conditions = Conditions()
        self._delays_rng, self._added_rng, self._losses = np.random.default_rng(seed).spawn(3)
        self._delays = delays_ns(self.conditions.delay_ms, self._delays_rng)
        self._added: list[Iterator[int]] = []

    def apply(self, now: Conditions) -> None:
        """Have other conditions; a delay that stays goes on where it is."""
        before, self.conditions = self.conditions, now
        if before.delay_ms != now.delay_ms:
            self._delays = delays_ns(now.delay_ms, self._delays_rng)
        if before.add_delays_ms != now.add_delays_ms:
            rngs = self._added_rng.spawn(len(now.add_delays_ms))
            pairs = zip(now.add_delays_ms, rngs, strict=True)
            self._added = [delays_ns(process, rng) for process, rng in pairs]

    def lose(self) -> bool:
        """Draw whether the next message is lost."""
        return self.conditions.loss > 0 and self._losses.random() < self.conditions.loss

    def delay_ns(self) -> int:
        """Draw a delay."""
        shares = zip(self._added, self.conditions.shares, strict=True)
        return next(self._delays) + sum(round(next(added) * share) for added, share in shares)
