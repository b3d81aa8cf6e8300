"""Bounds on numbers over seeds, checked against their intervals."""

from __future__ import annotations

import math

from dwell.study.intervals import Interval

#: The smallest number above 0, as a bound for "above 0".
ABOVE_ZERO = math.ulp(0.0)


def keeps(
    known: Interval, *, at_least: float = -math.inf, at_most: float = math.inf
) -> bool | None:
    """Whether a number over seeds is within bounds.

    Parameters
    ----------
    known : Interval
        The number with its interval.
    at_least, at_most : float
        Bounds in the number's unit; a number equal to a bound is within it.

    Returns
    -------
    bool or None
        True if the complete interval is within the bounds, False if it is entirely beyond one
        bound, None if it includes a bound or is unknown.
    """
    if known.low >= at_least and known.high <= at_most:
        return True
    return False if known.high < at_least or known.low > at_most else None
