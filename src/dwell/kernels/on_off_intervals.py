"""Times and strengths of a disturbance: constant, in episodes, or with ramps."""

from __future__ import annotations

from ctypes import POINTER, c_double, c_int64
from typing import NamedTuple

import numpy as np

from dwell.kernels.drawn_path import BLOCK, path_of
from dwell.kernels.library import foreign
from dwell.kernels.rows import FLOATS_IN, INTS_OUT
from dwell.model import Process
from dwell.model.instants import HORIZON_NS
from dwell.model.number_arrays import Ints
from dwell.model.scenario import RAMP_STEPS


class OnOffIntervals(NamedTuple):
    """Ascending intervals without overlap during which a disturbance is on.

    Parameters
    ----------
    begin, end : int64 array, shape (intervals,)
        Nanoseconds; the end is exclusive.
    level : int64 array, shape (intervals,)
        Strength in steps of a ramp; `RAMP_STEPS` is the full strength.
    """

    begin: Ints
    end: Ints
    level: Ints

    def until(self, end_ns: int) -> OnOffIntervals:
        """Return the intervals cut off at an instant."""
        left = int(np.searchsorted(self.begin, end_ns))
        end = np.minimum(self.end[:left], end_ns)
        return OnOffIntervals(self.begin[:left], end, self.level[:left])


def interval(begin_ns: int, end_ns: int) -> OnOffIntervals:
    """Return one interval at full strength."""
    return OnOffIntervals(np.array([begin_ns]), np.array([end_ns]), np.array([RAMP_STEPS]))


def ramp(begin_ns: int, end_ns: int, ramp_ns: int) -> OnOffIntervals:
    """Return a disturbance that rises in equal steps for `ramp_ns`, and falls in the same way.

    Level n begins n / `RAMP_STEPS` of `ramp_ns` after the begin, and ends by the same time before
    the end. A disturbance that lasts until `HORIZON_NS` or longer does not fall.
    """
    step = np.arange(1, RAMP_STEPS + 1)
    after = np.rint(step * (ramp_ns / RAMP_STEPS)).astype(np.int64)
    begin, level, last = begin_ns + after, step, end_ns
    if end_ns < HORIZON_NS:
        begin = np.concatenate((begin, end_ns - after[:0:-1]))
        level, last = np.concatenate((step, step[-2::-1])), end_ns - int(after[0])
    # Keep the begins ascending if rounding reverses two of them between rise and fall.
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
    """Sample an alternating renewal process: off for `every`, on for `length`, and so on.

    Parameters
    ----------
    unit_ns : float
        Unit of the values of both processes.
    rngs : pair of Generator
        Random streams of the times off and of the times on.
    begin_ns, horizon_ns : int
        Begin of the first time off, and instant before which all intervals begin.
    """
    mean_ns = (every.expectation + length.expectation) * unit_ns
    count = 64 + round(1.1 * max(horizon_ns - begin_ns, 0) / mean_ns)
    times_off = path_of(every, rngs[0], independent=True)
    times_on = path_of(length, rngs[1], independent=True)
    parts = [np.empty((2, 0), np.int64)]
    since_ns = float(begin_ns)
    while since_ns < horizon_ns:
        # Sum the times in parts of `count` intervals; most runs need only one part.
        part, elapsed_ns, begun = np.empty((2, count), np.int64), c_double(0.0), 0
        for at in range(0, count, BLOCK):
            rows = min(BLOCK, count - at)
            begin, end = part[:, at : at + rows]
            off, on = times_off.values(rows), times_on.values(rows)
            begun += _alternate()(
                off, on, rows, unit_ns, since_ns, elapsed_ns, horizon_ns, begin, end
            )
            if begun < at + rows:
                break
        parts.append(part[:, :begun])
        since_ns += elapsed_ns.value
    begin, end = parts[-1] if len(parts) == 2 else np.concatenate(parts, axis=1)
    return OnOffIntervals(begin, end, np.full(len(begin), RAMP_STEPS))


_alternate = foreign(
    *("dwell_alternate", c_int64, FLOATS_IN, FLOATS_IN, c_int64),
    *(c_double, c_double, POINTER(c_double), c_double, INTS_OUT, INTS_OUT),
)
