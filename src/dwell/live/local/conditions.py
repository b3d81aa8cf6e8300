"""Conditions of a direction of an emulated link, and samples of its delays and losses."""

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
from dwell.model.process import AR1, Constant, Process, Trace
from dwell.model.scenario import ADDED_LOSS

#: Scheduling of a link's process: real-time priority, short time slices, or the default.
Scheduling: TypeAlias = Literal["fifo", "short slices", "usual"]

# Samples per block: sampling single values costs a hundred times as much per value.
BLOCK = 256
NS_PER_MS = 1e6
#: Most attempts for a message on a link that retransmits.
MOST_ATTEMPTS = 20


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of a link for a message.

    Parameters
    ----------
    delay_ms : Process
        Propagation delay, one value per message.
    add_delays_ms : tuple of Process
        Extra delays of all disturbances of the link, active or not.
    shares : tuple of float
        Share of each extra delay that is added now, in [0, 1].
    rate_mbps : float
        Serialisation rate that all connections share, Mbit/s; infinite without queueing.
    loss : float
        Probability that a data message is lost, in [0, 1].
    down : bool
        Whether the link is down. Data is lost, or waits for the link if the link retransmits;
        messages that keep the sessions alive always wait.
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
    """Return the serialisation time at a rate; 0 at an infinite rate."""
    return round(size_bytes * 8e3 / rate_mbps)


def fields_of(conditions: Conditions) -> dict[str, Any]:
    """Return all fields by name, as arguments for `set` of the links."""
    return {item.name: getattr(conditions, item.name) for item in fields(conditions)}


def changed(way: str, conditions: Conditions, changes: Mapping[str, Any]) -> Conditions:
    """Return conditions with changed fields; raises a LiveError if a value is out of bounds."""
    try:
        return replace(conditions, **changes)
    except ProblemError as error:
        raise LiveError(f"{way}: {error}") from None


# ---------------------------------------------------------------------------------- delays


def delays_ns(process: Process, rng: np.random.Generator) -> Iterator[int]:
    """Yield samples of a delay without end.

    Samples of an `ar1` process are correlated. A trace starts at a random row, and repeats. Samples
    of other processes are independent.
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
    """Return delays in ns, bounded by `NEVER_NS`."""
    return np.rint(np.minimum(delays_ms * NS_PER_MS, NEVER_NS)).astype(np.int64)


def _remembering(process: AR1, rng: np.random.Generator) -> Iterator[int]:
    mu, sigma = process.log_parameters
    r = process.log_correlation
    fresh = math.sqrt(1 - r * r)
    state = rng.standard_normal()
    while True:
        for noise in rng.standard_normal(BLOCK).tolist():
            yield round(math.exp(mu + sigma * state) * NS_PER_MS)
            state = r * state + fresh * noise


class Draws:
    """Samples of variable conditions, with a random stream per delay and a stream for losses.

    A stream continues as long as its process is the same, even while its share is 0. `seed` is the
    seed of the link and the number of the direction.
    """

    def __init__(self, seed: tuple[int, int]) -> None:
        self.conditions = Conditions()
        self._delays_rng, self._added_rng, self._losses = np.random.default_rng(seed).spawn(3)
        self._delays = delays_ns(self.conditions.delay_ms, self._delays_rng)
        self._added: list[Iterator[int]] = []

    def apply(self, now: Conditions) -> None:
        """Replace the conditions; the streams of unchanged delays continue."""
        before, self.conditions = self.conditions, now
        if before.delay_ms != now.delay_ms:
            self._delays = delays_ns(now.delay_ms, self._delays_rng)
        if before.add_delays_ms != now.add_delays_ms:
            rngs = self._added_rng.spawn(len(now.add_delays_ms))
            pairs = zip(now.add_delays_ms, rngs, strict=True)
            self._added = [delays_ns(process, rng) for process, rng in pairs]

    def lose(self) -> bool:
        """Sample whether the next message is lost."""
        return self.conditions.loss > 0 and self._losses.random() < self.conditions.loss

    def delay_ns(self) -> int:
        """Sample the delay of a message, with the present shares of the extra delays."""
        shares = zip(self._added, self.conditions.shares, strict=True)
        return next(self._delays) + sum(round(next(added) * share) for added, share in shares)
