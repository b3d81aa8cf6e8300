"""Axes: which scale suits numbers, and ticks that people would write."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axis import Axis

__all__ = ["is_wide", "log_ticks", "set_log_ticks"]

# Ratio of the largest to the smallest value that asks for a logarithmic axis.
WIDE = 5.0
# Room that the label of a tick needs, as a share of the axis.
ROOM = 0.16


def is_wide(values: Iterable[float]) -> bool:
    """Whether finite values above 0 span so much that a logarithmic axis shows them better."""
    finite = [value for value in values if math.isfinite(value)]
    return bool(finite) and min(finite) > 0 and max(finite) > WIDE * min(finite)


def log_ticks(low: float, high: float) -> list[float]:
    """Return 1, 2 and 5 times the powers of ten between the two, or 1 and 3 times, or 1 times."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks: list[float] = []
    for steps in ((1, 2, 5), (1, 3), (1,)):
        ticks = [step * 10.0**power for power in powers for step in steps]
        ticks = [tick for tick in ticks if low <= tick <= high]
        gaps = [math.log(after / tick) for tick, after in itertools.pairwise(ticks)]
        if not gaps or min(gaps) >= ROOM * math.log(high / low):
            break
    return ticks


def set_log_ticks(axis: Axis, low: float, high: float, at: Iterable[float] | None = None) -> None:
    """Give a logarithmic axis ticks in plain numbers, at some values or where they are round."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axis.set_major_locator(FixedLocator(log_ticks(low, high) if at is None else [*at]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
