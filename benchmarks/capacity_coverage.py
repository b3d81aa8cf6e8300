"""How often capacity's interval holds the true number: `python -m benchmarks.capacity_coverage`.

Four cells of constant 1 ms jobs, P 10 ms, at random phases, whose V_D by size is known: on the
first core that is free, in order of arrival. The worst cell's V_D over phases is from many draws of
a recursion of the waiting times, apart from the simulator. Studies are disjoint: no seed is used
twice. 200 studies of four cells take some hours; `--studies 20` for a look.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from dwell.study.capacity import DRAWS, capacity_of
from tests.cells.fleets import BESIDE_MS, fleet_of, one_job

STUDIES, TRUTHS, MOST = 200, 20_000, 40
PERIOD_MS, WORK_MS, LIMIT = 10.0, 1.0, 0.05


class Known(NamedTuple):
    """A cell whose capacity is known.

    Parameters
    ----------
    name : str
    deadline_ms : float
        From the arrival at the shared node.
    cores : int
        Of the shared node, under FIFO.
    """

    name: str
    deadline_ms: float
    cores: int


CELLS = (
    Known("one core, D 4", 4.0, 1),
    Known("one core, D 2.5", 2.5, 1),
    Known("one core, D 6", 6.0, 1),
    Known("two cores, D 3", 3.0, 2),
)


def true_capacity(known: Known) -> int:
    """Return the capacity by the recursion of the waiting times."""
    rng = np.random.default_rng(1)
    for size in range(1, MOST + 1):
        if worst_rate(known, size, rng) > LIMIT:
            return size - 1
    return MOST


def worst_rate(known: Known, size: int, rng: np.random.Generator) -> float:
    """Return the worst cell's V_D, in the mean over draws of phases.

    Work is constant and the load at most 1, so that all periods but the first are equal: a cell
    misses all of its deadlines or none, and the worst cell's V_D is 0 or 1.
    """
    if size * WORK_MS > known.cores * PERIOD_MS:
        return 1.0
    missed = np.zeros(TRUTHS, bool)
    phases = np.sort(rng.random((TRUTHS, size)) * PERIOD_MS, axis=1)
    free = np.zeros((TRUTHS, known.cores))
    for period in range(4):
        for i in range(size):
            arrival = phases[:, i] + period * PERIOD_MS
            core = free.argmin(axis=1)
            end = np.maximum(arrival, free[np.arange(TRUTHS), core]) + WORK_MS
            free[np.arange(TRUTHS), core] = end
            if period == 3:
                missed |= end - arrival > known.deadline_ms + 1e-9
    return float(missed.mean())


def studies(known: Known, count: int) -> Iterator[tuple[int, int, int]]:
    """Yield robots and interval of disjoint studies."""
    cell = one_job(
        WORK_MS,
        name="known",
        period_ms=PERIOD_MS,
        deadline_ms=known.deadline_ms + 2 * BESIDE_MS,
        cores=known.cores,
    )
    fleet = fleet_of((cell, 1), phases="random")
    for i in range(count):
        seeds = range(1 + i * len(DRAWS), 1 + (i + 1) * len(DRAWS))
        found = capacity_of(fleet, policy="OFF", most=20, seeds=seeds, processes=1)
        yield (found.robots, *found.interval)


def main() -> None:
    """Print a row for each cell."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.capacity_coverage")
    parser.add_argument("--studies", type=int, default=STUDIES)
    count = parser.parse_args().studies
    least = 0.93 - 2 * math.sqrt(0.93 * 0.07 / count)
    print(f"goals: coverage at least {100 * least:.1f} %, median width at most 2 robots\n")
    print("| cell | true capacity | holds it | median width | answers |\n|---|---|---|---|---|")
    for known in CELLS:
        truth = true_capacity(known)
        robots, low, high = np.array([*studies(known, count)]).T
        holds = ((low <= truth) & (truth <= high)).mean()
        print(
            f"| {known.name} | {truth} | {100 * holds:.1f} % | {np.median(high - low):g} | "
            f"{robots.min()} to {robots.max()} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
