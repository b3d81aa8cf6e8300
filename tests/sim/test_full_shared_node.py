"""Fleets whose shared node foreign load fills."""

from __future__ import annotations

from dataclasses import replace

import polars as pl
import pytest

import dwell
from dwell.model import NodeDisturbance
from dwell.model.fleet import Coordination, Fleet, FleetEntry
from tests.cells.examples import EXAMPLES

#: Windows of canonical cells are 3.33 s long; E is full from the twelfth on.
AT_S, SETTLED = 40.0, 20


def hall(coordination: Coordination, on_robot: int, on_edge: int, *, tenants: bool) -> Fleet:
    """Four canonical cells; foreign threads on their robots, and on E from `AT_S` on."""
    cell = dwell.load(EXAMPLES / "canonical.yaml")
    edge = cell.fabric.nodes["E"]
    nodes = {**cell.fabric.nodes, "E": edge if tenants else replace(edge, bursts=None)}
    disturbed = (
        NodeDisturbance("R1", stress_threads=on_robot),
        NodeDisturbance("E", AT_S, stress_threads=on_edge),
    )
    fabric = replace(cell.fabric, nodes=nodes)
    cell = replace(cell, fabric=fabric, scenarios={"full": disturbed})
    return Fleet("hall", (FleetEntry(cell, 4, "full"),), ("E",), "random", coordination)


def missed(fleet: Fleet) -> float:
    """V_D of all cells since the change has been seen."""
    run = dwell.simulate_fleet(fleet, seed=1, windows=35, estimator="corrected")
    since = run.windows.filter(pl.col("window") >= SETTLED)
    return float(since["violation_rate"].to_numpy().mean())


@pytest.mark.parametrize(
    ("on_robot", "on_edge", "tenants"),
    [(1, 16, True), (0, 16, False), (0, 8, False)],
    ids=["stressed robots", "no tenants", "a thread a core"],
)
def test_the_ledger_sees_that_foreign_load_fills_a_shared_node(
    on_robot: int, on_edge: int, tenants: bool
) -> None:
    alone, ledger = (
        missed(hall(rule, on_robot, on_edge, tenants=tenants)) for rule in ("none", "ledger")
    )
    assert ledger <= alone + 0.01
