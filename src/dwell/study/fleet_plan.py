"""Plan: good placements of a fleet, by the table of loads first, then as played.

The search begins at the placements with the least Φ of the table: a knapsack over one shared
resource, a mixed-integer program over several. Moves of one cell and of two go on from there as
long as one makes the played Φ better. Small fleets begin again from places nearby.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dwell.control.fleet_rank import FleetRank, fleet_rank
from dwell.control.knapsack import cheapest
from dwell.control.neighbours import Neighbours, Rank, descend
from dwell.control.table_loads import Loads
from dwell.estimators.fleet_prices import CellTerms, FleetPrice, FleetPrices
from dwell.estimators.load_table import load_table
from dwell.estimators.prices import SEED, prices_of
from dwell.model.fleet import Fleet
from dwell.model.progress import Progress
from dwell.model.qos import QoS
from dwell.record import FleetRun
from dwell.sim.fleet import phased, priced_cells, tabled_cells

#: Levels of the load of each of several shared resources.
LEVELS_OF_SEVERAL = 40
#: Cells that the search may play in all, which bounds its time for large fleets.
CELLS_PLAYED = 20_000
#: Fleets whose search took fewer plays begin again, with as many cells elsewhere.
ENOUGH_PLAYS, ELSEWHERE = 200, 4
#: Cycles that a plan is played for, of all cells together, and most of a cell.
CYCLES, MOST = 1_000_000, 15_000


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """Placements of a fleet with the best played price that was found.

    Parameters
    ----------
    placements : mapping of str to str
        Candidate of each cell.
    table_phi : float
        Φ a cell, as the table has it.
    played : FleetPrice
        What the fleet comes to there.
    """

    placements: Mapping[str, str]
    table_phi: float
    played: FleetPrice

    def __repr__(self) -> str:
        return f"<FleetPlan: {len(self.placements)} cells, {self.phi:.4g} a cell>"

    @property
    def phi(self) -> float:
        """Φ a cell, as played."""
        return self.played.phi / len(self.placements)

    @property
    def cells(self) -> dict[str, QoS]:
        """What each cell comes to."""
        priced = map(self.played.qos, range(len(self.placements)))
        return {name: qos for name, qos in zip(self.placements, priced, strict=True) if qos}

    def above(self, limit: float) -> list[str]:
        """Return the cells that miss a larger share of their deadlines than a limit."""
        return [name for name, qos in self.cells.items() if qos.violation_rate > limit]

    def regret(self, run: FleetRun) -> float:
        """How far Φ of a run, by what its windows show, is above that of the plan: a share of it.

        Windows of the warm-up do not count.
        """
        return phi_of(run) / self.phi - 1.0

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


def phi_of(run: FleetRun) -> float:
    """Φ a cell of a run, by the means of what its windows showed after the warm-up."""
    own, shared = 0.0, 0.0
    problems = run.fleet.problems
    for name, one in run.cells.items():
        terms, windows = CellTerms(problems[name], run.fleet.shared), one.arrays("windows")
        counts = ~windows["warmup"]

        def mean(column: str, windows: Any = windows, counts: Any = counts) -> float:
            return float(np.nanmean(windows[column][counts]))

        used = {name: mean(f"u_{name}") for name in terms.resources}
        qos = QoS(mean("seen_l95_ms"), mean("seen_violation_rate"), used)
        own, shared = own + terms.cost(qos), shared + terms.shared_cost(used)
    count = len(run.cells)
    return (own + shared / count) / count


def plan_fleet(fleet: Fleet, *, seed: int = 1, progress: Progress | None = None) -> FleetPlan:
    """Find good placements of a fleet while its scenarios go on, by its objective.

    Parameters
    ----------
    seed : int
        Of the phases, where these are random.
    progress : callable, optional
        Told how many of how many levels of the table have been played.
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
    """Return the best placements of those that were played, from the better start on."""
    played: dict[tuple[str, ...], FleetPrice] = {}
    most = max(CELLS_PLAYED // len(alone), 1)

    def ranked(placements: tuple[str, ...]) -> Rank | None:
        if placements not in played:
            if len(played) >= most:
                return None
            played[placements] = prices.price(placements)
        return rank.of(played[placements])

    near = Neighbours(prices.cells, loads)

    def neighbours(placements: tuple[str, ...]) -> Iterable[tuple[str, ...]]:
        return near.of(placements, alone, rank.aims(played[placements]))

    best = descend(min(starts, key=lambda one: ranked(one) or (math.inf,)), neighbours, ranked)
    rng = np.random.Generator(np.random.SFC64(SEED))
    for _ in range(ENOUGH_PLAYS):
        if len(played) >= min(ENOUGH_PLAYS, most):
            break
        start = list(best)
        for i in rng.permutation(len(start))[:ELSEWHERE].tolist():
            start[i] = list(alone[i])[int(rng.integers(len(alone[i])))]
        descend(tuple(start), neighbours, ranked)
        best = min(played, key=lambda one: ranked(one) or ())
    return best


def best_placements(loads: Loads, alone: Sequence[Mapping[str, float]]) -> list[str]:
    """Return the placements of which the table's Φ is least.

    Parameters
    ----------
    alone : sequence of mapping of str to float
        J of every candidate of each cell where no other is there.
    """
    if len(loads.resources) > 1:
        return _by_program(loads, alone)
    return [*cheapest(loads, alone, [min(costs, key=costs.__getitem__) for costs in alone])]


def _by_program(loads: Loads, alone: Sequence[Mapping[str, float]]) -> list[str]:
    """Return the best placements over several resources; every load is rounded up to a level.

    Of every cell one candidate is taken, of every resource one level. What candidates of one kind
    wait at a level is paid for as often as they are taken while it is.
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
