"""Knapsack: the placements of a fleet with the least Φ of its table of loads.

For each load that a shared resource may have, cell after cell takes the candidates with the least
sum of costs at that load, with no more work than the load. This is exact for one resource, up to
the rounding of work to levels. Several resources take turns.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dwell.control.table_loads import Loads

#: Levels of the load of a resource, and levels that are computed together, which bounds memory.
LEVELS, TOGETHER = 400, 40


def cheapest(
    loads: Loads, costs: Sequence[Mapping[str, float]], placements: Sequence[str]
) -> tuple[str, ...]:
    """Return the placements with the least sum of costs by the table.

    Parameters
    ----------
    costs : sequence of mapping of str to float
        By cell, cost of each permitted candidate without other cells.
    placements : sequence of str
        Current placements; they determine the load of the other resources in each turn.
    """
    best = tuple(placements)
    for resource in loads.resources or ("",):
        found = dict.fromkeys([best, *_at_levels(loads, costs, best, resource)])
        best = min(found, key=lambda one: float(sum(loads.costs(one, costs))))
    return best


class _Option(NamedTuple):
    """A candidate: its cost at each level, and its work in levels."""

    name: str
    cost: NDArray[np.float64]
    units: int


def _at_levels(
    loads: Loads, costs: Sequence[Mapping[str, float]], placements: Sequence[str], resource: str
) -> Iterator[tuple[str, ...]]:
    """Yield the cheapest placements at each level of the load of a resource."""
    most, others = loads.most(resource), loads.at(placements).loads
    levels = np.linspace(0.0, most, LEVELS + 1) if most else np.zeros(1)
    step = float(levels[1]) if most else 1.0
    waits: dict[tuple[int, str], NDArray[np.float64]] = {}
    cells = []
    for i, of in enumerate(costs):
        options = []
        for name, cost in of.items():
            on, group = loads.resource(i, name), loads.group(i, name)
            if on != resource:
                wait = loads.wait(i, name, others.get(on or "", 0.0))
                options.append(_Option(name, np.full(len(levels), cost + wait), 0))
                continue
            if group not in waits:
                waits[group] = np.array([loads.wait(i, name, load) for load in levels.tolist()])
            units = round(loads.work(i, name) / step)
            options.append(_Option(name, cost + waits[group], units))
        cells.append(options)
    for first in range(0, len(levels), TOGETHER):
        yield from _at_some(cells, first, min(first + TOGETHER, len(levels)))


def _at_some(cells: Sequence[Sequence[_Option]], first: int, end: int) -> Iterator[tuple[str, ...]]:
    """Yield the cheapest placements at the levels of load from `first` to before `end`."""
    # Smallest sum of costs of the cells so far, by level and by their work.
    least, chosen = np.zeros((end - first, end)), []
    for options in cells:
        best, which = np.full_like(least, np.inf), np.zeros(least.shape, np.int16)
        for place, (_, cost, units) in enumerate(options):
            if units < end:
                here = least[:, : end - units] + cost[first:end, None]
                lower = here < best[:, units:]
                np.copyto(best[:, units:], here, where=lower)
                np.copyto(which[:, units:], place, where=lower)
        least = best
        chosen.append(which)
    for row, level in enumerate(range(first, end)):
        if not np.isfinite(least[row, level]):
            continue
        names, left = [], level
        for options, which in zip(reversed(cells), reversed(chosen), strict=True):
            taken = options[which[row, left]]
            left -= taken.units
            names.append(taken.name)
        yield tuple(reversed(names))
