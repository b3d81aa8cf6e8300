"""Bounds: whether a number keeps within them, as its whole interval says."""

from __future__ import annotations

import math

from dwell.study.intervals import Interval

#: Share of missed deadlines that a cell should stay under (the paper's 5 %).
AIM = 0.05
#: The least number above 0: at least this is "above 0".
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
        In the number's unit; a number that is equal to one of them keeps it.

    Returns
    -------
    bool or None
        True where the whole interval lies within, False where the whole of it lies beyond one of
        them, None where it allows for either, or is not known.
    """
    if known.low >= at_least and known.high <= at_most:
        return True
    return False if known.high < at_least or known.low > at_most else None
