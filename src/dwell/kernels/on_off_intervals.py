"""Times and strengths of a disturbance: all its time, in episodes, or along a ramp."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.model import Process
from dwell.model.instants import HORIZON_NS
from dwell.model.scenario import RAMP_STEPS

Ints = NDArray[np.int64]


class OnOffIntervals(NamedTuple):
    """Times during which something is on; they are ascending and never overlap.

    Parameters
    ----------
    begin, end : int64 array, shape (intervals,)
        Nanoseconds; the end is outside.
    level : int64 array, shape (intervals,)
        Strength, counted in steps of a ramp: `RAMP_STEPS` is the whole of it.
    """

    begin: Ints
    end: Ints
    level: Ints

    def levels(self, at: Ints) -> Ints:
        """Return the strength at each instant, 0 where nothing is on."""
        if len(self.begin) == 0:
            return np.zeros(len(at), np.int64)
        last = np.searchsorted(self.begin, at, side="right") - 1
        return np.where((last >= 0) & (at < self.end[last]), self.level[last], 0)

    def until(self, end_ns: int) -> OnOffIntervals:
        """Return what is left if all is off from an instant on."""
        left = int(np.searchsorted(self.begin, end_ns))
        end = np.minimum(self.end[:left], end_ns)
        return OnOffIntervals(self.begin[:left], end, self.level[:left])


def interval(begin_ns: int, end_ns: int) -> OnOffIntervals:
    """Return one interval at full strength."""
    return OnOffIntervals(np.array([begin_ns]), np.array([end_ns]), np.array([RAMP_STEPS]))


def ramp(begin_ns: int, end_ns: int, ramp_ns: int) -> OnOffIntervals:
    """Return an interval that grows in equal steps, and falls in as many, each time for `ramp_ns`.

    Step n is reached n / `RAMP_STEPS` of that time after the begin, and left as long before the
    end. One that ends no earlier than `HORIZON_NS` does not fall.
    """
    step = np.arange(1, RAMP_STEPS + 1)
    after = np.rint(step * (ramp_ns / RAMP_STEPS)).astype(np.int64)
    begin, level, last = begin_ns + after, step, end_ns
    if end_ns < HORIZON_NS:
        begin = np.concatenate((begin, end_ns - after[:0:-1]))
        level, last = np.concatenate((step, step[-2::-1])), end_ns - int(after[0])
    # Where growing and falling meet, rounding must not put the one behind the other.
    begin = np.maximum.accumulate(begin)
    return OnOffIntervals(begin, np.append(begin[1:], last), level)


def drawn_intervals(
    every: Process,
    length: Process,
    unit_ns: float,
    rngs: tuple[np.random.Generator, np.random.Generator],
    begin_ns: int,
    horizon_ns: int,
) -> OnOffIntervals:
    """Draw an alternating renewal process: off for `every`, then on for `length`, and so on.

    Parameters
    ----------
    unit_ns : float
        Unit of their values.
    rngs : pair of Generator
        Random streams of the times off, and of the times on.
    begin_ns, horizon_ns : int
        Where the first time off begins, and from where on no interval begins any more.
    """
    mean_ns = (every.expectation + length.expectation) * unit_ns
    count = 64 + round(1.1 * max(horizon_ns - begin_ns, 0) / mean_ns)
    begins, ends = [np.empty(0)], [np.empty(0)]
    now = float(begin_ns)
    while now < horizon_ns:
        end = every.marginal(rngs[0], count) * unit_ns
        on = length.marginal(rngs[1], count) * unit_ns
        end += on
        np.cumsum(end, out=end)
        end += now
        now = float(end[-1])
        begins.append(np.subtract(end, on, out=on))
        ends.append(end)
    begin = np.concatenate(begins)
    begun = int(np.searchsorted(begin, horizon_ns))
    begin, end = begin[:begun], np.minimum(np.concatenate(ends)[:begun], HORIZON_NS)
    level = np.full(begun, RAMP_STEPS)
    return OnOffIntervals(np.rint(begin).astype(np.int64), np.rint(end).astype(np.int64), level)
