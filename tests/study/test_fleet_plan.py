"""The best placements of a fleet, against all of them."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dwell
from dwell.control.ledger import Loads, PricedCell
from dwell.estimators.cell_terms import CellTerms
from dwell.estimators.load_table import LoadColumn, LoadTable
from dwell.model import Placement, QoS
from dwell.model.fleet import Fleet, FleetEntry
from dwell.record import FleetRun
from dwell.sim.fleet import simulate_fleet
from dwell.study import fleet_plan
from dwell.study.fleet_plan import best_placements, plan_fleet

EXAMPLES = Path(__file__).parents[2] / "examples"
CANONICAL = dwell.load(EXAMPLES / "canonical.yaml")
CLOUD = dwell.load(EXAMPLES / "cloud.yaml")


def phi_of(run: FleetRun) -> float:
    """Φ per cell of a run, from the mean metrics of its windows after the warm-up."""
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


def random_loads(seed: int, shared: list[str]) -> tuple[Loads, list[dict[str, float]]]:
    """Return a table that says anything that grows with the load, and costs of cells alone."""
    rng = np.random.default_rng(seed)
    problem = CANONICAL if len(shared) == 1 else CLOUD
    cells = [PricedCell(f"cell-{i}", problem, f"{i}/" if i else "") for i in range(5)]
    table = LoadTable(cells, shared, cycles=1)
    for group, column in table.columns.items():
        size = len(column.level)
        l95_ms = 10 + np.cumsum(rng.exponential(4, size))
        rate = np.minimum(np.cumsum(rng.exponential(0.05, size)), 1.0)
        table.columns[group] = LoadColumn(column.level, l95_ms, rate, rate, rate)
    alone = [{name: float(rng.uniform(1, 2)) for name in problem.candidates} for _ in cells]
    return Loads(table), alone


def least(loads: Loads, alone: list[dict[str, float]]) -> float:
    every = itertools.product(*(list(costs) for costs in alone))
    return min(sum(loads.costs(placements, alone)) for placements in every)


@pytest.mark.parametrize("seed", range(8))
def test_over_one_node_it_is_the_least_of_all_placements(seed: int) -> None:
    loads, alone = random_loads(seed, ["E"])
    found = best_placements(loads, alone)
    assert sum(loads.costs(found, alone)) == pytest.approx(least(loads, alone), rel=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_over_several_nodes_it_is_close_to_the_least(seed: int) -> None:
    shared = [name for name, node in CLOUD.fabric.nodes.items() if node.tier != "robot"]
    assert len(shared) > 1
    loads, alone = random_loads(seed, shared)
    assert len(loads.resources) > 1
    found = best_placements(loads, alone)
    assert sum(loads.costs(found, alone)) <= 1.01 * least(loads, alone)


@pytest.mark.parametrize("seed", range(3))
def test_both_ways_find_the_same(seed: int) -> None:
    loads, alone = random_loads(seed, ["E"])
    program = fleet_plan.by_program(loads, alone)
    known = sum(loads.costs(best_placements(loads, alone), alone))
    assert sum(loads.costs(program, alone)) == pytest.approx(known, rel=0.01)


def test_a_plan_of_a_fleet_without_shared_nodes_is_each_cells_best() -> None:
    fleet = Fleet("apart", (FleetEntry(CANONICAL, 2, "robot-cpu-stress"),))
    plan = plan_fleet(fleet)
    assert list(plan.placements) == ["canonical-01", "canonical-02"]
    assert set(plan.placements.values()) <= {"SO", "HYB"}
    assert isinstance(CANONICAL.candidates[plan.placements["canonical-01"]], Placement)
    assert plan.phi == pytest.approx(plan.table_phi, rel=0.1)


def test_a_plan_is_near_what_it_comes_to_where_cells_meet() -> None:
    nodes = dict(CANONICAL.fabric.nodes)
    nodes["E"] = replace(nodes["E"], cores=4)
    small = replace(CANONICAL, fabric=replace(CANONICAL.fabric, nodes=nodes))
    fleet = Fleet("hall", (FleetEntry(small, 6, "robot-cpu-stress"),), ("E",), "even")
    plan = plan_fleet(fleet)
    taken = set(plan.placements.values())
    assert "LOC" in taken
    assert len(taken) > 1
    assert plan.phi == pytest.approx(plan.table_phi, rel=0.1)
    entries = tuple(
        replace(fleet.entries[0], count=count, policy=name)
        for name, count in Counter(plan.placements.values()).items()
    )
    best = simulate_fleet(replace(fleet, entries=entries), coordination="none", windows=40)
    assert phi_of(best) == pytest.approx(plan.phi, rel=0.2)
    alone = simulate_fleet(fleet, policy="LOC", windows=40)
    assert phi_of(alone) > 1.5 * plan.phi
