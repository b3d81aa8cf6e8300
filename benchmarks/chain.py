"""Beside two peers: one model as a cell, in SimPy, and in a C++ loop made for nothing else."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import dwell
from benchmarks.canonical import PARTS, simulate_in_parts
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import (
    CPP,
    Took,
    compile_cpp_loop,
    in_turns,
    ratios,
    run_program,
    shared_core,
)
from dwell import Run
from dwell.model import Problem

HERE = Path(__file__).parent
CELL = HERE / "peer-chain.yaml"
SIMPY = ("process", "store")


def measure(quick: bool) -> Section:
    """Cycles a second of all three, and whether they simulate the same."""
    rounds, cycles, simpy_cycles = (3, 300_000, 10_000) if quick else (5, 1_000_000, 50_000)
    problem = dwell.load(CELL)
    notes: list[str] = []
    found: dict[str, tuple[float, float]] = {}
    parts: list[tuple[Took, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        size = {"dwell": cycles}
        variants: dict[str, Callable[[], Took]] = {"dwell": partial(_ours, problem, cycles, parts)}
        if find_spec("simpy") is None:
            notes.append("SimPy skipped: it is not installed")
        else:
            for name in SIMPY:
                command = [sys.executable, str(HERE / "peers" / "simpy_chain.py")]
                command += [str(simpy_cycles), name]
                size[f"SimPy, {name}"] = simpy_cycles
                variants[f"SimPy, {name}"] = partial(_peer, command, f"SimPy, {name}", found)
        if shutil.which(CPP[0]) is None:
            notes.append(f"C++ loop skipped: no {CPP[0]} here")
        else:
            program = compile_cpp_loop(Path(folder))
            size["C++ loop"] = cycles
            variants["C++ loop"] = partial(_peer, [program, str(cycles)], "C++ loop", found)
        runs = in_turns(variants, rounds)
    speed = {name: [size[name] / run.cpu_s for run in runs[name]] for name in size}
    figures = [Figure(name, values, "cycles/s") for name, values in speed.items()]
    for i, part in enumerate(PARTS):
        spent = [1e9 * run[i].cpu_s / cycles for run in parts[1:]]
        figures.insert(i + 1, Figure(f"  of it: {part}", spent, "ns/cycle"))
    for name, values in speed.items():
        if name != "dwell":
            goal = Goal(low=0.65 if name == "C++ loop" else 100)
            times = ratios(speed["dwell"], values)
            figures.append(Figure(f"dwell over {name}", times, "times", goal))
    windows = cycles // problem.window_cycles
    found["dwell"] = _p95_and_miss(dwell.simulate(problem, policy="ONE", seed=1, windows=windows))
    for name, (p95, miss) in found.items():
        figures.append(Figure(f"p95 by {name}", [p95], "ms", Goal(29.83, 30.03)))
        figures.append(Figure(f"missed by {name}", [100 * miss], "%", Goal(1.15, 1.35)))
    notes += shared_core(run for some in runs.values() for run in some)
    return Section(
        f"Peers: draw, simulate and window metrics of {cycles} cycles (SimPy: {simpy_cycles})",
        figures,
        notes,
    )


def _ours(problem: Problem, cycles: int, parts: list[tuple[Took, ...]]) -> Took:
    windows = cycles // problem.window_cycles
    laps = simulate_in_parts(
        problem, "baseline", policy="ONE", seed=1, windows=windows, decisions=False
    )
    parts.append(laps)
    return laps[0] + laps[1] + laps[2]


def _peer(command: list[str], name: str, found: dict[str, tuple[float, float]]) -> Took:
    said = json.loads(run_program(command))
    found[name] = (said["p95"], said["miss"])
    return Took(said["wall_s"], said["cpu_s"])


def _p95_and_miss(run: Run) -> tuple[float, float]:
    """What the peers report: the mean of the windows' interpolated p95, and of their misses."""
    latency_ms = run.cycles["latency_ns"].to_numpy().reshape(run.windows.height, -1) / 1e6
    p95 = float(np.percentile(latency_ms, 95, axis=1).mean())
    return p95, float(run.windows["violation_rate"].to_numpy().mean())
