"""How often the stated errors of `corrected` hold: estimates of random cells against long runs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.random_cells import random_cell
from dwell.estimators import Corrected
from dwell.estimators.evidence import Evidence
from dwell.estimators.prices import prices_of
from dwell.estimators.slow_processes import mean_and_error
from dwell.model import Problem
from dwell.model.qos import QoS

#: Windows at whose closes estimates are compared.
SEEN = (19, 39)
#: Seeds and windows of the runs that tell the truth, after a warm-up of so many.
SEEDS, WINDOWS, WARMUP = (77, 78, 79), 300, 5
#: Standard errors of a 95 % interval.
BAND = 1.96


class SendsOnly(Corrected):
    """Sends the shadow jobs of `corrected`, and learns nothing from them."""

    def learn(self, evidence: Evidence) -> None:
        """Learn nothing."""

    def estimate(
        self, *, observed: QoS, incumbent: str, own: Mapping[str, float]
    ) -> dict[str, QoS]:
        """Estimate by the profile."""
        return {name: price.qos for name, price in prices_of(self.problem).items()}


class Compared(NamedTuple):
    """Whether L95 and V_D of a candidate are within the 95 % interval of an estimate."""

    scenario: str
    is_incumbent: bool
    l95: bool
    violation_rate: bool


def compared(problem: Problem) -> Iterator[Compared]:
    """Yield every estimate of a cell that stays on its first candidate."""
    incumbent = next(iter(problem.candidates))
    for scenario in problem.scenarios:
        decisions = dwell.simulate(
            problem,
            scenario=scenario,
            policy=incumbent,
            estimator="corrected",
            seed=1,
            windows=max(SEEN) + 1,
        ).decisions
        for name in problem.candidates:
            true = true_means(problem, scenario, name)
            for window in SEEN:
                row = decisions.row(window, named=True)
                l95 = row[f"est_l95_ms_{name}"], row[f"est_l95_error_ms_{name}"]
                rate = row[f"est_violation_rate_{name}"], row[f"est_violation_error_{name}"]
                within = [_agree(*pair) for pair in zip((l95, rate), true, strict=True)]
                yield Compared(scenario, name == incumbent, *within)


def _agree(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return abs(one[0] - other[0]) <= BAND * math.hypot(one[1], other[1]) + 1e-9


def true_means(
    problem: Problem, scenario: str, name: str, windows: int = WINDOWS
) -> list[tuple[float, float]]:
    """Return L95 (ms) and V_D of a placement that stays, with their standard errors."""
    runs = [
        dwell.simulate(
            problem,
            scenario=scenario,
            policy=name,
            estimator=SendsOnly(problem),
            seed=seed,
            windows=WARMUP + windows,
        ).windows[WARMUP:]
        for seed in SEEDS
    ]
    found = []
    for column, most in (("seen_l95_ms", problem.censor_ms), ("violation_rate", 1.0)):
        shown = [mean_and_error(np.minimum(run[column].to_numpy(), most)) for run in runs]
        means, errors = map(np.array, zip(*shown, strict=True))
        between = float(means.std(ddof=1))
        error = max(between, float(np.sqrt((errors * errors).mean()))) / math.sqrt(len(runs))
        found.append((float(means.mean()), error))
    return found


def measure(quick: bool) -> Section:
    """Shares of estimates whose 95 % interval holds the mean of long runs."""
    rows = [row for number in range(8 if quick else 20) for row in compared(random_cell(number))]
    figures = []
    for is_incumbent, what in ((False, "alternatives"), (True, "incumbent")):
        mine = [row for row in rows if row.is_incumbent == is_incumbent]
        for title, held in (
            ("L95", [row.l95 for row in mine]),
            ("V_D", [row.violation_rate for row in mine]),
        ):
            goal = Goal(low=92) if title == "L95" and not is_incumbent else None
            share = 100.0 * float(np.mean(held))
            figures.append(Figure(f"{what}: {title} within its interval", [share], "%", goal))
    for scenario in dict.fromkeys(row.scenario for row in rows):
        mine = [row for row in rows if row.scenario == scenario and not row.is_incumbent]
        share = 100.0 * float(np.mean([row.l95 for row in mine]))
        figures.append(Figure(f"alternatives, {scenario}: L95", [share], "%"))
    return Section("Stated errors that hold, on random cells", figures)
