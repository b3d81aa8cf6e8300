"""Paired: execution times as rows in which the tasks of a CPU keep what they had in common.

Where others share the machine, its CPUs are fast at times and slow at others, for all that runs on
them. A row holds one cycle of a run, every task on every node. A task that was not there in that
run, because its cycles were placed elsewhere, takes its times from a run in which it was: from a
cycle that was as slow, among those of its run, for the tasks of its CPU that were there in both.
Where there was none, from the cycles in their order. Tasks that were not there stay together.
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
        Ascending.
    times_ms : float64 array, shape (jobs,)
    """

    cycles: NDArray[np.int64]
    times_ms: Floats


def paired(
    parts: Mapping[SiteName, Mapping[str, Part]], cpus: Mapping[str, Hashable] = FrozenDict()
) -> dict[SiteName, Floats]:
    """Return a column of times for every task on every node, all of one length.

    Parameters
    ----------
    parts : mapping of (str, str) to mapping of str to Part
        By task and node, and by run; at least one run each.
    cpus : mapping of str to hashable
        CPUs of a node; those of a node that is not there are its own.
    """
    runs = list(dict.fromkeys(run for of in parts.values() for run in of))
    blocks = {
        run: _block({site: of[run] for site, of in parts.items() if run in of}) for run in runs
    }
    beside: dict[Hashable, set[SiteName]] = {}
    for site in parts:
        beside.setdefault(cpus.get(site[1], site[1]), set()).add(site)
    columns: dict[SiteName, list[Floats]] = {site: [] for site in parts}
    # Where each run's rows go on when they stand in for another's.
    begins: dict[tuple[str, Hashable], int] = {}
    for block in blocks.values():
        rows = len(next(iter(block.values())))
        for place, sites in beside.items():
            have = {site: block[site] for site in sites & block.keys()}
            while missing := sites - have.keys():
                # The run that has most of the missing tasks, and then of those that are there.
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
    """Return for every row of some tasks that of another run that has the same place in it.

    A row's place among all is by how long its tasks took together: short ones, whose noise is as
    large as what slows them, have little say.
    """
    own, other = (np.sum(columns, axis=0) for columns in (ours, theirs))
    place = np.empty(len(own))
    place[np.argsort(own, kind="stable")] = (np.arange(len(own)) + 0.5) / len(own)
    ordered = np.argsort(other, kind="stable")
    return ordered[(place * len(other)).astype(np.intp)]


def _block(of: Mapping[SiteName, Part]) -> dict[SiteName, Floats]:
    """Return one run's times with a row for every cycle; a job that is missing is as the last."""
    cycles = np.unique(np.concatenate([part.cycles for part in of.values()]))
    found = {}
    for site, part in of.items():
        place = np.searchsorted(part.cycles, cycles, side="right") - 1
        found[site] = part.times_ms[np.maximum(place, 0)]
    return found
