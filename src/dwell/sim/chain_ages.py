"""Data ages and reaction times of chains in windows."""

from __future__ import annotations

import numpy as np

from dwell.control import NO_AGE, final_l95_ms, reactions
from dwell.kernels.arrays import CellArrays
from dwell.kernels.realisation import Realisation
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints


def chain_ages_ns(realisation: Realisation, arrays: CellArrays, number: int) -> Ints:
    """Return the data age at the actuation of each cycle, `NO_AGE` without one.

    docs/background/simulator.md defines ages, under "Chains". `number` is the number of the chain.
    """
    tables, cycles = arrays.tables, slice(realisation.cycles)
    at_ns, origin = tables.actuated_ns[0, number, cycles], tables.actuated_from[0, number, cycles]
    return np.where(at_ns < NEVER_NS, at_ns - realisation.release_ns[origin], NO_AGE)


def reaction_l95_ms(
    realisation: Realisation, arrays: CellArrays, number: int, every: int, firsts: Ints, width: int
) -> Floats:
    """Return L95 of the reaction times of a chain that end in each window; infinite without any.

    Parameters
    ----------
    number, every : int
        Number of the chain, and cycles from one release of its first task to the next.
    firsts : int64 array, shape (windows,)
        First cycle of each window of `width` cycles.
    """
    tables, cycles = arrays.tables, slice(realisation.cycles)
    at_ns, newest = (
        table[0, number, cycles] for table in (tables.actuated_ns, tables.actuated_newest)
    )
    cycle, place = reactions(at_ns, newest, every, 0)
    after_ns = at_ns[place] - realisation.release_ns[cycle]
    # Windows with equally many reaction times have their L95 at the same rank.
    order = np.argsort(place, kind="stable")
    begin, end = np.searchsorted(place[order], (firsts, firsts + width))
    result = np.full(len(firsts), np.inf)
    for count in set((end - begin).tolist()) - {0}:
        alike = np.flatnonzero(end - begin == count)
        inside = order[begin[alike, None] + np.arange(count)]
        result[alike] = final_l95_ms(after_ns[inside])
    return result
