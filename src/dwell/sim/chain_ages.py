"""Data ages of chains in windows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dwell.kernels.arrays import CellArrays
from dwell.kernels.realisation import Realisation
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import rank_of

#: Age of a cycle without an actuation.
NO_AGE = -1


def chain_ages_ns(realisation: Realisation, arrays: CellArrays, number: int) -> Ints:
    """Return the data age at the actuation of each cycle, `NO_AGE` without one.

    docs/background/simulator.md defines ages, under "Chains". `number` is the number of the chain.
    """
    tables, cycles = arrays.tables, slice(realisation.cycles)
    at_ns, origin = tables.actuated_ns[0, number, cycles], tables.actuated_from[0, number, cycles]
    return np.where(at_ns < NEVER_NS, at_ns - realisation.release_ns[origin], NO_AGE)


def age_l95_ms(ages_ns: Ints) -> Floats:
    """Return L95 of the ages in each window, ms; infinite for a window without actuations."""
    is_known = ages_ns != NO_AGE
    count = is_known.sum(axis=1)
    ordered = np.sort(np.where(is_known, ages_ns / 1e6, np.inf), axis=1)
    rank = np.maximum(rank_of(95, count), 1)
    l95: Floats = np.take_along_axis(ordered, rank[:, None] - 1, axis=1)[:, 0]
    return l95


def age_missed(ages_ns: Ints, max_age_ns: int) -> Floats:
    """Return the share of each window's actuations with a larger age; 1 without actuations."""
    is_known = ages_ns != NO_AGE
    count = is_known.sum(axis=1)
    over: NDArray[np.bool_] = is_known & (ages_ns > max_age_ns)
    share: Floats = np.where(count > 0, over.sum(axis=1) / np.maximum(count, 1), 1.0)
    return share
