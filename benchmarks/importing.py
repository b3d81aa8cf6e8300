"""Importing: `import dwell` and `dwell --help` over an interpreter that does nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec

from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, run_program

GOAL = Goal(high=0.3)


def measure(quick: bool) -> Section:
    """Seconds over bare Python."""
    commands = {"bare Python": ["-c", "pass"], "import dwell": ["-c", "import dwell"]}
    notes = ["elapsed time of a whole process, files in the system's cache"]
    if find_spec("dwell.__main__") is None:
        notes.append("dwell --help skipped: there is no command line yet")
    else:
        commands["dwell --help"] = ["-m", "dwell", "--help"]
    variants: dict[str, Callable[[], Took]] = {
        name: partial(_run, command) for name, command in commands.items()
    }
    runs = in_turns(variants, 5 if quick else 15)
    spent = {name: [run.wall_s for run in runs[name]] for name in commands}
    bare = spent.pop("bare Python")
    figures = [Figure("bare Python", bare, "s")]
    for name, values in spent.items():
        over = [one - other for one, other in zip(values, bare, strict=True)]
        figures.append(Figure(f"{name}, over that", over, "s", GOAL))
    return Section("Importing", figures, notes)


def _run(command: list[str]) -> Took:
    begin = time.perf_counter()
    run_program([sys.executable, *command])
    wall_s = time.perf_counter() - begin
    return Took(wall_s, wall_s)
