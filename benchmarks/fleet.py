"""A fleet: cells that share one edge server, in one call of the kernel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, shared_core, took
from dwell import Realisation
from dwell.kernels.advance import play
from dwell.kernels.arrays import Arrays, lay_out
from dwell.model import Problem

SIZES = (1, 8, 64, 256)
GOALS = {64: Goal(high=640), 256: Goal(high=950)}
SHARED = "E"
CANDIDATE = "SO"


def measure(quick: bool) -> Section:
    """Nanoseconds a cycle of a cell takes beside more and more cells, the total kept."""
    windows, rounds = (640, 3) if quick else (3_200, 5)
    problem = dwell.load(CELL)
    cycles = windows * problem.window_cycles
    fleets = {size: _fleet(problem, size, windows // size) for size in SIZES}
    variants: dict[int, Callable[[], Took]] = {
        size: partial(_play, fleet) for size, fleet in fleets.items()
    }
    runs = in_turns(variants, rounds)
    spent = {size: [1e9 * run.cpu_s / cycles for run in runs[size]] for size in SIZES}
    figures = [
        Figure(
            f"{size} cells" if size > 1 else "1 cell",
            spent[size],
            "ns/cell-cycle",
            GOALS.get(size),
        )
        for size in SIZES
    ]
    notes = [
        f"all on {CANDIDATE}; {SHARED} has {problem.fabric.nodes[SHARED].cores} cores a cell; "
        "the kernel only",
        *shared_core(run for some_runs in runs.values() for run in some_runs),
    ]
    return Section(f"Fleet: {cycles} cell-cycles in one call", figures, notes)


def _fleet(problem: Problem, size: int, windows: int) -> list[tuple[Problem, Realisation]]:
    """Make cells with seeds of their own, their releases spread evenly over the period."""
    edge = problem.fabric.nodes[SHARED]
    nodes = {**problem.fabric.nodes, SHARED: replace(edge, cores=edge.cores * size)}
    shared = replace(problem, fabric=replace(problem.fabric, nodes=nodes))
    period_ns = problem.pipeline.period_ms * 1e6
    cells = []
    for i in range(size):
        real = dwell.draw(shared, scenario="baseline", seed=i, windows=windows)
        shifted = real.release_ns + round(i * period_ns / size)
        cells.append((shared, replace(real, release_ns=shifted)))
    return cells


def _play(fleet: list[tuple[Problem, Realisation]]) -> Took:
    arrays: Arrays = lay_out(fleet, shared={SHARED})
    problem = fleet[0][0]
    arrays.tables.stamps[:] = list(problem.candidates).index(CANDIDATE)
    return took(lambda: play(arrays))
