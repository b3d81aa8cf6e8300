"""Memory of a long run: its own, and the peak of a whole process that plays thirty tasks."""

from __future__ import annotations

import json
import sys
from itertools import pairwise
from pathlib import Path

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import run_module
from dwell.model import (
    Execution,
    Fabric,
    Flow,
    LogNormal,
    Node,
    Objective,
    Pipeline,
    Placement,
    Problem,
    Targets,
    Task,
    Weights,
)

STATUS = Path("/proc/self/status")
#: Tasks of the wide cell: one after another, each on one node.
TASKS = 30
PEAK = Goal(high=0.5)


def measure(quick: bool) -> Section:
    """Bytes a cycle and task that a run without jobs takes."""
    windows, rounds = (3_000, 1) if quick else (10_000, 3)
    title = f"Memory of {windows} windows of the canonical cell, without jobs"
    if not STATUS.exists():
        return Section(title, (), [f"skipped: this system has no {STATUS}"])
    said = [json.loads(run_module("benchmarks.memory", str(windows))[0]) for _ in range(rounds)]
    peaks = [float(run_module("benchmarks.memory", "wide", str(windows))[0]) for _ in range(rounds)]
    what = {
        "run": "draw, simulate, tables of windows and decisions",
        "cycles": "and the table of cycles",
    }
    return Section(
        title,
        [
            Figure(
                text,
                [one[part] for one in said],
                "bytes a cycle and task",
                Goal(high=80) if part == "run" else None,
            )
            for part, text in what.items()
        ]
        + [
            Figure(f"{TASKS} tasks, the whole process", peaks, "GB", None if quick else PEAK),
        ],
        ["peak of the resident set, but for the last over that after a run of 20 windows"],
    )


def _bytes(name: str) -> int:
    """Memory of this process: now (`VmRSS`), or at its peak (`VmHWM`)."""
    for line in STATUS.read_text(encoding="ascii").splitlines():
        key, _, value = line.partition(":")
        if key == name:
            return int(value.split()[0]) * 1024
    raise KeyError(name)


def _run_alone(windows: int) -> None:
    problem = dwell.load(CELL)
    run = dwell.simulate(problem, policy="dtp", seed=1, windows=20)
    _ = run.windows, run.decisions, run.cycles
    before = _bytes("VmRSS")
    size = windows * problem.window_cycles * len(problem.pipeline.tasks)
    run = dwell.simulate(problem, policy="dtp", seed=2, windows=windows)
    _ = run.windows, run.decisions
    after_run = _bytes("VmHWM")
    _ = run.cycles
    after_cycles = _bytes("VmHWM")
    print(
        json.dumps({"run": (after_run - before) / size, "cycles": (after_cycles - before) / size})
    )


def _wide() -> Problem:
    """Tasks of 0.5 ms in a chain on one node."""
    lognormal = LogNormal(0.5, 0.15)
    names = [f"T{i}" for i in range(TASKS)]
    node = Node("E", tier="edge", cores=4)
    return Problem(
        name="wide",
        pipeline=Pipeline(
            tasks={name: Task(name, on={"E": Execution(lognormal)}) for name in names},
            flows=tuple(Flow(one, other) for one, other in pairwise(names)),
            period_ms=33.0,
            deadline_ms=33.0,
        ),
        fabric=Fabric(nodes={"E": node}, links={}),
        candidates={"ONE": Placement(dict.fromkeys(names, "E"))},
        objective=Objective(
            weights=Weights(), targets=Targets(latency_ms=33.0), tiers={"E": node.tier}
        ),
        window_cycles=100,
    )


def _run_wide(windows: int) -> None:
    run = dwell.simulate(_wide(), policy="ONE", seed=1, windows=windows)
    _ = run.windows, run.decisions, run.cycles
    print(_bytes("VmHWM") / 1e9)


if __name__ == "__main__":
    if sys.argv[1] == "wide":
        _run_wide(int(sys.argv[2]))
    else:
        _run_alone(int(sys.argv[1]))
