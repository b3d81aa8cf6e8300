"""Cycles that miss, also because the data of their actuations are too old."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.arrays import CellArrays
from dwell.kernels.codes import CycleOutcome
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints
from dwell.model.pipeline import Pipeline


def over_age(
    pipeline: Pipeline,
    release_ns: Ints,
    arrays: CellArrays,
    cycles: slice,
    by_ns: Ints | int = NEVER_NS - 1,
) -> NDArray[np.bool_]:
    """Return whether a chain's age at the actuation of some cycles is over its bound.

    Parameters
    ----------
    release_ns : int64 array
        Releases of all cycles.
    arrays : CellArrays
        After the simulation of these cycles.
    by_ns : int, or int64 array with a value per cycle
        Only actuations until this instant count, as at the close of each cycle's window.
    """
    over = np.zeros(len(release_ns[cycles]), np.bool_)
    for number, chain in enumerate(pipeline.chains.values()):
        if chain.is_bounded:
            at_ns = arrays.tables.actuated_ns[0, number, cycles]
            age_ns = at_ns - release_ns[arrays.tables.actuated_from[0, number, cycles]]
            over |= (at_ns <= by_ns) & (age_ns > chain.max_age_ns)
    return over


def stale_origins(pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, cycles: slice) -> Ints:
    """Return the origin of each actuation in some cycles whose age is over its chain's bound."""
    found = [np.empty(0, np.int64)]
    for number, chain in enumerate(pipeline.chains.values()):
        if chain.is_bounded:
            at_ns = arrays.tables.actuated_ns[0, number, cycles]
            origin = arrays.tables.actuated_from[0, number, cycles].astype(np.int64)
            found.append(
                origin[(at_ns < NEVER_NS) & (at_ns - release_ns[origin] > chain.max_age_ns)]
            )
    return np.concatenate(found)


def due_misses(
    pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, cycles: slice
) -> NDArray[np.bool_]:
    """Return whether each cycle is late or its data are too old, without idle cycles."""
    tables = arrays.tables
    missed = tables.latency_ns[0, cycles] > pipeline.deadline_ns
    missed |= over_age(pipeline, release_ns, arrays, cycles)
    due: NDArray[np.bool_] = missed[tables.outcome[0, cycles] != CycleOutcome.IDLE]
    return due
