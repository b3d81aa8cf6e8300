"""The event loop: closes of windows, and the orders that travel back into it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import polars as pl
import pytest

import dwell
from dwell.model import NodeDisturbance
from tests.cells.two_nodes import Script, first_cycles, two_nodes


@pytest.mark.parametrize(
    ("settings", "cycle"),
    [
        ({}, 10),
        ({"order_delay_ms": 0.5}, 11),
        ({"order_delay_ms": 20.0}, 11),
        ({"order_delay_ms": 20.5}, 12),
        ({"order_delay_ms": 250.0}, 23),
        ({"order_lead_cycles": 1}, 11),
        ({"order_lead_cycles": 7}, 17),
        ({"order_lead_cycles": 1, "order_delay_ms": 45.0}, 13),
        ({"order_lead_cycles": 5, "order_delay_ms": 45.0}, 15),
        ({"close_grace_ms": 5.0}, 11),
        ({"close_grace_ms": 20.0}, 11),
        ({"close_grace_ms": 21.0}, 12),
        ({"close_grace_ms": 5.0, "order_delay_ms": 20.0}, 12),
        ({"close_grace_ms": 5.0, "order_lead_cycles": 3}, 13),
    ],
)
def test_the_first_cycle_that_an_order_stamps(settings: Mapping[str, Any], cycle: int) -> None:
    problem = two_nodes(**settings)
    run = dwell.simulate(problem, policy=Script("OFF"), seed=1, windows=6)
    assert first_cycles(run, "OFF") == [cycle]
    windows = run.windows.select("first_cycle", pl.col("placement").cast(str), "mixed").rows()
    assert windows[0] == (0, "LOC", False)
    assert windows[1] == (cycle, "OFF", False)
    assert windows[2] == (cycle + 10, "OFF", False)


def test_orders_one_after_another() -> None:
    problem = two_nodes(order_delay_ms=30.0)
    run = dwell.simulate(problem, policy=Script("OFF", "LOC", "OFF"), seed=1, windows=6)
    assert first_cycles(run, "OFF") == [12, 36]
    assert first_cycles(run, "LOC") == [0, 24]
    assert run.windows["first_cycle"].to_list()[:5] == [0, 12, 24, 36, 46]


@pytest.mark.parametrize(
    ("grace_ms", "seen_ms", "seen_rate"), [(0.0, 20.0, 1.0), (4.0, 24.0, 1.0), (10.0, 25.0, 1.0)]
)
def test_what_is_unfinished_at_the_close_counts_with_its_age(
    grace_ms: float, seen_ms: float, seen_rate: float
) -> None:
    problem = two_nodes(exec_ms=25.0, window_cycles=1, workers=2, close_grace_ms=grace_ms)
    run = dwell.simulate(problem, policy=Script("LOC"), seed=1, windows=8)
    assert set(run.windows["seen_l95_ms"][:6].to_list()) == {seen_ms}
    assert set(run.windows["seen_violation_rate"][:6].to_list()) == {seen_rate}
    assert set(run.windows["l95_ms"][:6].to_list()) == {25.0}


def test_the_controller_decides_nothing_while_its_node_is_down() -> None:
    # Windows close every 0.2 s; E is down at the closes of windows 2 (0.6 s) and 3 (0.8 s).
    outage = NodeDisturbance(node="E", at_s=0.5, for_s=0.4, down=True)
    problem = two_nodes(scenario=[outage], on="E")
    for policy in ("LOC", Script("LOC"), "dtp"):
        run = dwell.simulate(problem, scenario="disturbed", policy=policy, seed=1, windows=8)
        blind = run.windows.filter(pl.col("cost").is_null())
        assert run.decisions["window"].to_list() == [0, 1, 4, 5, 6, 7]
        assert blind["window"].to_list() == [2, 3]
        assert blind.select("seen_l95_ms", "seen_violation_rate").null_count().row(0) == (2, 2)
        assert run.windows["l95_ms"].to_list() == [5.0] * 8
        assert run.windows["u_E"].to_list() == [0.0] * 8
    elsewhere = replace(problem, controller=replace(problem.controller, on="R"))
    run = dwell.simulate(elsewhere, scenario="disturbed", policy=Script("LOC"), seed=1, windows=8)
    assert run.decisions.height == 8


def test_a_controller_that_is_down_all_along_decides_nothing() -> None:
    problem = two_nodes(scenario=[NodeDisturbance(node="E", down=True)], on="E")
    for policy in ("LOC", "dtp"):
        run = dwell.simulate(problem, scenario="disturbed", policy=policy, seed=1, windows=3)
        assert run.decisions.height == 0
        assert run.windows["cost"].null_count() == 3
        assert run.decisions.schema == dwell.simulate(problem, seed=1, windows=1).decisions.schema
