"""What a cell's scenarios are, as a table."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dwell
from dwell.cellfile import from_document
from dwell.model import (
    Constant,
    Disturbance,
    Episodes,
    Exponential,
    LinkDisturbance,
    LogNormal,
    NodeDisturbance,
    Normal,
    Process,
    Trace,
    TraceTable,
    Uniform,
    evolve,
)
from dwell.report.method import (
    cell_definitions,
    describe_contenders,
    placements_table,
    scenarios_table,
)
from tests.cells.rated import inner_loop
from tests.cells.small import make_problem

EPISODES = Episodes("edge", every_s=Exponential(30.0), for_s=Uniform(2.0, 10.0))
TABLE = TraceTable(file="delays.csv", columns={"delay_ms": np.array([1.0, 3.0])})


def row_of(item: Disturbance) -> dict[str, object]:
    problem = replace(make_problem(), scenarios={"one": (item,)})
    (row,) = scenarios_table(problem, ["one"]).rows
    return dict(row)


@pytest.mark.parametrize(
    ("item", "where", "what"),
    [
        (NodeDisturbance("R1", stress_threads=4), "R1", "4 busy threads"),
        (LinkDisturbance("R1", "E", loss=0.005), "R1→E", "loss 0.5 %"),
        (NodeDisturbance("E", at_s=20, for_s=10, down=True), "E", "down"),
        (LinkDisturbance("R1", "E", rate_mbps=10.0, at_s=5), "R1→E", "10 Mbit/s"),
    ],
)
def test_disturbances(item: Disturbance, where: str, what: str) -> None:
    row = row_of(item)
    assert (row["where"], row["what"]) == (where, what)
    assert row["at_s"] == item.at_s
    assert row["for_s"] == item.for_s or math.isinf(item.for_s)


def test_episodes_and_ramps_are_columns() -> None:
    row = row_of(NodeDisturbance("E", stress_threads=16, episodes=EPISODES))
    assert (row["off_s"], row["on_s"]) == (30.0, 6.0)
    assert row_of(NodeDisturbance("E", for_s=380, ramp_s=190, stress_threads=16))["ramp_s"] == 190


@pytest.mark.parametrize(
    ("delay", "text"),
    [
        (Constant(2.0), "constant (value 2) ms"),
        (Normal(25.0, 5.0), "normal (mean 25, std 5"),
        (Uniform(1.0, 5.2), "uniform (low 1, high 5.2) ms"),
        (LogNormal(0.7, 0.3), "lognormal (mean 0.7, cv 0.3"),
        (Trace(TABLE, "delay_ms"), "2 ms in the mean, replayed from delays.csv"),
    ],
)
def test_delays(delay: Process, text: str) -> None:
    what = row_of(LinkDisturbance("R1", "E", add_delay_ms=delay))["what"]
    assert str(what).startswith(f"delay {text}")


def test_placements_are_those_of_the_tasks_that_can_move() -> None:
    rows = {row["placement"]: row for row in placements_table(make_problem()).rows}
    assert rows["SO"]["perception"] == "E"
    assert "control" not in rows["SO"] or rows["SO"]["control"]
    assert cell_definitions(make_problem())["cost"].startswith("J = ")


def test_placements_with_replicas_have_both_nodes_and_their_members() -> None:
    problem = dwell.load(Path(__file__).parents[2] / "examples" / "replicas.yaml")
    rows = {row["placement"]: row for row in placements_table(problem).rows}
    assert rows["ONE"] == {"placement": "ONE", "policy": "A"}
    assert rows["NOW"] == {"placement": "NOW", "policy": "A + B", "copies": "ONE; TWO at once"}
    assert rows["LATER"]["copies"] == "ONE; TWO after 9.5 ms"


def test_rates_chains_and_all_terms_of_the_cost_are_told() -> None:
    chain = {"from": "camera", "to": "control", "max_age_ms": 150}
    problem = evolve(
        from_document(inner_loop(chains={"see-act": chain})),
        {
            "objective.latency": "see-act",
            "objective.weights": {"age": 2, "price": 3},
            "objective.targets": {"age_ms": 80, "price_per_hour": 0.5},
            "objective.caps": {"misses": {"m": 1, "k": 20}},
            "links[0].price_per_gb": 0.1,
        },
    )
    told = cell_definitions(problem)
    assert told["every n cycles"] == "camera 10; detect 10"
    assert told["sampled"] == "detect → control"
    assert told["chains"] == "see-act: camera to control, at most 150 ms"
    for term in ("L95 of the age of see-act / 150 ms", "2 · age / 80 ms"):
        assert term in told["cost"]
    assert "3 · price of bytes / 0.5 /h" in told["cost"]
    assert told["caps"] == "at most 1 miss in 20 cycles"
    assert "chains" not in cell_definitions(make_problem())


def test_each_policy_and_estimator_is_told_once() -> None:
    names = ("LOC", "SO", "HYB", "atp", "dtp", "latency-first", "dtp+corrected", "cusum+corrected")
    told = describe_contenders(make_problem(), names)
    assert set(told) == {
        "LOC, SO, HYB", "DTP", "ATP", "Latency-first", "CUSUM", "… (corrected)"
    }  # fmt: skip
    assert told["ATP"].count("our reconstruction") == 1
