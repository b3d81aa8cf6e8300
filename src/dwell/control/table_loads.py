"""Loads: costs of a fleet's cells at any placements, by a table of loads."""

from __future__ import annotations

import bisect
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from dwell.cost import price
from dwell.estimators.cell_terms import CellTerms
from dwell.estimators.load_table import LoadTable


class AtLoad(NamedTuple):
    """Loads of shared resources at some placements.

    Parameters
    ----------
    loads : mapping of str to float
        Busy cores, or places, by resource.
    waiting : mapping of (kind, candidate) to int
        Number of cells with work on a shared resource.
    """

    loads: Mapping[str, float]
    waiting: Mapping[tuple[int, str], int]


#: Cost of a cell that is not served, in the search for placements that serve most cells. It is
#: more than the other cells can save.
UNSERVED = 1000.0


class Loads:
    """Costs of a fleet's cells at any placements, interpolated in a table of loads.

    Parameters
    ----------
    table : LoadTable
    limit : float, optional
        V_D above which a cell costs more, by `shortfall`.
    """

    def __init__(self, table: LoadTable, limit: float | None = None) -> None:
        self._kinds, self._work = table.kinds, table.work
        #: Loads, and the increase of J at each load, by kind and candidate.
        self._waits: dict[tuple[int, str], tuple[list[float], list[float]]] = {}
        for group, column in table.columns.items():
            objective = table.cells[group[0]].problem.objective
            l95_ms, rate, nothing = column.l95_ms, column.violation_rate, np.zeros(1)
            j = price(l95_ms, rate, nothing, nothing, 0.0, 0.0, objective)
            if limit is not None:
                j = j + [shortfall(one, limit) for one in rate.tolist()]
            self._waits[group] = column.level.tolist(), (j - j[0]).tolist()
        terms = [CellTerms(cell.problem, table.shared).of_one() for cell in table.cells]
        #: Cost to the fleet per busy core, or place, of each shared resource.
        self._of_one = {
            name: sum(one.get(name, 0.0) for one in terms) / len(terms)
            for name in dict.fromkeys(name for work in self._work for name, _ in work.values())
        }

        self._filling = {
            name: [group for group in self._waits if self.resource(*group) == name]
            for name in self._of_one
        }

    def __repr__(self) -> str:
        return f"<Loads of {len(self._kinds)} cells on {', '.join(self.resources) or 'nothing'}>"

    @property
    def resources(self) -> tuple[str, ...]:
        """Shared resources that are the most used one of some candidate."""
        return tuple(self._of_one)

    def most(self, resource: str) -> float:
        """Return the largest possible load of a resource by all cells, in cores or places."""
        return sum(
            max((work for where, work in of.values() if where == resource), default=0.0)
            for of in self._work
        )

    def group(self, index: int, name: str) -> tuple[int, str]:
        """Return the kind of a cell and a candidate; cells with equal groups wait alike."""
        return self._kinds[index], name

    def resource(self, index: int, name: str) -> str | None:
        """Return the shared resource that a cell's candidate uses most."""
        return self._work[index].get(name, (None, 0.0))[0]

    def work(self, index: int, name: str) -> float:
        """Return the work of a cell's candidate on this resource, in cores or places."""
        return self._work[index].get(name, (None, 0.0))[1]

    def wait(self, index: int, name: str, load: float) -> float:
        """Return the increase of J of a cell's candidate at a load of its shared resource."""
        of = self._waits.get(self.group(index, name))
        return 0.0 if of is None else _between(load, *of)

    def at(self, placements: Sequence[str]) -> AtLoad:
        """Return the loads at placements."""
        loads, waiting = dict.fromkeys(self._of_one, 0.0), Counter[tuple[int, str]]()
        for i, name in enumerate(placements):
            if name in self._work[i]:
                resource, work = self._work[i][name]
                loads[resource] += work
                waiting[self.group(i, name)] += 1
        return AtLoad(loads, waiting)

    def rise(self, at: AtLoad, index: int, here: str, there: str) -> float:
        """Return the increase of Φ by a move of a cell, without the cell's own J alone."""
        loads = dict(at.loads)
        for name, sign in ((here, -1.0), (there, 1.0)):
            if name in self._work[index]:
                resource, work = self._work[index][name]
                loads[resource] += sign * work
        of_here, of_there = self.group(index, here), self.group(index, there)
        rise = 0.0
        for resource, load in loads.items():
            before = at.loads[resource]
            rise += self._of_one[resource] * (load - before)
            for group in self._filling[resource]:
                count = at.waiting[group]
                if group == of_here:
                    rise -= _between(before, *self._waits[group])
                    count -= 1
                elif group == of_there:
                    rise += _between(load, *self._waits[group])
                if count and load != before:
                    waits = self._waits[group]
                    rise += count * (_between(load, *waits) - _between(before, *waits))
        return rise

    def costs(self, placements: Sequence[str], alone: Sequence[Mapping[str, float]]) -> list[float]:
        """Return J of every cell, without switching, then the cost of shared resources.

        Parameters
        ----------
        alone : sequence of mapping of str to float
            By cell, J of every candidate without other cells.
        """
        loads = self.at(placements).loads
        waits: dict[tuple[int, str], float] = {}
        costs = []
        for i, (name, mine) in enumerate(zip(placements, alone, strict=True)):
            group = self._kinds[i], name
            wait = waits.get(group)
            if wait is None:
                load = loads.get(self.resource(i, name) or "", 0.0)
                wait = waits[group] = self.wait(i, name, load)
            costs.append(mine[name] + wait)
        return [*costs, sum(self._of_one[one] * load for one, load in loads.items())]


def shortfall(rate: float, limit: float) -> float:
    """Return the cost of a V_D above the limit: `UNSERVED` from twice the limit on.

    It grows with V_D, since the table's V_D has errors.
    """
    return UNSERVED * min(max(rate / limit - 1.0, 0.0), 1.0)


def moved(placements: Sequence[str], index: int, name: str) -> tuple[str, ...]:
    """Return placements with another candidate of one cell."""
    return (*placements[:index], name, *placements[index + 1 :])


def _between(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Interpolate linearly, constant beyond both ends."""
    i = bisect.bisect_right(xs, x)
    if i == 0 or i == len(xs):
        return ys[max(i - 1, 0)]
    x0, x1, y0, y1 = xs[i - 1], xs[i], ys[i - 1], ys[i]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)
