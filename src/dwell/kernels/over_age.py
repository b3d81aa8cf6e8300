"""Cycles that miss because the data of their actuations are too old."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.arrays import CellArrays
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints
from dwell.model.pipeline import Pipeline


def over_age(
    pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, by_ns: Ints | int = NEVER_NS - 1
) -> NDArray[np.bool_]:
    """Return whether a chain's age at the actuation of each cycle is over its bound.

    Parameters
    ----------
    release_ns : int64 array
        Releases of the cycles to look at, from the first one on.
    arrays : CellArrays
        After the simulation.
    by_ns : int, or int64 array of the same shape
        Only actuations until this instant count, as at the close of each cycle's window.
    """
    tables, cycles = arrays.tables, slice(len(release_ns))
    over = np.zeros(len(release_ns), np.bool_)
    for number, chain in enumerate(pipeline.chains.values()):
        if chain.is_bounded:
            at_ns = tables.actuated_ns[0, number, cycles]
            age_ns = at_ns - release_ns[tables.actuated_from[0, number, cycles]]
            over |= (at_ns <= by_ns) & (age_ns > chain.max_age_ns)
    return over
