"""How often intervals and limits hold what they should: `python -m benchmarks.coverage`.

Makes tables of reproduction/evidence/interval-coverage.md: for known populations, and for
the canonical cell, whose means are over all simulated seeds (8,000: an hour on two cores;
`--seeds 800` for a look). Studies are disjoint: no two share a seed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

import dwell
from dwell.study import Interval, compare
from dwell.study.intervals import (
    mean_interval,
    share_difference_interval,
    share_interval,
    share_limits,
)
from reproduction.evidence.measured_on import measured_on

if TYPE_CHECKING:
    import polars as pl

Floats: TypeAlias = NDArray[np.float64]
Draw: TypeAlias = Callable[[np.random.Generator, tuple[int, int]], Floats]

STUDIES = 400
SIZES = (5, 10, 20)
#: Counted windows of a run, and the warm-up before them.
WINDOWS, WARMUP = 40, 5
SCENARIOS = ("baseline", "robot-cpu-stress")
POLICIES = ("LOC", "SO", "dtp+corrected")
SAMPLES = 2000


def seldom(share: float) -> Draw:
    """Runs of which only a share has any misses, about 9 % then."""

    def draw(rng: np.random.Generator, shape: tuple[int, int]) -> Floats:
        return np.where(rng.random(shape) < share, rng.beta(2, 20, shape), 0.0)

    return draw


#: Rates of misses of runs, and their means.
POPULATIONS: dict[str, tuple[Draw, float]] = {
    "beta(2, 60), slightly skewed": (lambda rng, shape: rng.beta(2, 60, shape), 2 / 62),
    "beta(½, 20), skewed": (lambda rng, shape: rng.beta(0.5, 20, shape), 0.5 / 20.5),
    "one run in five has misses, beta(2, 20)": (seldom(0.2), 0.2 * 2 / 22),
    "one run in ten has misses, beta(2, 20)": (seldom(0.1), 0.1 * 2 / 22),
}


def holding(intervals: Sequence[Interval], mean: float) -> float:
    """Share of some intervals that hold a mean."""
    return float(np.mean([one.low <= mean <= one.high for one in intervals]))


def of_populations() -> Iterator[str]:
    """Yield a row a population and number of seeds."""
    yield "| rates of the runs | seeds | interval | upper limit | Student's limit |"
    rng = np.random.default_rng(7)
    for name, (draw, mean) in POPULATIONS.items():
        for size in SIZES:
            rates = draw(rng, (SAMPLES, size))
            windows = WINDOWS * size
            intervals = [share_interval(row, windows=windows) for row in rates]
            limits = np.array([share_limits(row, windows=windows)[1] for row in rates])
            errors = rates.std(axis=1, ddof=1) / size**0.5
            students = rates.mean(axis=1) + student.ppf(0.95, size - 1) * errors
            shares = (holding(intervals, mean), (limits >= mean).mean(), (students >= mean).mean())
            yield (
                f"| {name} | {size} | " + " | ".join(f"{100 * one:.1f} %" for one in shares) + " |"
            )


def of_the_cell(runs: pl.DataFrame) -> Iterator[str]:
    """Yield a row a scenario, policy or pair of policies, and number of seeds."""
    yield "| scenario | policy | seeds | mean V_D | interval | upper limit | mean J | interval |"
    for scenario in SCENARIOS:
        of = {name: runs.filter(scenario=scenario, policy=name).sort("seed") for name in POLICIES}
        rates = {name: mine["violation_rate"].to_numpy() for name, mine in of.items()}
        costs = {name: mine["cost"].to_numpy() for name, mine in of.items()}
        windows = {name: mine["windows"].to_numpy() for name, mine in of.items()}
        for size in SIZES:
            studies = [slice(i, i + size) for i in range(0, size * STUDIES, size)]
            studies = [one for one in studies if one.stop <= len(rates["LOC"])]
            for name in POLICIES:
                shown = [(rates[name][one], int(windows[name][one].sum())) for one in studies]
                mean = rates[name].mean()
                intervals = [share_interval(row, windows=count) for row, count in shown]
                limits = np.array([share_limits(row, windows=count)[1] for row, count in shown])
                kept = (limits >= mean).mean()
                row = f"{100 * mean:.2f} % | {100 * holding(intervals, mean):.1f} %"
                row += f" | {100 * kept:.1f} %"
                yield f"| {scenario} | {name} | {size} | {row} | {_costs(costs[name], studies)} |"
            for pair in combinations(POLICIES, 2):
                first, second = (rates[name] for name in pair)
                fewest = np.minimum(*(windows[name] for name in pair))
                mean = (first - second).mean()
                intervals = [
                    share_difference_interval(
                        first[one], second[one], windows=int(fewest[one].sum())
                    )
                    for one in studies
                ]
                row = f"{100 * mean:.2f} % | {100 * holding(intervals, mean):.1f} % | "
                more = _costs(np.subtract(*(costs[name] for name in pair)), studies)
                yield f"| {scenario} | {' − '.join(pair)} | {size} | {row} | {more} |"


def _costs(values: Floats, studies: list[slice]) -> str:
    """Mean, and share of the studies whose interval holds it."""
    mean = values.mean()
    intervals = [mean_interval(values[one]) for one in studies]
    return f"{mean:.3f} | {100 * holding(intervals, mean):.1f} %"


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.coverage", description=__doc__)
    parser.add_argument("--seeds", type=int, default=STUDIES * max(SIZES))
    parser.add_argument("--processes", type=int, default=None)
    asked = parser.parse_args()
    print(measured_on(), end="\n\n", flush=True)
    print("\n".join(of_populations()), end="\n\n", flush=True)
    played = compare(
        dwell.load("examples/canonical.yaml"),
        scenarios=SCENARIOS,
        policies=POLICIES,
        seeds=range(1, asked.seeds + 1),
        windows=WARMUP + WINDOWS,
        processes=asked.processes,
    )
    print("\n".join(of_the_cell(played.runs)))


if __name__ == "__main__":
    main()
