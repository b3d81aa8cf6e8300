"""Regimes that `corrected` believes in where nothing is disturbed, and what DTP then misses.

DTP minimises J and does not distinguish placements whose J differs by less than Δ_min. Of those
within Δ_min of the least J the one that misses most is the best placement.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

import dwell
from benchmarks.figures import Figure, Goal, Section
from dwell.cellfile import from_document
from dwell.estimators import Corrected
from dwell.model import Problem
from dwell.model.qos import QoS

ROOT = Path(__file__).parents[1]
TRACES = ROOT / "../shared/data"
#: Traces that are replayed as the delay of a link: their file, and the column.
DELAYS = {
    "cicv5g_rural_rtt": "rtt_ms",
    "cicv5g_urban_rtt": "rtt_ms",
    "edaf_5g_uplink": "delay_ms",
    "edgedroid_10clients_badlink_rtt": "rtt_ms",
    "edgedroid_10clients_halfcpu_rtt": "rtt_ms",
    "edgedroid_10clients_rtt": "rtt_ms",
    "edgedroid_1client_rtt": "rtt_ms",
}
#: First windows, which do not count in V_D.
WARMUP = 5
#: Those that are replayed by time, too.
TIMED = ("cicv5g_rural_rtt", "cicv5g_urban_rtt", "edaf_5g_uplink")


class Watched(Corrected):
    """Counts the windows in which a part is not as declared."""

    #: Of the class: a run has a copy of its estimator.
    counted: ClassVar[list[bool]] = []

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate and count."""
        estimates = super().estimate(observed=observed, incumbent=incumbent, own=own)
        present = self.present
        self.counted.append(bool(present.demands or present.threads))
        return estimates


def cell_of(name: str, by: str = "row") -> Problem:
    """Return a cell whose uplink replays a trace, row by row or by time."""
    column = DELAYS[name]
    rows = pl.read_parquet(TRACES / f"{name}.parquet")
    period_ms = max(50.0, round(1.5 * float(np.median(rows[column])), 1))
    trace: dict[str, object] = {"file": f"{name}.parquet", "column": column, "wrap": True}
    if "run" in rows.columns:
        trace["group"] = ["run", "client"]
    else:
        trace["by"] = by
    document = {
        "dwell": 1,
        "name": name,
        "period_ms": period_ms,
        "deadline_ms": period_ms,
        "window_cycles": 100,
        "nodes": {"R": {"tier": "robot", "cores": 2}, "E": {"tier": "edge", "cores": 8}},
        "links": [
            {"from": "R", "to": "E", "delay_ms": {"trace": trace}},
            {"from": "E", "to": "R", "delay_ms": 1},
        ],
        "tasks": {
            "camera": {"on": {"R": {"exec_ms": 1}}},
            "detect": {
                "on": {
                    "R": {"exec_ms": _lognormal(0.7 * period_ms)},
                    "E": {"exec_ms": _lognormal(0.1 * period_ms)},
                }
            },
            "act": {"on": {"R": {"exec_ms": 1}}},
        },
        "flows": [{"from": "camera", "to": "detect"}, {"from": "detect", "to": "act"}],
        "candidates": {"LOC": {"detect": "R"}, "SO": {"detect": "E"}},
        "scenarios": {"robot": [{"node": "R", "stress_threads": 2}]},
        "controller": {"policy": "dtp", "initial": "LOC", "estimator": "corrected"},
    }
    return from_document(document, folder=TRACES)


def _lognormal(mean_ms: float) -> dict[str, object]:
    return {"lognormal": {"mean": round(mean_ms, 3), "cv": 0.1}}


def cells() -> dict[str, Problem]:
    """Return the cells that replay recordings, by name."""
    examples = ("real", "real-5g")
    found = {one: dwell.load(ROOT / f"examples/{one}.yaml", traces=TRACES) for one in examples}
    found |= {name: cell_of(name) for name in DELAYS}
    return found | {f"{name} by time": cell_of(name, "time") for name in TIMED}


def measure(quick: bool) -> Section:
    """Windows under a regime in undisturbed cells, and V_D of DTP over the best placement's."""
    title = "Regimes in cells that replay recordings"
    if not TRACES.is_dir():
        return Section(title, [], [f"no recordings in {TRACES}"])
    windows, seeds = (60, range(1, 2)) if quick else (300, range(1, 4))
    figures = []
    for name, problem in cells().items():
        shares = [_under_regime(problem, seed, windows) for seed in seeds]
        figures.append(Figure(f"{name}: windows under a regime", shares, "%", Goal(high=1)))
        loaded = next(one for one in problem.scenarios if one.startswith("robot"))
        for scenario in ("baseline", loaded):
            more = [_above_best(problem, scenario, seed, windows) for seed in seeds]
            what = f"{name}, {scenario}: V_D of DTP less the best placement's"
            figures.append(Figure(what, more, "points", Goal(high=2)))
    return Section(title, figures)


def _under_regime(problem: Problem, seed: int, windows: int) -> float:
    """Percentage of windows, on the candidate that has most."""
    shares = []
    for name in problem.candidates:
        Watched.counted.clear()
        watched = Watched(problem)
        dwell.simulate(problem, policy=name, estimator=watched, seed=seed, windows=windows)
        shares.append(100.0 * float(np.mean(Watched.counted)))
    return max(shares)


def _above_best(problem: Problem, scenario: str, seed: int, windows: int) -> float:
    """Return V_D of DTP less V_D of the best placement, percentage points."""

    def played(policy: str) -> tuple[float, float]:
        run = dwell.simulate(problem, scenario=scenario, policy=policy, seed=seed, windows=windows)
        columns = (run.windows[name].to_numpy()[WARMUP:] for name in ("cost", "violation_rate"))
        mean_cost, missed = (float(np.mean(column)) for column in columns)
        return mean_cost, 100.0 * missed

    static = [played(f"{name}+profile") for name in problem.candidates]
    most = min(static)[0] + problem.controller.min_improvement
    return played("dtp+corrected")[1] - max(missed for costs, missed in static if costs <= most)
