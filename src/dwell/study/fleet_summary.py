"""Summary of a fleet's run: the row of its worst cell, and what the others add to it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from dwell.model.fleet import Fleet
from dwell.record import FleetRun
from dwell.study.player import judged_cost
from dwell.study.summary import PLAYED, Summary, summarise

#: Columns that are the sum over cells.
TOTALS = ("migrations", "guard_moves")


def summarise_fleet(run: FleetRun, judged: Fleet, labels: Mapping[str, str | int]) -> Summary:
    """Sum up a fleet's run as the cell that misses most, with the cost of all.

    Parameters
    ----------
    judged : Fleet
        By whose cells' objectives costs are judged.
    labels : mapping
        Leading columns of the row: scenario, policy, seed.

    Returns
    -------
    Summary
        That of the cell with the largest V_D, the first of equal ones, but for these columns:
        ``cost``, the mean over cells; ``migrations`` and ``guard_moves``, those of all cells;
        ``cells``; ``worst_cell``, its name; ``mean_violation_rate``, of all cells.

    Raises
    ------
    SimulationError
        If a run has no window after its warm-up.
    """
    problems = {cell.name: cell.problem for cell in judged.cells}
    found = {name: summarise(one, problems[name], labels) for name, one in run.cells.items()}
    rates = {name: float(one.row["violation_rate"]) for name, one in found.items()}
    worst = max(rates, key=lambda name: rates[name])
    costs = [judged_cost(one, problems[name]) for name, one in run.cells.items()]
    played = "".join(str(one.row[PLAYED]) for one in found.values())
    row = {
        **found[worst].row,
        "cost": sum(costs) / len(costs),
        **{name: sum(int(one.row[name]) for one in found.values()) for name in TOTALS},
        PLAYED: hashlib.sha256(played.encode()).hexdigest()[:16],
        "cells": len(rates),
        "worst_cell": worst,
        "mean_violation_rate": sum(rates.values()) / len(rates),
    }
    return Summary(row, found[worst].costs, found[worst].within)
