"""Paired: execution times in rows that preserve the correlation between tasks of one CPU.

The speed of a shared machine's CPUs varies, and affects all tasks on a CPU. A row contains one
cycle of a run, with every task on every node. If a run has no jobs of a task on a node, because
its placements used other nodes, the times are taken from a donor run that has them. The donor's
cycle has the same rank, by the times of the tasks on this CPU that both runs have. If the runs
share no task on the CPU, the donor's cycles are used in their order. Missing tasks are taken from
a donor together.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.model import FrozenDict
from dwell.model.number_arrays import Floats
from dwell_lab.testbed.measured import SiteName


class Part(NamedTuple):
    """Times of a task on a node in one run.

    Parameters
    ----------
    cycles : int64 array, shape (jobs,)
        Cycle numbers, ascending.
    times_ms : float64 array, shape (jobs,)
    """

    cycles: NDArray[np.int64]
    times_ms: Floats


def paired(
    parts: Mapping[SiteName, Mapping[str, Part]], cpus: Mapping[str, Hashable] = FrozenDict()
) -> dict[SiteName, Floats]:
    """Return a column of times for every task on every node, all of equal length.

    Parameters
    ----------
    parts : mapping of (str, str) to mapping of str to Part
        Times by task and node, then by run; at least one run each.
    cpus : mapping of str to hashable
        CPUs by node; nodes with equal CPUs share them, and a node without an entry shares none.
    """
    runs = list(dict.fromkeys(run for of in parts.values() for run in of))
    blocks = {
        run: _block({site: of[run] for site, of in parts.items() if run in of}) for run in runs
    }
    beside: dict[Hashable, set[SiteName]] = {}
    for site in parts:
        beside.setdefault(cpus.get(site[1], site[1]), set()).add(site)
    columns: dict[SiteName, list[Floats]] = {site: [] for site in parts}
    # Next row of each donor run that is used in order, by CPU.
    begins: dict[tuple[str, Hashable], int] = {}
    for block in blocks.values():
        rows = len(next(iter(block.values())))
        for place, sites in beside.items():
            have = {site: block[site] for site in sites & block.keys()}
            while missing := sites - have.keys():
                # The donor has most of the missing tasks, then most of the present tasks.
                wanted = missing, have.keys()
                donor = max(blocks, key=lambda run: [len(w & blocks[run].keys()) for w in wanted])
                of = blocks[donor]
                if common := sorted(have.keys() & of.keys()):
                    taken = _as_slow([have[site] for site in common], [of[site] for site in common])
                else:
                    begin, length = begins.get((donor, place), 0), len(next(iter(of.values())))
                    taken = (begin + np.arange(rows)) % length
                    begins[donor, place] = (begin + rows) % length
                have |= {site: of[site][taken] for site in missing & of.keys()}
            for site, values in have.items():
                columns[site].append(values)
    return {site: np.concatenate(values) for site, values in columns.items()}


def _as_slow(ours: Sequence[Floats], theirs: Sequence[Floats]) -> NDArray[np.intp]:
    """Return for each row of one run the index of the row with the same rank in another run.

    The rank is by the sum of the tasks' times: short tasks, which are mostly noise, have little
    weight in it.
    """
    own, other = (np.sum(columns, axis=0) for columns in (ours, theirs))
    place = np.empty(len(own))
    place[np.argsort(own, kind="stable")] = (np.arange(len(own)) + 0.5) / len(own)
    ordered = np.argsort(other, kind="stable")
    return ordered[(place * len(other)).astype(np.intp)]


def _block(of: Mapping[SiteName, Part]) -> dict[SiteName, Floats]:
    """Return a run's times with one row per cycle; a missing job repeats the job before it."""
    cycles = np.unique(np.concatenate([part.cycles for part in of.values()]))
    found = {}
    for site, part in of.items():
        place = np.searchsorted(part.cycles, cycles, side="right") - 1
        found[site] = part.times_ms[np.maximum(place, 0)]
    return found
