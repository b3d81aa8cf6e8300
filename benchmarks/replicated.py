"""Time of the kernel for a cycle with two copies over the time for a cycle with one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, shared_core, took
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.model import Problem, Replicas

CELL = Path(__file__).parents[1] / "examples" / "canonical.yaml"
MEMBERS = "LOC", "SO"
WINDOWS = 300
GOAL = Goal(high=2.2)


def measure(quick: bool) -> Section:
    """Kernel time of a cycle under LOC + SO over the time under each alone, undisturbed."""
    plain = dwell.load(CELL)
    both = Replicas({name: plain.candidates[name] for name in MEMBERS})
    cell = replace(plain, candidates={**plain.candidates, "BOTH": both})
    alone = {f"{name}, cell without replicas": _player(plain, name) for name in MEMBERS}
    alone |= {f"{name}, same cell": _player(cell, name) for name in MEMBERS}
    runs = in_turns({**alone, "BOTH": _player(cell, "BOTH")}, 5 if quick else 15)
    figures = [
        Figure(
            f"over {name}",
            [
                mine.cpu_s / other.cpu_s
                for mine, other in zip(runs["BOTH"], runs[name], strict=True)
            ],
            "",
            GOAL,
        )
        for name in alone
    ]
    notes = shared_core(run for some in runs.values() for run in some)
    return Section("A cycle with two copies over a cycle with one", figures, notes)


def _player(problem: Problem, name: str) -> Callable[[], Took]:
    """Return a function that times the kernel on a fixed realisation under a candidate."""
    first = lay_out([(problem, dwell.draw(problem, seed=1, windows=WINDOWS))])
    first.tables.stamps[0] = list(problem.candidates).index(name)

    def timed() -> Took:
        # The copy is not part of the time.
        return took(partial(play, first.copy()))

    return timed
