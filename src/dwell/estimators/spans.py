"""Durations of jobs and messages in a window, and when unfinished ones count as lost."""

from __future__ import annotations

import numpy as np

from dwell.model.number_arrays import Floats, Ints
from dwell.model.problem import Problem

NS_PER_MS = 1e6
#: Periods after which an unfinished job or message counts as lost.
PATIENCE = 2


def patience_ns(problem: Problem) -> int:
    """Return the age from which an unfinished job or message counts as lost at a window's end.

    The age is `PATIENCE` periods, but at most one period less than the window.
    """
    periods = min(PATIENCE, problem.window_cycles - 1)
    return round(periods * problem.pipeline.period_ms * NS_PER_MS)


def spans_ms(begin_ns: Ints, end_ns: Ints, limit_ns: int) -> Floats:
    """Return the durations between instants, milliseconds.

    A duration is infinite if the job or message is lost, and NaN if it has not begun or is
    unfinished but not lost.

    Parameters
    ----------
    begin_ns, end_ns : int64 array, shape (n, columns)
        -1 for an instant in the future.
    limit_ns : int
        An unfinished job or message that began before this instant counts as lost.
    """
    span: Floats = (end_ns - begin_ns) / NS_PER_MS
    open_ended = np.minimum(begin_ns, end_ns) < 0
    if open_ended.any():
        lost = (begin_ns >= 0) & (begin_ns < limit_ns)
        span[open_ended] = np.where(lost[open_ended], np.inf, np.nan)
    return span
