"""Judged cost: J of a run by the objective of a problem, which may differ from the run's own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dwell.cost import hamming, price
from dwell.errors import SimulationError
from dwell.model import Problem
from dwell.model.number_arrays import Floats
from dwell.record import Names
from dwell.study.reference import tier_use

if TYPE_CHECKING:
    from dwell.record import Run


def judged_cost(run: Run, problem: Problem) -> float:
    """Mean J after the warm-up by a problem's objective; NaN if the controller saw no window.

    The problem of the run may have another controller and objective.
    """
    windows = run.arrays("windows")
    counted = ~windows["warmup"] & ~np.isnan(windows["cost"])
    costs = judged_costs(run, problem)[counted]
    return float(costs.mean()) if len(costs) else float("nan")


def judged_costs(run: Run, problem: Problem) -> Floats:
    """J of every window, shape (windows,), by a problem's objective; NaN for unseen windows.

    J includes the switching terms of the moves in a window.
    """
    windows = run.arrays("windows")
    moved = _moves(run.arrays("cycles").names("placement"), problem)
    first, width = windows["first_cycle"], problem.window_cycles
    switching = np.array([moved[at : at + width].sum() for at in first.tolist()])
    problem.objective.require_judgeable(run.problem.objective)
    _require_prices(run, problem)
    l95_ms, rate = windows["seen_l95_ms"], windows["seen_violation_rate"]
    objective = problem.objective
    age_ms = windows["seen_age_ms"] if objective.weighs_age else 0.0
    per_hour = windows["seen_price_per_hour"] if objective.weighs_price else 0.0
    used = tier_use(windows, problem)
    return price(l95_ms, rate, *used, switching, objective, age_ms, per_hour)


def _require_prices(run: Run, problem: Problem) -> None:
    """Raise a SimulationError if J of a problem weighs prices, which the run's links lack."""
    judge = problem.objective
    if judge.weighs_price and not run.problem.fabric.has_prices:
        raise SimulationError(
            f"a run whose links have no price_per_gb has no J with weights.price "
            f"{judge.weights.price:g}; give all policies the same links"
        )


def _moves(placed: Names, problem: Problem) -> Floats:
    """S between each placement and the previous placement; 0 for the first."""
    known = [problem.candidates[name] for name in placed.known]
    moved = np.array([[hamming(now, then) for now in known] for then in known])
    places = placed.places
    return np.concatenate((np.zeros(min(len(places), 1)), moved[places[:-1], places[1:]]))
