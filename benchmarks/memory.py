"""Memory of a long run: how far it raises the peak of a process that has run a short one."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import run_module

STATUS = Path("/proc/self/status")


def measure(quick: bool) -> Section:
    """Bytes a cycle and task that a run without jobs takes."""
    windows, rounds = (3_000, 1) if quick else (10_000, 3)
    title = f"Memory of {windows} windows of the canonical cell, without jobs"
    if not STATUS.exists():
        return Section(title, (), [f"skipped: this system has no {STATUS}"])
    said = [json.loads(run_module("benchmarks.memory", str(windows))[0]) for _ in range(rounds)]
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
        ],
        ["peak of the resident set, over that after a run of 20 windows"],
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


if __name__ == "__main__":
    _run_alone(int(sys.argv[1]))
