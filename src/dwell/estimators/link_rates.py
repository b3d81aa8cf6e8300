"""Link rates: distinguish a lower rate of a link from a longer delay.

A longer delay is the same for all messages. A lower rate delays a message by its own bytes and by
the bytes ahead of it. Messages of different loads therefore show the rate: at the true rate all
have the same extra delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from dwell.kernels.elementary import logarithms
from dwell.model.number_arrays import Floats

#: First rates to try: the largest, the ratio of successive rates, and their number.
FASTEST_MBPS, SHARE, TRIED = 1000.0, 0.6, 18
#: Then relative distances around the best rate, and steps in each direction.
NEARER, STEPS = (0.4, 0.05, 0.006), 8
#: A rate above this share of the declared rate counts as the declared rate.
LOWER = 0.9
#: Smallest gain in log-likelihood for a rate to explain messages better than a delay.
GAIN = 8.0
#: Least deviation of a delay, milliseconds.
LEAST_MS = 0.05


class Rate(NamedTuple):
    """Rate of a link, with its standard error as a share of it."""

    mbps: float
    error: float = 0.0


def better_rate(
    extra_ms: Callable[[float], Floats], now_mbps: float, declared_mbps: float, deviation_ms: float
) -> Rate | None:
    """Return the rate, if any, that explains messages better than the current rate with a delay.

    `extra_ms` returns the extra delay of every message at a rate; NaN if the message arrived too
    early for the rate. `deviation_ms` is the mean absolute deviation of the declared delay.
    """

    def spread_ms(mbps: float) -> float:
        values = extra_ms(mbps)
        if np.isnan(values).any():
            return np.inf
        return float(np.abs(values - np.median(values)).mean())

    count, least_ms = len(extra_ms(now_mbps)), max(deviation_ms, LEAST_MS)
    before_ms = spread_ms(now_mbps) if count else 0.0
    if count * _log(before_ms, least_ms) < GAIN:
        return None
    fastest = min(declared_mbps, FASTEST_MBPS)
    best = min(_slower(fastest), key=spread_ms)
    if count * _log(before_ms, max(spread_ms(best), least_ms)) < GAIN / 2:
        return None
    for width in NEARER:
        # The fastest rate is first: `min` returns the first of equal rates.
        best = min(
            (best * (1 + width * k / STEPS) for k in range(STEPS, -STEPS, -1)), key=spread_ms
        )
    # Both explanations have a location and exponential deviations (Laplace), with a scale of at
    # least the declared scale.
    after_ms = max(spread_ms(best), least_ms)
    if count * _log(before_ms, after_ms) < GAIN:
        return None
    if best > LOWER * fastest:
        return Rate(declared_mbps)
    lever_ms = float((extra_ms(fastest) - extra_ms(best)).std())
    return Rate(best, after_ms / (max(lever_ms, after_ms) * math.sqrt(count)))


def _slower(mbps: float) -> Iterator[float]:
    for _ in range(TRIED):
        yield mbps
        mbps *= SHARE


def _log(value: float, least: float) -> float:
    if value == math.inf:
        return value
    return float(logarithms(np.array([max(value / least, 1.0)]))[0])
