"""How strong a disturbance is at an instant, sought among its intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.on_off_intervals import OnOffIntervals

Ints = NDArray[np.int64]


def levels_at(intervals: OnOffIntervals, at: Ints) -> Ints:
    """Return the strength at each instant, 0 where nothing is on."""
    if len(intervals.begin) == 0:
        return np.zeros(len(at), np.int64)
    last = np.searchsorted(intervals.begin, at, side="right") - 1
    return np.where((last >= 0) & (at < intervals.end[last]), intervals.level[last], 0)
