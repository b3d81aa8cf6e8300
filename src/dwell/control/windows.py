"""Metrics of a closed window: L95, violation rate, utilisation.

Everything works on one window, or on the rows of many at once, with the same arithmetic: a window
that the live runtime closes, one that the simulator closes, and all windows of a static run closed
together give the same bits.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.paths import l95_rank
from dwell.model.instants import NEVER_NS

Ints: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]


def missed_cycles(latency_ns: Ints, age_ns: Ints, deadline_ns: int) -> Ints | int:
    """Count the cycles that missed: later than D, or unfinished when their window closed.

    Parameters
    ----------
    latency_ns : int64 array, shape (..., W)
        Final latency as known; `NEVER_NS` where the cycle has not completed.
    age_ns : int64 array, shape (..., W)
        From each cycle's release to the close of its window.
    deadline_ns : int
        D.

    Returns
    -------
    int, or int64 array of shape (...)
    """
    late = latency_ns > np.minimum(age_ns, deadline_ns)
    # On one window the plain count is several times as fast.
    if late.ndim == 1:
        return int(np.count_nonzero(late))
    missed: Ints = np.asarray(np.count_nonzero(late, axis=-1))
    return missed


def seen_l95_ns(latency_ns: Ints, age_ns: Ints, censor_ns: int) -> Ints:
    """L95 as it could be known when the window closed: an unfinished cycle counts with its age.

    Parameters
    ----------
    latency_ns, age_ns : int64 array, shape (..., W)
        As in `missed_cycles`.
    censor_ns : int
        No latency counts for more than this.

    Returns
    -------
    int64 array, shape (...)
    """
    seen = np.minimum(latency_ns, age_ns)
    rank = l95_rank(seen.shape[-1])
    seen.partition(rank - 1, axis=-1)
    # Censoring is monotone, so censoring the order statistic is censoring every latency.
    l95: Ints = np.minimum(seen[..., rank - 1], censor_ns)
    return l95


def final_l95_ms(latency_ns: Ints) -> Floats:
    """L95 of final latencies, shape (..., W), in ms; infinite where too many never completed."""
    rank = l95_rank(latency_ns.shape[-1])
    l95 = np.partition(latency_ns, rank - 1, axis=-1)[..., rank - 1]
    ms: Floats = np.where(l95 >= NEVER_NS, np.inf, l95 / 1e6)
    return ms


def utilisation(core_ns: Floats, cores: Floats, span_ns: Ints | int) -> Floats:
    """Share of the cores that was busy, as the operating system of each node would show it.

    Parameters
    ----------
    core_ns : float64 array, shape (..., nodes)
        Busy core-nanoseconds in the window.
    cores : float64 array, shape (nodes,)
    span_ns : int, or int64 array of shape (..., 1)
        Length of the window.
    """
    return np.minimum(core_ns / (cores * span_ns), 1.0)
