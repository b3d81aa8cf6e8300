"""Cycles: their releases, and what becomes of them on nodes that are down."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

import dwell
from dwell.model import (
    NodeDisturbance,
    Uniform,
)
from tests.cells.generated import MS
from tests.cells.two_nodes import assert_same, two_nodes


def test_cycles_on_a_dead_node_are_lost_and_say_so() -> None:
    outage = NodeDisturbance(node="E", at_s=0.5, for_s=0.4, down=True)
    problem = two_nodes(scenario=[outage], on="R")
    run = dwell.simulate(problem, scenario="disturbed", policy="OFF", seed=1, windows=8)
    outcomes = run.cycles["outcome"].cast(str).to_list()
    assert outcomes == ["done"] * 25 + ["node_down"] * 20 + ["done"] * 35
    assert run.windows["violation_rate"].to_list() == [0, 0, 0.5, 1, 0.5, 0, 0, 0]
    assert run.windows["l95_ms"].to_list()[2:5] == [math.inf] * 3


def test_jitter_moves_releases_and_the_closes_with_them() -> None:
    problem = replace(
        two_nodes(),
        pipeline=replace(two_nodes().pipeline, release_jitter_ms=Uniform(0.0, 6.0)),
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=20)
    late_ms = run.cycles["release_ns"].to_numpy() / MS - np.arange(200) * 20.0
    assert late_ms.min() >= 0
    assert late_ms.max() <= 6
    assert late_ms.std() > 1
    assert set(run.cycles["latency_ns"].to_list()) == {5 * MS}
    by_window = dwell.simulate_realisation(
        problem,
        dwell.draw(problem, scenario="baseline", seed=1, windows=20),
        policy="LOC",
        by_window=True,
    )
    assert_same(run, by_window)


def test_jitter_beyond_the_period_keeps_the_order_of_cycles() -> None:
    problem = replace(
        two_nodes(workers=4),
        pipeline=replace(two_nodes(workers=4).pipeline, release_jitter_ms=Uniform(0.0, 70.0)),
    )
    run = dwell.simulate(problem, policy="LOC", seed=1, windows=20)
    assert (run.cycles["release_ns"].diff().drop_nulls() >= 0).all()
    assert (run.cycles["outcome"] == "done").sum() >= 198
