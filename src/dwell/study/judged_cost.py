"""Judged cost: what a run came to by the J of a problem that may not be its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dwell.cost import hamming, price
from dwell.model import Problem
from dwell.model.number_arrays import Floats
from dwell.record import Names
from dwell.study.reference import tier_use

if TYPE_CHECKING:
    from dwell.record import Run


def judged_cost(run: Run, problem: Problem) -> float:
    """Mean J after the warm-up by a problem's objective.

    Parameters
    ----------
    run : Run
        A run of this problem, or of one with another controller and objective.

    Returns
    -------
    float
        Without unit; NaN where the controller saw no window.
    """
    windows = run.arrays("windows")
    counted = ~windows["warmup"] & ~np.isnan(windows["cost"])
    costs = judged_costs(run, problem)[counted]
    return float(costs.mean()) if len(costs) else float("nan")


def judged_costs(run: Run, problem: Problem) -> Floats:
    """J of every window by a problem's objective, with the switching terms of moves in it.

    Parameters
    ----------
    run, problem
        See `judged_cost`.

    Returns
    -------
    float64 array, shape (windows,)
        NaN where the controller did not see the window.
    """
    windows = run.arrays("windows")
    if problem.decide_cycles < problem.window_cycles:
        moved = _moves(run.arrays("cycles").names("placement"), problem)
        first, width = windows["first_cycle"], problem.window_cycles
        switching = np.array([moved[at : at + width].sum() for at in first.tolist()])
    else:
        switching = _moves(windows.names("placement"), problem)
    l95_ms, rate = windows["seen_l95_ms"], windows["seen_violation_rate"]
    return price(l95_ms, rate, *tier_use(windows, problem), switching, problem.objective)


def _moves(placed: Names, problem: Problem) -> Floats:
    """S of each placement after the one before it; 0 of the first."""
    known = [problem.candidates[name] for name in placed.known]
    moved = np.array([[hamming(now, then) for now in known] for then in known])
    places = placed.places
    return np.concatenate((np.zeros(min(len(places), 1)), moved[places[:-1], places[1:]]))
