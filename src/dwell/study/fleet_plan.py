"""Plan: good placements of a fleet, found with the table of loads and improved by simulation.

The search begins at the placements with the lowest Φ of the table: a knapsack for one shared
resource, a mixed-integer program for several. A local search then moves one or two cells at a time,
as long as the simulated Φ improves. Small fleets repeat it from placements nearby.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dwell.control.fleet_rank import FleetRank, fleet_rank
from dwell.control.knapsack import cheapest
from dwell.control.neighbours import Neighbours, Rank
from dwell.control.table_loads import Loads
from dwell.estimators.cell_terms import CellTerms
from dwell.estimators.fleet_prices import FleetPrice, FleetPrices
from dwell.estimators.load_table import load_table
from dwell.estimators.prices import SEED, prices_of
from dwell.model.fleet import Fleet
from dwell.model.progress import Progress
from dwell.model.qos import QoS
from dwell.sim.fleet import phased, priced_cells, tabled_cells

#: Number of load levels per resource if several resources are shared.
LEVELS_OF_SEVERAL = 40
#: Largest number of cells that the search simulates; limits its time for large fleets.
CELLS_PLAYED = 20_000
#: Searches with fewer simulations start again, with a number of cells at random candidates.
ENOUGH_PLAYS, ELSEWHERE = 200, 4
#: Simulated cycles of the final plan: total over all cells, and most per cell.
CYCLES, MOST = 1_000_000, 15_000


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """Placements of a fleet with the best simulated price of the search.

    Parameters
    ----------
    placements : mapping of str to str
        Candidate of each cell.
    table_phi : float
        Φ per cell, from the table of loads.
    played : FleetPrice
        Simulated price of the fleet with these placements.
    """

    placements: Mapping[str, str]
    table_phi: float
    played: FleetPrice

    def __repr__(self) -> str:
        return f"<FleetPlan: {len(self.placements)} cells, {self.phi:.4g} a cell>"

    @property
    def phi(self) -> float:
        """Simulated Φ per cell."""
        return self.played.phi / len(self.placements)

    @property
    def cells(self) -> dict[str, QoS]:
        """Simulated metrics by cell."""
        priced = map(self.played.qos, range(len(self.placements)))
        return {name: qos for name, qos in zip(self.placements, priced, strict=True) if qos}

    def above(self, limit: float) -> list[str]:
        """Return the cells with V_D above a limit."""
        return [name for name, qos in self.cells.items() if qos.violation_rate > limit]

    def as_json(self) -> dict[str, object]:
        """Return it as plain values."""
        return {
            "phi": self.phi,
            "table_phi": self.table_phi,
            "cells": [
                {
                    "cell": name,
                    "placement": self.placements[name],
                    "violation_rate": qos.violation_rate,
                    "l95_ms": qos.l95_ms,
                }
                for name, qos in self.cells.items()
            ],
        }


def plan_fleet(fleet: Fleet, *, seed: int = 1, progress: Progress | None = None) -> FleetPlan:
    """Find good placements of a fleet in its scenarios, by its objective.

    `seed` samples random phases. `progress` receives the finished and total levels of the table.
    """
    cells = [
        replace(one, scenario=cell.entry.scenario)
        for cell, one in zip(fleet.cells, priced_cells(fleet, phased(fleet, seed)), strict=True)
    ]
    table = load_table(tabled_cells(fleet, seed), fleet.shared, progress)
    loads, rank = Loads(table), fleet_rank(fleet.objective, cells, fleet.limit)
    priced = [prices_of(cell.problem, cell.scenario) for cell in cells]
    terms = [CellTerms(cell.problem, fleet.shared) for cell in cells]
    alone = [
        {name: of.cost(price.qos) for name, price in prices_alone.items()}
        for of, prices_alone in zip(terms, priced, strict=True)
    ]
    aims = [
        {name: rank.aim(costs[name], price.qos.violation_rate) for name, price in of.items()}
        for costs, of in zip(alone, priced, strict=True)
    ]
    aimed, starts = loads, [tuple(best_placements(loads, alone))]
    if rank.limit is not None:
        aimed = Loads(table, rank.limit)
        starts.append(tuple(best_placements(aimed, aims)))
    prices = FleetPrices(cells, fleet.shared, disturbances=fleet.disturbances)
    best = _as_played(prices, rank, aimed, aims, starts)
    cycles = min(CYCLES, MOST * len(cells))
    prices = FleetPrices(cells, fleet.shared, cycles, fleet.disturbances)
    played = prices.price(tuple(best))
    names = [cell.name for cell in cells]
    phi = sum(loads.costs(best, alone)) / len(cells)
    return FleetPlan(dict(zip(names, best, strict=True)), phi, played)


def _as_played(
    prices: FleetPrices,
    rank: FleetRank,
    loads: Loads,
    alone: Sequence[Mapping[str, float]],
    starts: Sequence[tuple[str, ...]],
) -> tuple[str, ...]:
    """Search from the best start, and return the best simulated placements.

    `prices` must have no known prices: they count as simulations of this search.
    """
    most, played = max(CELLS_PLAYED // len(alone), 1), prices.known

    def ranked(placements: tuple[str, ...]) -> Rank | None:
        if placements not in played and len(played) >= most:
            return None
        return rank.of(prices.price(placements))

    def aims(placements: tuple[str, ...]) -> list[float]:
        return rank.aims(prices.price(placements))

    near = Neighbours(prices.cells, loads)
    best = near.search(starts, alone, aims, ranked)
    rng = np.random.Generator(np.random.SFC64(SEED))
    for _ in range(ENOUGH_PLAYS):
        if len(played) >= min(ENOUGH_PLAYS, most):
            break
        start = list(best)
        for i in rng.permutation(len(start))[:ELSEWHERE].tolist():
            start[i] = list(alone[i])[int(rng.integers(len(alone[i])))]
        found = near.search([tuple(start)], alone, aims, ranked)
        best = min(best, found, key=lambda one: ranked(one) or (math.inf,))
    return best


def best_placements(loads: Loads, alone: Sequence[Mapping[str, float]]) -> list[str]:
    """Return the placements with the lowest Φ of the table.

    `alone` is J of every candidate of each cell without other cells.
    """
    if len(loads.resources) > 1:
        return by_program(loads, alone)
    return [*cheapest(loads, alone, [min(costs, key=costs.__getitem__) for costs in alone])]


def by_program(loads: Loads, alone: Sequence[Mapping[str, float]]) -> list[str]:
    """Return the best placements over several resources; every load is rounded up to a level.

    The program selects one candidate per cell and one level per resource. Each selected candidate
    of a group pays the group's waiting cost at the selected level.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    taken = [(i, name) for i, costs in enumerate(alone) for name in costs]
    held = [
        (resource, level)
        for resource in loads.resources
        for level in np.linspace(0.0, loads.most(resource), LEVELS_OF_SEVERAL).tolist()
    ]
    groups = list(dict.fromkeys(loads.group(i, name) for i, name in taken if loads.work(i, name)))
    waits = [(group, one) for group in groups for one in held if one[0] == loads.resource(*group)]
    count = len(taken) + len(held) + len(waits)
    column: dict[Any, int] = {one: place for place, one in enumerate([*taken, *held, *waits])}
    cost = np.zeros(count)
    cost[: len(taken)] = [alone[i][name] for i, name in taken]
    for group, one in waits:
        cost[column[group, one]] = loads.wait(*group, one[1])
    rows, low, high = [], [], []

    def require(terms: Mapping[Any, float], at_least: float, at_most: float) -> None:
        row = np.zeros(count)
        for one, factor in terms.items():
            row[column[one]] += factor
        rows.append(row)
        low.append(at_least)
        high.append(at_most)

    for i, costs in enumerate(alone):
        require({(i, name): 1.0 for name in costs}, 1.0, 1.0)
    for resource in loads.resources:
        mine = [one for one in held if one[0] == resource]
        require(dict.fromkeys(mine, 1.0), 1.0, 1.0)
        work = {one: loads.work(*one) for one in taken if loads.resource(*one) == resource}
        require(work | {one: -one[1] for one in mine}, -np.inf, 0.0)
    for group in groups:
        of: dict[Any, float] = {one: -1.0 for one in taken if loads.group(*one) == group}
        paid = [one for one in waits if one[0] == group]
        require(of | dict.fromkeys(paid, 1.0), 0.0, 0.0)
        for wait in paid:
            require({wait: 1.0, wait[1]: -float(len(of))}, -np.inf, 0.0)
    whole = np.zeros(count)
    whole[: len(taken) + len(held)] = 1
    most = np.where(whole, 1.0, np.inf)
    found = milp(
        cost,
        constraints=LinearConstraint(np.array(rows), low, high),
        integrality=whole,
        bounds=Bounds(np.zeros(count), most),
    )
    return [max(costs, key=lambda name: found.x[column[i, name]]) for i, costs in enumerate(alone)]
