"""Sums of times that 64 bits may not hold: what is beyond `LAST_NS` is at it, and never comes."""

from __future__ import annotations

from dwell.kernels.compiled import phase

#: The largest number of nanoseconds that is exact as int64 and as float64.
LAST_NS = (1 << 63) - 1024
LONGEST = float(LAST_NS)


@phase
def later(t: int, duration: int) -> int:
    """Return the instant a duration after t; both are at least 0 and at most `LAST_NS`, ns."""
    return t + min(duration, LAST_NS - t)


@phase
def whole_ns(duration: float) -> int:
    """Return a duration of whole nanoseconds, at most `LAST_NS`."""
    return int(min(duration, LONGEST))
