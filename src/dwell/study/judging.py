"""J of a run by another objective than its controller's.

A contender may weigh in its own way: its controller then minimises one J, and is judged by
another. What a window showed is the same for both.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.cost import hamming, price, tier_nodes
from dwell.model import Problem

if TYPE_CHECKING:
    from dwell.record import Run

__all__ = ["judged_cost", "judged_costs"]

Floats: TypeAlias = NDArray[np.float64]


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
    windows = run.windows
    counted = (~windows["warmup"] & windows["cost"].is_not_null()).to_numpy()
    costs = judged_costs(run, problem)[counted]
    return float(costs.mean()) if len(costs) else float("nan")


def judged_costs(run: Run, problem: Problem) -> Floats:
    """J of every window by a problem's objective, with the switching term of the move to it.

    Parameters
    ----------
    run, problem
        See `judged_cost`.

    Returns
    -------
    float64 array, shape (windows,)
        NaN where the controller did not see the window.
    """
    windows = run.windows
    names = [problem.candidates[name] for name in windows["placement"]]
    moved = [0.0, *(hamming(now, then) for then, now in itertools.pairwise(names))]
    l95_ms, rate = (
        windows[name].fill_null(np.nan).to_numpy()
        for name in ("seen_l95_ms", "seen_violation_rate")
    )
    robot, edge, cloud = (
        np.max([windows[f"u_{node}"].to_numpy() for node in nodes], axis=0, initial=0.0)
        if nodes
        else np.zeros(windows.height)
        for nodes in tier_nodes(problem.objective)
    )
    switching = np.array(moved[: windows.height])
    return price(l95_ms, rate, robot, edge, cloud, switching, problem.objective)
