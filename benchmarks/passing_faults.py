"""The default policy against the best static placement, in random cells with passing faults."""

from __future__ import annotations

from benchmarks.figures import Figure, Goal, Section
from benchmarks.random_cells import passing_faults
from benchmarks.sooner import Stretches
from dwell import simulate
from dwell.model import Problem
from dwell.study import mean_interval

CELLS, SEEDS = range(16), range(1, 6)
#: Duration of a run: every fault once, for 30 of 120 s.
DURATION_S = 500.0
SCENARIO = "passing"


def measure(quick: bool) -> Section:
    """Compare J, which contains moves, seed by seed; also with placements that send shadow jobs."""
    cells, seeds = (CELLS[:2], SEEDS[:2]) if quick else (CELLS, SEEDS)
    figures = []
    for estimator, words in (("profile", ""), ("corrected", ", with shadow jobs")):
        dearer = []
        for number in cells:
            more = _more_than_best(passing_faults(number), estimator, seeds)
            interval = mean_interval(more)
            low = interval.low if interval is not None else min(more)
            dearer.append(float(low > 0))
            what = f"cell {number}: J less the best placement's{words}"
            figures.append(Figure(what, more, "%"))
        share = 100 * sum(dearer) / len(dearer)
        what = f"cells dearer by more than their 95 % interval{words}"
        figures.append(Figure(what, [share], "%", Goal(high=0)))
    return Section("Passing faults: the default against the best static placement", figures)


def _more_than_best(problem: Problem, estimator: str, seeds: range) -> list[float]:
    """Return the difference of J for each seed, in % of the J of the best placement."""
    static = {
        name: [_mean_cost(problem, f"{name}+{estimator}", seed) for seed in seeds]
        for name in problem.candidates
    }
    best = min(static.values(), key=sum)
    ours = [_mean_cost(problem, None, seed) for seed in seeds]
    return [100 * (mine / other - 1) for mine, other in zip(ours, best, strict=True)]


def _mean_cost(problem: Problem, policy: str | None, seed: int) -> float:
    """Return the mean J over stretches of W cycles, the warm-up left out."""
    cycle_s = problem.pipeline.period_ns * problem.window_cycles / 1e9
    windows = round(DURATION_S / cycle_s)
    run = simulate(problem, scenario=SCENARIO, policy=policy, seed=seed, windows=windows)
    return float(Stretches(run, problem).costs[problem.warmup_windows :].mean())
