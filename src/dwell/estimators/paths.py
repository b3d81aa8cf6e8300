"""Latency of cycles from the times of their parts: the longest path through the DAG."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model.pipeline import Flow, Pipeline

__all__ = ["longest_path", "order_statistic", "seen_windows"]

Floats: TypeAlias = NDArray[np.float64]


def longest_path(
    pipeline: Pipeline, executed: Callable[[str], Floats], sent: Callable[[Flow], Floats]
) -> Floats:
    """Latency of each cycle, in the unit of its parts (paper, eq. 3, for any DAG).

    Parameters
    ----------
    pipeline : Pipeline
    executed : callable
        Time of a task's job in each cycle, shape (n,).
    sent : callable
        Time of a flow's message in each cycle, shape (n,); 0 on one node.

    Returns
    -------
    float64 array, shape (n,)
    """
    finish: dict[str, Floats] = {}
    for name in pipeline.topological():
        taken = executed(name)
        ready = np.full(taken.shape, float(pipeline.tasks[name].offset_ms))
        for flow in pipeline.inputs(name):
            np.maximum(ready, finish[flow.source] + sent(flow), out=ready)
        finish[name] = ready + taken
    sinks = [finish[name] for name in pipeline.tasks if not pipeline.outputs(name)]
    latency: Floats = np.maximum.reduce(sinks)
    return latency


def order_statistic(values: Floats) -> float:
    """L95: the ceil(0.95 n)-th smallest of n values, never interpolated."""
    rank = (19 * len(values) + 19) // 20  # in integers: 0.95 * n is not exact
    return float(np.partition(values, rank - 1)[rank - 1])


def seen_windows(latency_ms: Floats, window_cycles: int, age_ms: Floats, censor_ms: float) -> float:
    """Mean over windows of the L95 that a controller would see.

    The mean of a window's 95th percentile is not the 95th percentile of all cycles: where a few
    percent of the cycles are lost, a window with more of them than usual decides the mean.

    Parameters
    ----------
    latency_ms : float64 array, shape (windows * W,)
        Infinite where a cycle is lost.
    window_cycles : int
        W.
    age_ms : float64 array, shape (windows * W,)
        What a lost cycle counts as: its age when the window closes.
    censor_ms : float
        No latency counts for more.
    """
    seen = np.minimum(np.where(np.isinf(latency_ms), age_ms, latency_ms), censor_ms)
    rank = (19 * window_cycles + 19) // 20
    by_window = seen.reshape(-1, window_cycles)
    return float(np.partition(by_window, rank - 1, axis=1)[:, rank - 1].mean())
