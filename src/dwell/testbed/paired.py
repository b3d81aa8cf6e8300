"""Paired: execution times as rows in which the tasks of a node keep what they had in common.

Where others share the machine, its CPUs are fast at times and slow at others, for all that runs on
them. A row holds one cycle of a run, every task on every node. A task that was not there in that
run, because its cycles were placed elsewhere, takes its times from a run in which it was: with
those of the other tasks of its node that were not there either, in the order of their cycles.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["Part", "paired"]

Floats: TypeAlias = NDArray[np.float64]
SiteName: TypeAlias = tuple[str, str]


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


def paired(parts: Mapping[SiteName, Mapping[str, Part]]) -> dict[SiteName, Floats]:
    """Return a column of times for every task on every node, all of one length.

    Parameters
    ----------
    parts : mapping of (str, str) to mapping of str to Part
        By task and node, and by run; at least one run each.
    """
    runs = list(dict.fromkeys(run for of in parts.values() for run in of))
    blocks = {
        run: _block({site: of[run] for site, of in parts.items() if run in of}) for run in runs
    }
    columns: dict[SiteName, list[Floats]] = {site: [] for site in parts}
    # Where each run's rows go on when they stand in for another's.
    begins: dict[tuple[str, str], int] = {}
    for block in blocks.values():
        rows = len(next(iter(block.values())))
        for node in dict.fromkeys(node for _, node in parts):
            missing = {site for site in parts if site[1] == node} - block.keys()
            for site in block.keys() - missing:
                if site[1] == node:
                    columns[site].append(block[site])
            while missing:
                donor = max(runs, key=lambda other: len(missing & blocks[other].keys()))
                begin = begins.get((donor, node), 0)
                length = len(next(iter(blocks[donor].values())))
                taken = (begin + np.arange(rows)) % length
                begins[donor, node] = (begin + rows) % length
                for site in missing & blocks[donor].keys():
                    columns[site].append(blocks[donor][site][taken])
                missing -= blocks[donor].keys()
    return {site: np.concatenate(values) for site, values in columns.items()}


def _block(of: Mapping[SiteName, Part]) -> dict[SiteName, Floats]:
    """Return one run's times with a row for every cycle; a job that is missing is as the last."""
    cycles = np.unique(np.concatenate([part.cycles for part in of.values()]))
    found = {}
    for site, part in of.items():
        place = np.searchsorted(part.cycles, cycles, side="right") - 1
        found[site] = part.times_ms[np.maximum(place, 0)]
    return found
