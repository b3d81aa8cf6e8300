"""Durations of jobs and messages in a window, and the age at which they count as lost."""

from __future__ import annotations

import numpy as np

from dwell.model.number_arrays import Floats, Ints
from dwell.model.problem import Problem

NS_PER_MS = 1e6


def patience_ns(problem: Problem, every: int = 1) -> int:
    """Return the age from which an unfinished job or message counts as lost at a window's end.

    `every` is the rate of its task. The age is `Problem.patience_cycles` periods; D - P more if D
    is longer than P, because the window then ends later by as much.
    """
    pipeline, periods = problem.pipeline, problem.patience_cycles(every)
    more_ns = max(pipeline.deadline_ns - pipeline.period_ns, 0)
    return round(periods * pipeline.period_ms * NS_PER_MS) + more_ns


def task_patience_ns(problem: Problem) -> Ints:
    """Return the patience with each column of jobs in the evidence (see `patience_ns`)."""
    rates, tasks = problem.pipeline.rates, list(problem.pipeline.tasks)
    # In a cell with replicas the second copies follow.
    columns = tasks * 2 if problem.replicas else tasks
    return np.array([patience_ns(problem, rates[name]) for name in columns], np.int64)


def spans_ms(begin_ns: Ints, end_ns: Ints, limit_ns: Ints | int) -> Floats:
    """Return the durations between instants, milliseconds.

    An instant in the future is -1. An unfinished job or message that began before `limit_ns`, which
    may differ by column, counts as lost: its duration is infinite. Other unknown durations are NaN.
    """
    span: Floats = (end_ns - begin_ns) / NS_PER_MS
    open_ended = np.minimum(begin_ns, end_ns) < 0
    if open_ended.any():
        lost = (begin_ns >= 0) & (begin_ns < limit_ns)
        span[open_ended] = np.where(lost[open_ended], np.inf, np.nan)
    return span
