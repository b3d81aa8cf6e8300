"""What decisions that come more often than windows close are worth: J, V_D, and moves undone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

import dwell
from benchmarks.figures import Figure, Goal, Section
from dwell.control import seen_costs
from dwell.control.windows import missed_cycles, seen_l95_ms
from dwell.cost import hamming
from dwell.model import Problem
from dwell.model.instants import NEVER_NS
from dwell.model.window_close import window_close_ns
from dwell.record import Run
from dwell.study import load_study
from dwell.study.reference import ORACLE, references

Floats: TypeAlias = NDArray[np.float64]

ROOT = Path(__file__).parents[1]
STUDY = ROOT / "examples" / "studies" / "dynamic.yaml"
#: Scenarios, with what J of the default may be above the oracle's and above the comparison's, %.
SCENARIOS = {
    "baseline": (3, 1),
    "step": (3, 1),
    "drift": (3, 1),
    "bursts": (6, -9),
    "flapping": (3, 1),
    "mixture": (3, -4),
}
#: Most that V_D of the default may be above the comparison's, points.
MISSED = {"bursts": -4.5, "mixture": -2.0}
INTERVALS = (5, 10, 25, 50, 100)
#: Windows after which a move back undoes none.
BACK = 3


@dataclass(frozen=True)
class Stretches:
    """A run's J, its terms with it, over fixed stretches of W cycles, the warm-up left out.

    At `decide_cycles` = W windows begin anew with each move: there the utilisation of a stretch is
    the mean over its cycles of the utilisation of their windows.
    """

    run: Run
    problem: Problem

    @property
    def count(self) -> int:
        """Number of whole stretches up to the end of the last window."""
        return int(self._firsts[-1] + self.problem.window_cycles) // self.problem.window_cycles

    @cached_property
    def _firsts(self) -> NDArray[np.int64]:
        return self.run.windows["first_cycle"].to_numpy()

    @cached_property
    def missed(self) -> Floats:
        """V_D of every stretch."""
        return self._seen[1]

    @cached_property
    def costs(self) -> Floats:
        """J of every stretch."""
        problem, names = self.problem, self.run.cycles["placement"].cast(str).to_list()
        placed = [problem.candidates[name] for name in names[: self.count * problem.window_cycles]]
        moved = np.array([0.0, *(hamming(there, here) for here, there in pairwise(placed))])
        cycles = np.arange(len(placed))
        window = np.searchsorted(self._firsts + problem.window_cycles, cycles, side="right")
        used = {
            name: self._by_stretch(self.run.windows[f"u_{name}"].to_numpy()[window]).mean(axis=1)
            for name in problem.fabric.resources
        }
        l95_ms, missed = self._seen
        return seen_costs(problem, l95_ms, missed, used, self._by_stretch(moved).sum(axis=1))

    def _by_stretch(self, values: NDArray[Any]) -> NDArray[Any]:
        size = self.count * self.problem.window_cycles
        return values[:size].reshape(-1, self.problem.window_cycles)

    @cached_property
    def _seen(self) -> tuple[Floats, Floats]:
        """L95 (ms) and V_D of every stretch."""
        problem = self.problem
        latency_ns = self.run.cycles["latency_ns"].fill_null(NEVER_NS).to_numpy()
        release_ns = self.run.cycles["release_ns"].to_numpy()
        releases = np.append(release_ns, release_ns[-1] + problem.pipeline.period_ns)
        ends = np.arange(1, self.count + 1) * problem.window_cycles
        close_ns = window_close_ns(problem, releases[ends - 1], releases[ends])
        age_ns = close_ns[:, None] - self._by_stretch(release_ns)
        latency = self._by_stretch(latency_ns)
        l95_ms, _ = seen_l95_ms(latency, age_ns, problem.censor_ms)
        missed = missed_cycles(latency, age_ns, problem.pipeline.deadline_ns)
        return l95_ms, np.asarray(missed) / problem.window_cycles

    @property
    def undone(self) -> float:
        """Moves in 100 windows that are back within `BACK` windows where they came from."""
        names = self.run.cycles["placement"].cast(str).to_list()
        moves = [k for k in range(1, len(names)) if names[k] != names[k - 1]]
        longest = BACK * self.problem.window_cycles
        back = [
            any(names[later] == names[k - 1] for later in moves if k < later <= k + longest)
            for k in moves
        ]
        return 100 * sum(back) / (len(names) / self.problem.window_cycles)


def cell() -> Problem:
    """Return the first example, which leaves the controller's settings out, with all scenarios."""
    scenarios = load_study(STUDY).points[0].problem.scenarios
    return replace(dwell.load(ROOT / "examples" / "first.yaml"), scenarios=scenarios)


