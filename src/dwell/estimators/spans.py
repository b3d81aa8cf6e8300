"""Durations of a window, and when what has not ended counts as lost."""

from __future__ import annotations

import numpy as np

from dwell.model.number_arrays import Floats, Ints
from dwell.model.problem import Problem

NS_PER_MS = 1e6
#: Periods after which a job or message that has not ended counts as lost.
PATIENCE = 2


def patience_ns(problem: Problem) -> int:
    """Time after which what has not ended at the close of its window counts as lost.

    In windows of one or two cycles nothing is ever that old; there it is what has not ended before
    the window's last release.
    """
    periods = min(PATIENCE, problem.window_cycles - 1)
    return round(periods * problem.pipeline.period_ms * NS_PER_MS)


def spans_ms(begin_ns: Ints, end_ns: Ints, limit_ns: int) -> Floats:
    """Return the durations between instants, milliseconds.

    They are NaN where something had not begun, or had begun a moment ago, and infinite where it was
    lost.

    Parameters
    ----------
    begin_ns, end_ns : int64 array, shape (n, columns)
        -1 for an instant that had not come.
    limit_ns : int
        What began before this, and has not ended, counts as lost.
    """
    span: Floats = (end_ns - begin_ns) / NS_PER_MS
    open_ended = np.minimum(begin_ns, end_ns) < 0
    if open_ended.any():
        lost = (begin_ns >= 0) & (begin_ns < limit_ns)
        span[open_ended] = np.where(lost[open_ended], np.inf, np.nan)
    return span
