"""Cycles that miss, also because the data of their actuations are too old."""

from __future__ import annotations

from collections.abc import Iterator

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
    for one, _ in _over_bounds(pipeline, release_ns, arrays, cycles, by_ns):
        over |= one
    return over


def stale_origins(pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, cycles: slice) -> Ints:
    """Return the origin of each actuation in some cycles whose age is over its chain's bound."""
    found = _over_bounds(pipeline, release_ns, arrays, cycles, NEVER_NS - 1)
    return np.concatenate([np.empty(0, np.int64), *(origins[over] for over, origins in found)])


def _over_bounds(
    pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, cycles: slice, by_ns: Ints | int
) -> Iterator[tuple[NDArray[np.bool_], Ints]]:
    """Yield whether each age is over the bound of a chain, and the origins, for each bound."""
    for number, chain in enumerate(pipeline.chains.values()):
        if chain.is_bounded:
            at_ns = arrays.tables.actuated_ns[0, number, cycles]
            origins = arrays.tables.actuated_from[0, number, cycles]
            yield (at_ns <= by_ns) & (at_ns - release_ns[origins] > chain.max_age_ns), origins


def misses(
    pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, cycles: slice
) -> NDArray[np.bool_]:
    """Return whether each of some cycles is late or its data are too old; idle cycles are not."""
    missed = arrays.tables.latency_ns[0, cycles] > pipeline.deadline_ns
    missed |= over_age(pipeline, release_ns, arrays, cycles)
    missed &= _is_due(arrays, cycles)
    return missed


def due_misses(
    pipeline: Pipeline, release_ns: Ints, arrays: CellArrays, cycles: slice
) -> NDArray[np.bool_]:
    """Return whether each cycle is late or its data are too old, without idle cycles."""
    return misses(pipeline, release_ns, arrays, cycles)[_is_due(arrays, cycles)]


def _is_due(arrays: CellArrays, cycles: slice) -> NDArray[np.bool_]:
    """Return whether a sink is due in each of some cycles."""
    due: NDArray[np.bool_] = arrays.tables.outcome[0, cycles] != CycleOutcome.IDLE
    return due
