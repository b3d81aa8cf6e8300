"""Summary of a fleet's run: its numbers, and its row in the table of a study."""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from dwell.model.fleet import Fleet
from dwell.record import FleetRun
from dwell.record.moves import moves
from dwell.study.family import EQUAL
from dwell.study.judged_cost import judged_cost
from dwell.study.summary import Summary, summarise
from dwell.study.verdict import verdict_of

#: Columns with sums over cells.
TOTALS = ("migrations", "guard_moves")


def summarise_fleet(run: FleetRun, judged: Fleet, labels: Mapping[str, str | int]) -> Summary:
    """Return the summary of a fleet's run: its worst cell, and the mean cost of all cells.

    Parameters
    ----------
    judged : Fleet
        Fleet whose objectives judge the costs.
    labels : mapping
        Leading columns of the row: scenario, policy, seed.

    Returns
    -------
    Summary
        Summary of the first cell with the largest V_D, with these columns for all cells: means
        ``cost`` and ``mean_violation_rate``; sums ``migrations`` and ``guard_moves``; ``cells``;
        ``worst_cell``, the name of that cell; digests of the runs.

    Raises
    ------
    SimulationError
        If a run has no window after its warm-up.
    """
    problems = judged.problems
    found = {name: summarise(one, problems[name], labels) for name, one in run.cells.items()}
    rates = {name: float(one.row["violation_rate"]) for name, one in found.items()}
    worst = max(rates, key=lambda name: rates[name])
    costs = [judged_cost(one, problems[name]) for name, one in run.cells.items()]
    row = {
        **found[worst].row,
        "cost": sum(costs) / len(costs),
        **{name: sum(int(one.row[name]) for one in found.values()) for name in TOTALS},
        **{name: _digest([one.row[name] for one in found.values()]) for name in EQUAL.values()},
        "cells": len(rates),
        "worst_cell": worst,
        "mean_violation_rate": sum(rates.values()) / len(rates),
    }
    return Summary(row, found[worst].costs, found[worst].within)


def _digest(digests: Iterable[object]) -> str:
    return hashlib.sha256("".join(map(str, digests)).encode()).hexdigest()[:16]


def fleet_numbers(run: FleetRun) -> dict[str, Any]:
    """Return the numbers of a fleet's run: its cells, shared nodes and moves.

    Returns
    -------
    dict
        ``cells``: means over the windows after the warm-up, number of moves and the word of the
        verdict (`dwell.study.verdict`) per cell, the worst cell first; ``cost``, the mean over
        cells; ``load`` by shared resource; ``moves``, ``guard_moves``; ``refused``, the number of
        refusals by the first word of the reason; ``rounds``, each with Φ before and after it and
        the cells that moved.
    """
    import polars as pl

    windows = run.windows.filter(~pl.col("warmup"))
    means = windows.group_by("cell").agg(
        pl.col("violation_rate", "seen_l95_ms", "cost").mean(),
    )
    moved, cell = moves(run), run.decisions["cell"]
    by_cell = Counter(cell[move.row] for move in moved)
    by_guard = sum(move.by_guard for move in moved)
    cells = [
        {
            "cell": row["cell"],
            "violation_rate": row["violation_rate"],
            "verdict": _word(run, row["cell"], row["violation_rate"]),
            "l95_ms": _known(row["seen_l95_ms"]),
            "cost": _known(row["cost"]),
            "moves": by_cell[row["cell"]],
        }
        for row in means.sort("violation_rate", "cell", descending=[True, False]).to_dicts()
    ]
    load = {
        name.removeprefix("u_"): {"mean": values.mean(), "most": values.max()}
        for name, values in run.load.to_dict().items()
        if name.startswith("u_") and len(values)
    }
    refused = Counter[str]()
    for (_, reason), count in refusals(run).items():
        refused[re.split(r"\W", reason, maxsplit=1)[0]] += count
    return {
        "cells": cells,
        "cost": _known(means["cost"].mean()),
        "load": load,
        "moves": len(moved),
        "guard_moves": by_guard,
        "refused": dict(refused),
        "rounds": _rounds(run),
    }


def refusals(run: FleetRun) -> Counter[tuple[str, str]]:
    """Return the number of refused moves, by candidate and reason without its amount."""
    if "refused" not in run.decisions.columns:
        return Counter()
    return Counter(_refusal(text) for text in run.decisions["refused"].drop_nulls())


def _refusal(text: str) -> tuple[str, str]:
    # ``SO: ledger: Φ would fall by 0.02, 0.1 is owed``, ``SO: cap of canonical-07``
    candidate, _, reason = text.partition(": ")
    reason = re.sub(r"by \S+, \S+ is owed$", "by less than is owed", reason)
    return candidate, re.sub(r"( by|:) [\d.e+-]+$", "", reason)


def _known(mean: object) -> float:
    """Return a mean; NaN if the controller saw no window."""
    return mean if isinstance(mean, float) else math.nan


def _word(run: FleetRun, cell: str, rate: float) -> str:
    return verdict_of(run.cells[cell], run.fleet.problems[cell], rate, run.fleet.aim).word


def _rounds(run: FleetRun) -> list[dict[str, Any]]:
    """Return Φ before and after every round with a request to the ledger, and the moved cells."""
    import polars as pl

    asked = run.decisions.filter(pl.col("phi_before").is_not_null())
    rounds = asked.group_by("round", maintain_order=True).agg(
        pl.col("phi_before").first(),
        pl.col("phi_after").last(),
        pl.col("cell").filter(pl.col("migrated")).alias("moved"),
    )
    return rounds.sort("round").to_dicts()
