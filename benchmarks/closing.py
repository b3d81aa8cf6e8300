"""Closing a window in Python: aggregate, estimate, decide, record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

import dwell
from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import Took, in_turns, shared_core, took
from dwell.control import ClosedWindow, Controller, LookedAt
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.model import Problem

COUNTS = (1, 3, 6, 12, 24)


def measure(quick: bool) -> Section:
    """Microseconds a close takes with more and more candidates."""
    windows, rounds = (300, 3) if quick else (1_000, 7)
    problem = dwell.load(CELL)
    closed = _closed_windows(problem, windows)
    variants: dict[int, Callable[[], Took]] = {
        count: partial(_close_all, _with_candidates(problem, count), closed) for count in COUNTS
    }
    runs = in_turns(variants, rounds)
    spent = {count: [1e6 * run.cpu_s / windows for run in runs[count]] for count in COUNTS}
    figures = [
        Figure(f"{count} candidates", spent[count], "µs", Goal(high=30) if count == 3 else None)
        for count in COUNTS
    ]
    fits = [
        np.polynomial.Polynomial.fit(COUNTS, row, 1).convert().coef
        for row in zip(*spent.values(), strict=True)
    ]
    figures.append(Figure("a candidate more", [float(fit[1]) for fit in fits], "µs"))
    figures.append(Figure("intercept", [float(fit[0]) for fit in fits], "µs"))
    worst = max(
        abs(figure.value / (np.median([f[0] for f in fits]) + np.median([f[1] for f in fits]) * n))
        for n, figure in zip(COUNTS, figures, strict=False)
    )
    notes = [
        f"farthest above the straight line: {worst - 1:.0%}",
        *shared_core(run for some in runs.values() for run in some),
    ]
    return Section(f"Closing a window of {problem.window_cycles} cycles under DTP", figures, notes)


def _closed_windows(problem: Problem, windows: int) -> list[ClosedWindow]:
    """Windows of a real run, as an engine hands them over."""
    real = dwell.draw(problem, scenario="edge-cpu-stress", seed=1, windows=windows)
    arrays = lay_out([(problem, real)])
    play(arrays)
    tables, size = arrays.tables, problem.window_cycles
    return [
        ClosedWindow(
            latency_ns=tables.latency_ns[0, first : first + size],
            release_ns=real.release_ns[first : first + size],
            close_ns=int(real.release_ns[first + size]),
            open_ns=int(real.release_ns[first]),
            core_ns=tables.closed[0, i] - tables.opened[0, i],
            looked=LookedAt(i, first + size - 1, size),
        )
        for i, first in enumerate(range(0, windows * size, size))
    ]


def _with_candidates(problem: Problem, count: int) -> Problem:
    """Make the same problem with `count` candidates: its own, again and again."""
    own = list(problem.candidates.items())
    candidates = {}
    for i in range(count):
        name, placement = own[i % len(own)]
        candidates[name if i < len(own) else f"{name}-{i // len(own)}"] = placement
    settings = replace(problem.controller, initial=own[0][0], fallbacks=())
    return replace(problem, candidates=candidates, controller=settings)


def _close_all(problem: Problem, closed: list[ClosedWindow]) -> Took:
    controller = Controller(problem, "dtp")

    def work() -> None:
        for window in closed:
            controller.settle(controller.propose(window))

    return took(work)
