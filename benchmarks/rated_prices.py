"""Prices of random cells with several rates: the kernel's, and the estimates of `corrected`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.random_cells import random_cell, rated_cell
from benchmarks.stated_errors import true_means
from dwell.estimators.prices import prices_of
from dwell.model import Problem
from dwell.model.number_arrays import Floats

#: Cells with prices, and cells with a steady fault; the same for a quick measurement.
PRICED, FAULTY, QUICK = 200, 40, (20, 8)
#: Seeds and windows of the runs that prices are compared with, after a warm-up; with idle cycles
#: more windows, so that as many cycles count.
SEEDS, WINDOWS, WARMUP = range(1, 11), 200, 5
#: Windows of the runs that estimates are compared with.
LONG = 300
#: Windows after which estimates are compared; with idle cycles also after more windows, so that as
#: many cycles count.
SEEN = 40
#: Goals: L95 in per cent, V_D in percentage points.
PRICE, ESTIMATE = (2.0, 0.5), (1.0, 0.3)


class Off(NamedTuple):
    """Differences of a price from the mean of runs: L95 in per cent, V_D in points."""

    l95: float
    violation_rate: float


def priced(problem: Problem) -> Iterator[Off]:
    """Yield the difference of each candidate's price from its runs."""
    for name, price in prices_of(problem).items():
        l95_ms, rate = _simulated(problem, name)
        yield _off((price.l95_ms, price.violation_rate), (l95_ms, rate))


def estimated(problem: Problem, scenario: str) -> Iterator[tuple[Off, Off]]:
    """Yield the differences of each alternative's estimate from long runs, under a steady fault.

    The first is after `SEEN` windows, the second after `SEEN` windows of counted cycles.
    """
    incumbent, *others = problem.candidates
    interval = problem.pipeline.due_interval
    judged = _deciding_at_closes(problem)
    short, long = (
        dwell.simulate(
            problem,
            scenario=scenario,
            policy=incumbent,
            estimator="corrected",
            seed=1,
            windows=windows,
        ).decisions.row(-1, named=True)
        for windows in (SEEN, SEEN * interval)
    )
    for name in others:
        (l95_ms, _), (rate, _) = true_means(judged, scenario, name, LONG * interval)
        columns = f"est_l95_ms_{name}", f"est_violation_rate_{name}"
        early, late = ((row[columns[0]], row[columns[1]]) for row in (short, long))
        yield _off(early, (l95_ms, rate)), _off(late, (l95_ms, rate))


def _simulated(problem: Problem, name: str) -> tuple[float, float]:
    """Return the mean L95 (ms) and V_D of runs that stay on a candidate."""
    windows = WARMUP + WINDOWS * problem.pipeline.due_interval
    problem = _deciding_at_closes(problem)
    runs = [
        dwell.simulate(
            problem, policy=name, estimator="profile", seed=seed, windows=windows
        ).windows[WARMUP:]
        for seed in SEEDS
    ]
    l95_ms, rates = (
        np.mean([run[column].to_numpy() for run in runs])
        for column in ("seen_l95_ms", "violation_rate")
    )
    return float(l95_ms), float(rates)


def _deciding_at_closes(problem: Problem) -> Problem:
    """Return a problem with one decision per window, which takes less time."""
    controller = replace(problem.controller, decide_cycles=problem.window_cycles)
    return replace(problem, controller=controller)


def _off(price: tuple[float, float], true: tuple[float, float]) -> Off:
    return Off(100.0 * abs(price[0] / true[0] - 1.0), 100.0 * abs(price[1] - true[1]))


def measure(quick: bool) -> Section:
    """Differences of prices and of estimates from simulated runs, with and without rates."""
    cells, faulty = QUICK if quick else (PRICED, FAULTY)
    figures: list[Figure] = []
    for make, what in ((rated_cell, "several rates"), (random_cell, "one rate")):
        rows = [row for number in range(cells) for row in priced(make(number))]
        figures += _within(what, rows)
    for make, what in ((rated_cell, "several rates"), (random_cell, "one rate")):
        pairs = [pair for number in range(faulty) for pair in _under_fault(make, number)]
        short, long = ([pair[i] for pair in pairs] for i in (0, 1))
        figures += _medians(f"{what}, {SEEN} windows", short)
        if short != long:
            figures += _medians(f"{what}, {SEEN} windows of counted cycles", long)
    return Section("Prices of random cells with several rates", figures)


def _under_fault(make: Callable[[int], Problem], number: int) -> Iterator[tuple[Off, Off]]:
    problem = make(number)
    names = [name for name in problem.scenarios if problem.scenarios[name]]
    yield from estimated(problem, names[number % len(names)])


def _within(what: str, rows: list[Off]) -> Iterator[Figure]:
    """Yield the share of prices that are close, and the largest differences."""
    for title, unit, bound, off in _columns(rows, PRICE):
        share = 100.0 * float(np.mean(off <= bound))
        yield Figure(f"price, {what}: {title} within {bound:g} {unit}", [share], "%", Goal(low=95))
        yield Figure(f"price, {what}: {title}, median", [float(np.median(off))], unit)
        yield Figure(f"price, {what}: {title}, largest", [float(off.max())], unit)


def _medians(what: str, rows: list[Off]) -> Iterator[Figure]:
    """Yield the median differences of estimates."""
    for title, unit, bound, off in _columns(rows, ESTIMATE):
        goal = Goal(high=bound)
        yield Figure(f"corrected, {what}: {title}, median", [float(np.median(off))], unit, goal)
        late = float(np.quantile(off, 0.9))
        yield Figure(f"corrected, {what}: {title}, nine in ten within", [late], unit)


def _columns(
    rows: list[Off], bounds: tuple[float, float]
) -> Iterator[tuple[str, str, float, Floats]]:
    """Yield name, unit, bound and differences of L95 and of V_D."""
    return zip(("L95", "V_D"), ("%", "points"), bounds, np.array(rows).T, strict=True)
