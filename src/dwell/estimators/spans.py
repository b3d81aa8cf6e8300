"""Durations of the jobs and messages of a window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.evidence import Instants
from dwell.model.problem import Problem

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]

NS_PER_MS = 1e6
#: Periods after which a job or message that has not ended counts as lost.
PATIENCE = 2


@dataclass(frozen=True, slots=True)
class Spans:
    """Durations in milliseconds: NaN where something had not begun, or had begun a moment ago.

    Parameters
    ----------
    job_ms : float64 array, shape (n, tasks)
        From readiness to completion, queueing and contention included; infinite where it was lost.
    message_ms : float64 array, shape (n, flows)
        From the completion of the source to the hand-over; infinite where it was lost.
    """

    job_ms: Floats
    message_ms: Floats


def patience_ns(problem: Problem) -> int:
    """Time after which what has not ended at the close of its window counts as lost.

    In windows of one or two cycles nothing is ever that old; there it is what has not ended before
    the window's last release.
    """
    periods = min(PATIENCE, problem.window_cycles - 1)
    return round(periods * problem.pipeline.period_ms * NS_PER_MS)


def spans_of(instants: Instants, sent_ns: Ints, limit_ns: int) -> Spans:
    """Return the durations between instants.

    Parameters
    ----------
    sent_ns : int64 array, shape (n, flows)
        When the source of each message completed.
    limit_ns : int
        A job or message that began before this, and has not ended, counts as lost.
    """
    return Spans(
        _between(instants.ready_ns, instants.end_ns, limit_ns),
        _between(sent_ns, instants.arrived_ns, limit_ns),
    )


def _between(begin_ns: Ints, end_ns: Ints, limit_ns: int) -> Floats:
    span: Floats = (end_ns - begin_ns) / NS_PER_MS
    open_ended = np.minimum(begin_ns, end_ns) < 0
    if open_ended.any():
        lost = (begin_ns >= 0) & (begin_ns < limit_ns)
        span[open_ended] = np.where(lost[open_ended], np.inf, np.nan)
    return span
