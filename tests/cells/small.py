"""A small cell with the paper's candidates, and comparisons made by hand."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl

from dwell.model import (
    AR1,
    Caps,
    ControllerSettings,
    Execution,
    Fabric,
    Flow,
    Link,
    LinkDisturbance,
    LogNormal,
    Node,
    NodeDisturbance,
    Normal,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Targets,
    Task,
    Weights,
)
from dwell.study import Comparison
from dwell.study.summary import latency_grid_ms
from tests.cells.once import once

SEEDS = tuple(range(1, 9))
CANDIDATES = ("LOC", "SO", "HYB")
# What a run shows unless a test says otherwise.
USUAL = {
    "windows": 95,
    "cycles": 950,
    "violation_rate": 0.02,
    "l95_ms": 30.0,
    "p95_ms": 31.0,
    "p50_ms": 25.0,
    "spread_ms": 6.0,
    "u_robot": 0.5,
    "u_edge": 0.1,
    "node_R1": 0.5,
    "node_E": 0.1,
    "node_R2": 0.05,
    "migrations": 0.0,
    "returns": 0.0,
    "share_LOC": 0.0,
    "share_SO": 0.0,
    "share_HYB": 0.0,
    "cost": 1.0,
    "lost": 0.0,
    "longest_misses": 2.0,
    "compute_ms": 20.0,
    "queue_ms": 1.0,
    "network_ms": 4.0,
}


def make_problem(*, warmup_windows: int = 2, window_cycles: int = 10) -> Problem:
    """Return a cell in which nothing takes long to simulate."""
    nodes = {
        "R1": Node("R1", "robot", 4),
        "E": Node("E", "edge", 8),
        "R2": Node("R2", "robot", 4),
    }
    on = {
        "sensing": {"R1": 3.0},
        "perception": {"R1": 14.0, "E": 10.0},
        "planning": {"R2": 7.0, "E": 5.0},
        "control": {"R2": 0.5},
    }
    tasks = {
        name: Task(
            name,
            {node: Execution(LogNormal(ms, 0.2)) for node, ms in where.items()},
            scale="scene" if name == "perception" else None,
            depth=1 if name in ("perception", "planning") else 0,
        )
        for name, where in on.items()
    }
    pairs = [(a, b) for a in nodes for b in nodes if a != b]
    links = {f"{a}->{b}": Link(a, b, LogNormal(1.0, 0.3)) for a, b in pairs}
    slow = tuple(
        LinkDisturbance(a, b, add_delay_ms=Normal(25.0, 5.0), loss=0.02)
        for a, b in (("R1", "E"), ("E", "R2"))
    )
    return Problem(
        name="small",
        pipeline=Pipeline(
            tasks=tasks,
            flows=tuple(Flow(a, b, 1000) for a, b in itertools.pairwise(on)),
            period_ms=33.0,
            deadline_ms=33.0,
            scales={"scene": AR1(1.0, 0.15, 0.9)},
        ),
        fabric=Fabric(nodes=nodes, links=links),
        candidates={
            name: Placement({"sensing": "R1", "perception": a, "planning": b, "control": "R2"})
            for name, a, b in (("LOC", "R1", "R2"), ("SO", "E", "E"), ("HYB", "E", "R2"))
        },
        objective=Objective(
            weights=Weights(latency=1, violations=3, robot=0.2, edge=0.1, switching=0.2),
            targets=Targets(latency_ms=33.0),
            caps=Caps(latency_ms=100.0, utilisation=0.98),
            tiers={name: node.tier for name, node in nodes.items()},
        ),
        scenarios={
            "robot-cpu-stress": (NodeDisturbance("R1", stress_threads=4),),
            "network-impairment": slow,
        },
        controller=once(ControllerSettings(on="E", initial="LOC", min_dwell=1), window_cycles),
        window_cycles=window_cycles,
        warmup_windows=warmup_windows,
    )


def make_comparison(
    shown: Mapping[tuple[str, str], Mapping[str, float | Sequence[float]]],
    *,
    scenarios: Sequence[str] = ("baseline",),
    policies: Sequence[str] = (*CANDIDATES, "dtp"),
    seeds: Sequence[int] = SEEDS,
    estimated: Mapping[str, float] | None = None,
) -> Comparison:
    """Make a comparison whose runs show given numbers.

    Parameters
    ----------
    shown : mapping of (scenario, policy) to mapping of column to value
        One value for all seeds, or one a seed; the rest is as in `USUAL`.
    estimated : mapping of candidate to float, optional
        Mean J that every policy was given for it while it was not active.
    """
    rows, costs = [], []
    for scenario in scenarios:
        for policy in policies:
            given = {f"share_{policy}": 1.0} if policy in CANDIDATES else {}
            given |= dict(shown.get((scenario, policy), {}))  # type: ignore[arg-type]
            columns = {
                name: np.broadcast_to(given.get(name, usual), len(seeds))
                for name, usual in USUAL.items()
            }
            for i, seed in enumerate(seeds):
                labels = {"scenario": scenario, "policy": policy, "seed": seed}
                rows.append(labels | {name: float(value[i]) for name, value in columns.items()})
                for name in CANDIDATES:
                    active = float(columns[f"share_{name}"][i]) > 0
                    costs.append(
                        {
                            **labels,
                            "candidate": name,
                            "estimated": (estimated or {}).get(name),
                            "measured": float(columns["cost"][i]) if active else None,
                            "windows": 1,
                            "shadow_fraction": 0.0,
                        }
                    )
    problem = make_problem()
    grid = latency_grid_ms(problem.pipeline.deadline_ms)
    latencies = pl.concat(
        pl.DataFrame({"latency_ms": grid, "share": np.linspace(0, 1, len(grid))}).select(
            pl.lit(scenario).alias("scenario"), pl.lit(policy).alias("policy"), pl.all()
        )
        for scenario in scenarios
        for policy in policies
    )
    return Comparison(
        name=problem.name,
        problem=problem,
        scenarios=tuple(scenarios),
        policies=tuple(policies),
        seeds=tuple(seeds),
        windows=100,
        runs=pl.DataFrame(rows),
        costs=pl.DataFrame(
            costs, schema_overrides={"estimated": pl.Float64, "measured": pl.Float64}
        ),
        latencies=latencies,
        examples={},
        versions={"dwell": "0"},
    )
