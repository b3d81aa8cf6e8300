"""Data ages of chains in windows."""

from __future__ import annotations

import numpy as np

from dwell.control import NO_AGE
from dwell.kernels.arrays import CellArrays
from dwell.kernels.realisation import Realisation
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Ints


def chain_ages_ns(realisation: Realisation, arrays: CellArrays, number: int) -> Ints:
    """Return the data age at the actuation of each cycle, `NO_AGE` without one.

    docs/background/simulator.md defines ages, under "Chains". `number` is the number of the chain.
    """
    tables, cycles = arrays.tables, slice(realisation.cycles)
    at_ns, origin = tables.actuated_ns[0, number, cycles], tables.actuated_from[0, number, cycles]
    return np.where(at_ns < NEVER_NS, at_ns - realisation.release_ns[origin], NO_AGE)
