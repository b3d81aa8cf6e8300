"""Drawing: what a value of each kind of process costs, rounded and stored, and a cycle of cells."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import dwell
from benchmarks.figures import Figure, Section
from benchmarks.timing import ROOT, Took, in_turns, shared_core, took
from dwell.model import (
    AR1,
    Constant,
    Execution,
    Exponential,
    Fabric,
    Gamma,
    LogNormal,
    Node,
    Normal,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Process,
    Targets,
    Task,
    Trace,
    TraceTable,
    Uniform,
    Weights,
)

WINDOW_CYCLES = 100
#: Cells, and scenarios of theirs.
CELLS = (
    ("examples/canonical.yaml", "baseline"),
    ("examples/canonical.yaml", "edge-cpu-stress"),
    ("benchmarks/peer-chain.yaml", "baseline"),
)


def measure(quick: bool) -> Section:
    """Nanoseconds a value over a constant, and a cycle of some cells."""
    windows, rounds = (1_000, 3) if quick else (5_000, 5)
    recorded = TraceTable("recorded", {"ms": np.linspace(1, 3, 10_007)}, wrap=True)
    processes: dict[str, Process] = {
        "constant": Constant(2.0),
        "uniform": Uniform(1.0, 3.0),
        "normal": Normal(2.0, 0.2),
        "lognormal": LogNormal(2.0, 0.2),
        "exponential": Exponential(2.0),
        "gamma": Gamma(2.0, 0.2),
        "ar1": AR1(2.0, 0.2, 0.9),
        "trace": Trace(recorded, "ms"),
    }
    variants: dict[str, Callable[[], Took]] = {
        name: partial(_draw, _problem(process), windows) for name, process in processes.items()
    }
    cells = {f"{Path(cell).stem}, {scenario}": (cell, scenario) for cell, scenario in CELLS}
    variants |= {
        name: partial(_draw, dwell.load(ROOT / cell), windows, scenario)
        for name, (cell, scenario) in cells.items()
    }
    runs = in_turns(variants, rounds)
    values = windows * WINDOW_CYCLES
    spent = {name: [1e9 * run.cpu_s / values for run in runs[name]] for name in variants}
    constant = spent.pop("constant")
    figures = [Figure("releases and a constant", constant, "ns a cycle")]
    for name, taken in spent.items():
        if name in cells:
            figures.append(Figure(name, taken, "ns a cycle"))
            continue
        over = [one - other for one, other in zip(taken, constant, strict=True)]
        figures.append(Figure(f"{name}, over that", over, "ns a value"))
    notes = shared_core(run for some in runs.values() for run in some)
    return Section(f"Drawing {values} cycles", figures, notes)


def _problem(process: Process) -> Problem:
    """One task on one node, and nothing else."""
    node, task = Node("N", tier="edge", cores=1), Task("T", on={"N": Execution(process)})
    return Problem(
        name="drawing",
        pipeline=Pipeline(tasks={"T": task}, flows=(), period_ms=10.0, deadline_ms=10.0),
        fabric=Fabric(nodes={"N": node}, links={}),
        candidates={"ONE": Placement({"T": "N"})},
        objective=Objective(
            weights=Weights(), targets=Targets(latency_ms=10.0), tiers={"N": node.tier}
        ),
        window_cycles=WINDOW_CYCLES,
    )


def _draw(problem: Problem, windows: int, scenario: str = "baseline") -> Took:
    return took(lambda: dwell.draw(problem, scenario=scenario, seed=1, windows=windows))