def settings(problem: Problem, every: int) -> Problem:
    """Return the cell with another interval between decisions; the rest by default."""
    if every == problem.decide_cycles:
        return problem
    return replace(problem, controller=replace(problem.controller, decide_cycles=every))


def once_per_window(problem: Problem) -> Problem:
    """Return the cell with one decision per window, N_min 3 and shadows of 5 %."""
    controller = replace(
        problem.controller,
        decide_cycles=problem.window_cycles,
        min_dwell=3,
        shadow_fraction=0.05,
    )
    return replace(problem, controller=controller)


def played(problem: Problem, scenario: str, seed: int, windows: int) -> Stretches:
    """Play a cell."""
    run = dwell.simulate(problem, scenario=scenario, seed=seed, windows=windows)
    return Stretches(run, problem)


def of_oracle(problem: Problem, scenario: str, seed: int, windows: int) -> Stretches:
    """Play the oracle's sequence, which decides as often as the cell does."""
    real = dwell.draw(problem, scenario=scenario, seed=seed, windows=windows)
    return Stretches(references(problem, real).runs[ORACLE], problem)


@dataclass(frozen=True)
class Compared:
    """Figures of one scenario and seed, of one interval; differences are to W and N_min 3."""

    scenario: str
    every: int
    seed: int
    missed: float
    cost: float
    missed_less: float
    cost_less: float
    undone: float
    over_oracle: float | None


def compared(
    scenario: str, seed: int, windows: int, intervals: Sequence[int] = INTERVALS
) -> Iterator[Compared]:
    """Yield the figures of every interval, with the ratio to the oracle for the default."""
    problem = cell()
    warm = problem.warmup_windows
    usual = played(once_per_window(problem), scenario, seed, windows)
    for every in intervals:
        often = settings(problem, every)
        one = played(often, scenario, seed, windows)
        last = min(one.count, usual.count)
        mean = [each.costs[warm:last].mean() for each in (one, usual)]
        rates = [each.missed[warm:last].mean() for each in (one, usual)]
        over = None
        if every == problem.decide_cycles:
            best = of_oracle(often, scenario, seed, windows).costs[warm:last].mean()
            over = 100 * float(mean[0] / best - 1)
        yield Compared(
            scenario,
            every,
            seed,
            100 * float(rates[0]),
            float(mean[0]),
            100 * float(rates[0] - rates[1]),
            100 * float(mean[0] / mean[1] - 1),
            one.undone,
            over,
        )


def measure(quick: bool) -> Section:
    """Compare intervals between decisions with one decision per window and N_min 3."""
    windows, seeds = (60, range(1, 3)) if quick else (300, range(1, 21))
    figures = []
    for scenario, (over_oracle, most) in SCENARIOS.items():
        rows = [row for seed in seeds for row in compared(scenario, seed, windows)]
        for every in INTERVALS:
            of = [row for row in rows if row.every == every]
            is_default = every == INTERVALS[2]
            what = f"{scenario}, every {every}"
            goal = Goal(high=MISSED[scenario]) if is_default and scenario in MISSED else None
            less = [row.missed_less for row in of]
            figures.append(Figure(f"{what}: V_D less that of W", less, "points", goal))
            goal = Goal(high=most) if is_default else None
            less = [row.cost_less for row in of]
            figures.append(Figure(f"{what}: J less that of W", less, "%", goal))
            undone = [row.undone for row in of]
            figures.append(Figure(f"{what}: moves undone", undone, "in 100 windows"))
            over = [row.over_oracle for row in of if row.over_oracle is not None]
            if over:
                above = Goal(high=over_oracle)
                figures.append(Figure(f"{what}: J above the oracle's", over, "%", above))
    return Section("Decisions within windows, by default every 25 cycles", figures)
