"""Starting: CPU time of `dwell run` of 20 windows, with and without Python's bytecode."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import run_timed

GOAL = Goal(high=1.7)
POLICIES = ("dtp", "dtp+corrected")


def measure(quick: bool) -> Section:
    """Seconds of CPU time of a whole process."""
    spent: dict[str, list[float]] = {}
    for _ in range(3 if quick else 5):
        for policy in POLICIES:
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, "-m", "dwell", "run", str(CELL), "--windows", "20"]
                command += ["--policy", policy, "--force", "--out", str(Path(folder, "run"))]
                _, taken = run_timed(command)
                spent.setdefault(policy, []).append(taken.cpu_s)
                # Python finds no bytecode there, and writes none.
                bare = {"PYTHONPYCACHEPREFIX": folder, "PYTHONDONTWRITEBYTECODE": "1"}
                _, taken = run_timed(command, bare)
                spent.setdefault(f"{policy}, no module as bytecode", []).append(taken.cpu_s)
    figures = [
        Figure(what, values, "s", GOAL if what in POLICIES else None)
        for what, values in spent.items()
    ]
    return Section(
        "dwell run of 20 windows of the canonical cell",
        figures,
        ["whole processes; `make env` leaves what a run needs as bytecode"],
    )
