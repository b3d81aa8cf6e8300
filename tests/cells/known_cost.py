"""A cell whose every cost is known, and its runs as a live cell records them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import dwell
from dwell.model import Problem
from dwell.model.document import to_document
from dwell.record import Run
from dwell.sim import draw, simulate_realisation

CELL = """
dwell: 1
name: known
period_ms: 50
deadline_ms: 50
window_cycles: 30
warmup_windows: 2
nodes:
  R1: {tier: robot, cores: 1, quota: {cpu: 0.4, period_ms: 4}}
  E: {tier: edge, cores: 1, quota: {cpu: 0.8, period_ms: 4}}
links:
  - {from: R1, to: E, both_ways: true, delay_ms: {lognormal: {mean: 0.7, cv: 0.3}}, rate_mbps: 940}
tasks:
  see: {on: {R1: {exec_ms: 9}}}
  find:
    input: latest
    on:
      R1: {exec_ms: 9}
      E: {exec_ms: 9}
  act: {on: {R1: {exec_ms: 9}}}
flows:
  - {from: see, to: find, bytes: 300000}
  - {from: find, to: act, bytes: 1000}
candidates:
  LOC: {find: R1}
  OFF: {find: E}
scenarios:
  stress: [{node: E, stress_threads: 2}]
  far: [{link: R1->E, add_delay_ms: 20}]
objective:
  weights: {latency: 1, violations: 3, robot: 0.2, edge: 0.1, switching: 0.2}
  targets: {latency_ms: 50, robot: 0.9, edge: 0.9}
  caps: {latency_ms: 400}
controller: {on: E, policy: LOC, initial: LOC, estimator: profile}
"""
#: Of the stage alone, and of the messaging of a job's worker that lies on the cycle's way. The 95th
#: percentiles of latency are between the steps that the quotas make.
STAGE_MS = {("see", "R1"): 1.5, ("find", "R1"): 5.0, ("find", "E"): 4.5, ("act", "R1"): 0.2}
MESSAGING_MS = {("see", "R1"): 0.5, ("find", "R1"): 0.7, ("find", "E"): 0.6, ("act", "R1"): 0.2}
#: More of its worker's messaging, which delays nothing: background.
OFF_WAY_MS = {("see", "R1"): 0.2}
IDLE = 0.004
BACKGROUND = {"R1": 0.06, "E": 0.1}
BESIDE = {"R1": 0.04, "E": 0.05}
#: Of E, the only node that a run stresses.
INTERFERENCE = 1.25
ADDED_MS = 0.35
#: How often something wakes, per second, in the mean over the four runs.
HZ = {"R1": 900.0, "E": 1500.0}
WINDOWS = 60
BASE = 20_000


def share(bytes_: int, of: int) -> float:
    """Part of a task's messaging that a message is; as large as it is, and as any is."""
    return (BASE + bytes_) / of


def observed(truth: Problem, nominal: Path, placement: str, scenario: str = "baseline") -> Run:
    """Record a run of the true cell as a live one is recorded."""
    real = draw(truth, scenario=scenario, seed=7, windows=WINDOWS)
    played = simulate_realisation(truth, real, policy=placement, jobs=True)
    exec_ns = {site: real.exec_ns[row] for row, site in enumerate(real.sites)}
    jobs = played.jobs.filter(pl.col("end_ns").is_not_null())
    cycles, tasks, nodes = (jobs[name].to_list() for name in ("cycle", "task", "node"))
    sites = list(zip(tasks, nodes, strict=True))
    slower = INTERFERENCE if scenario == "stress" else 1.0
    took = [
        exec_ns[s][c] * (slower if s[1] == "E" else 1.0) for s, c in zip(sites, cycles, strict=True)
    ]
    over_ns = np.array([round(MESSAGING_MS[site] * 1e6) for site in sites])
    cpu_ns = np.array(took).round().astype(np.int64) - over_ns
    # A worker reads before its stage starts, and writes after it has ended.
    bytes_of = {"see": (0, 300_000), "find": (300_000, 1_000), "act": (1_000, 0)}
    of = np.array([2 * BASE + sum(bytes_of[task]) for task in tasks])
    read, wrote = (
        np.array([BASE + bytes_of[task][i] for task in tasks]) / of * over_ns for i in (0, 1)
    )
    first = np.array(tasks) == "see"
    jobs = jobs.with_columns(
        ready_ns=pl.col("ready_ns") + pl.Series(np.where(first, 0, read)).cast(pl.Int64),
        start_ns=pl.col("start_ns") + pl.Series(read).cast(pl.Int64),
        end_ns=pl.col("end_ns") - pl.Series(wrote).cast(pl.Int64),
        cpu_ns=pl.Series(cpu_ns),
    )
    beside = pl.col("node").cast(pl.String).replace_strict(BESIDE, return_dtype=pl.Float64)
    took_ns = pl.col("end_ns") - pl.col("start_ns")
    jobs = jobs.with_columns(others_ns=(beside * took_ns).cast(pl.Int64))
    document = to_document(dwell.load(nominal))
    meta = {**played.meta, "kind": "live", "scenario": scenario, "problem": document}
    meta["wakes_hz"] = {node: hz * (1.1 if placement == "OFF" else 0.7) for node, hz in HZ.items()}
    tables: Mapping[str, Any] = {
        "cycles": played.cycles,
        "windows": played.windows,
        "decisions": played.decisions,
        "jobs": jobs,
        "processes": processes(truth, played, jobs),
    }
    return Run(meta, tables)


def processes(truth: Problem, played: Run, jobs: pl.DataFrame) -> pl.DataFrame:
    """What the workers took in every window; of the rest only that there is something."""
    rows = []
    grace_ms = truth.controller.close_grace_ms
    span_ns = (truth.window_cycles * truth.pipeline.period_ms + grace_ms) * 1e6
    for window, first in played.windows.select("window", "first_cycle").iter_rows():
        inside = jobs.filter(pl.col("cycle").is_between(first, first + truth.window_cycles - 1))
        for task, node in STAGE_MS:
            of = inside.filter((pl.col("task") == task) & (pl.col("node") == node))
            each_ms = MESSAGING_MS[task, node] + OFF_WAY_MS.get((task, node), 0.0)
            spent_ns = int(of["cpu_ns"].sum()) + of.height * each_ms * 1e6
            rows.append((window, f"{task}@{node}", node, round(spent_ns + IDLE * span_ns)))
        rows += [(window, f"agent@{node}", node, 10**6) for node in BACKGROUND]
    schema = {"window": pl.Int64, "process": pl.String, "node": pl.String, "cpu_ns": pl.Int64}
    return pl.DataFrame(rows, schema=schema, orient="row")
