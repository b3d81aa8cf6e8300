"""The canonical cell under DTP: draws, decisions and tables of windows and decisions included."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT, Stopwatch, Took, in_turns, shared_core
from dwell.model import Problem

CELL = ROOT / "examples" / "canonical.yaml"
SCENARIOS = ("baseline", "edge-cpu-stress")
PARTS = ("draw", "play and decide", "tables")


def measure(quick: bool) -> Section:
    """Cycles a second of long and of short runs."""
    rounds = 2 if quick else 5
    sizes = {"long": (3_000 if quick else 10_000, 1), "short": (300, 5 if quick else 20)}
    problem = dwell.load(CELL)
    parts: dict[tuple[str, str], list[tuple[Took, ...]]] = {}
    variants: dict[tuple[str, str], Callable[[], Took]] = {}
    for scenario in SCENARIOS:
        for size, (windows, times) in sizes.items():
            key = (scenario, size)
            parts[key] = []
            variants[key] = partial(_simulate, problem, scenario, windows, times, parts[key])
    runs = in_turns(variants, rounds)
    figures, notes = [], []
    for (scenario, size), taken in zip(variants, runs.values(), strict=True):
        windows, times = sizes[size]
        cycles = windows * problem.window_cycles * times
        what = f"{scenario}, {times} x {windows} windows"
        speed = [cycles / run.cpu_s for run in taken]
        figures.append(Figure(what, speed, "cycles/s", Goal(low=1e6)))
        for i, part in enumerate(PARTS):
            spent = [1e9 * run[i].cpu_s / cycles for run in parts[scenario, size][1:]]
            figures.append(Figure(f"  of it: {part}", spent, "ns/cycle"))
    notes += shared_core(run for some in runs.values() for run in some)
    return Section("Canonical cell under DTP, one core", figures, notes)


def length(quick: bool) -> Section:
    """Time a cycle takes in runs of more and more cycles."""
    sizes = {10_000: 20, 100_000: 3} if quick else {10_000: 20, 100_000: 3, 1_000_000: 1}
    problem = dwell.load(CELL)
    variants: dict[int, Callable[[], Took]] = {
        cycles: partial(_simulate, problem, "baseline", cycles // problem.window_cycles, times, [])
        for cycles, times in sizes.items()
    }
    runs = in_turns(variants, 3 if quick else 5)
    spent = {
        cycles: [1e9 * run.cpu_s / times / cycles for run in runs[cycles]]
        for cycles, times in sizes.items()
    }
    figures = [Figure(f"{cycles} cycles", values, "ns/cycle") for cycles, values in spent.items()]
    *_, one, other = sizes
    growth = [after / before for after, before in zip(spent[other], spent[one], strict=True)]
    what = f"a cycle of {other} over one of {one}"
    figures.append(Figure(what, growth, "times", Goal(high=1.2)))
    notes = shared_core(run for some in runs.values() for run in some)
    return Section("Canonical cell under DTP by length of the run", figures, notes)


def _simulate(
    problem: Problem, scenario: str, windows: int, times: int, parts: list[tuple[Took, ...]]
) -> Took:
    """Simulate `times` runs, each with a seed of its own; note what each part took."""
    total = [Took(0.0, 0.0)] * len(PARTS)
    for seed in range(1, times + 1):
        laps = simulate_in_parts(problem, scenario, policy="dtp", seed=seed, windows=windows)
        total = [before + lap for before, lap in zip(total, laps, strict=True)]
    parts.append(tuple(total))
    return total[0] + total[1] + total[2]


def simulate_in_parts(
    problem: Problem,
    scenario: str,
    *,
    policy: str,
    seed: int,
    windows: int,
    decisions: bool = True,
) -> tuple[Took, Took, Took]:
    """Simulate one run and return what each of `PARTS` took.

    The table of windows is always made, that of decisions on request.
    """
    stopwatch = Stopwatch()
    real = dwell.draw(problem, scenario=scenario, seed=seed, windows=windows)
    drawn = stopwatch.lap()
    run = dwell.simulate_realisation(problem, real, policy=policy)
    played = stopwatch.lap()
    _ = run.windows, run.decisions if decisions else None
    return drawn, played, stopwatch.lap()
