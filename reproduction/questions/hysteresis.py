"""Dwell and threshold: what they buy in calm, and what they cost in reaction.

Two settings beside them are tried: `escape` (an incumbent over a cap may leave early) and cold
migrations (a moved task waits for its state and its start), which make every move dearer.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import polars as pl

from dwell.model import FrozenDict, Problem
from dwell.study import Contender
from reproduction.cell import believing, by_length, dtp, of_cell
from reproduction.questions import Run
from reproduction.scale import Scale
from reproduction.verdicts import Answer, by_policy, claims

TITLE = "Does hysteresis calm DTP without making it worse?"

DWELLS, FEW_DWELLS = (0, 1, 3, 6, 12), (0, 3, 12)
THRESHOLDS, FEW_THRESHOLDS = (0.0, 0.05, 0.2, 0.8), (0.0, 0.05, 0.8)
#: What is compared to no hysteresis at all: as in the cell, dwell alone, threshold alone, strong.
NONE, SETTINGS = (0, 0.0), ((3, 0.05), (3, 0.0), (0, 0.05), (12, 0.8))

SCENARIOS = ("baseline", "flapping", "bursts", "mixture", "step")
ESCAPES = ("edge-cpu-stress", "network-impairment", "bursts", "mixture", "step")
COLD = ("flapping", "mixture", "step")
#: A process that loads a model, and what it hands over: 0.17 s on a gigabit link.
START_MS, STATE_BYTES = 500.0, 20_000_000

METRICS = ("migrations", "cost", "violation_rate")
MIGRATION = "controller.migration"
COSTS = "A cold migration costs more than a warm one"
#: Policies whose migrations are tried cold.
MOVERS = (
    believing("dtp", "profile"),
    believing("cusum", "corrected"),
    *(dtp(f"dtp+corrected, N_min = {n}", {"controller.min_dwell": n}) for n in (0, 3, 12)),
)


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Vary N_min and Δ_min; try escape and cold migrations."""
    dwells = FEW_DWELLS if scale.coarse else DWELLS
    thresholds = FEW_THRESHOLDS if scale.coarse else THRESHOLDS
    grid = [
        dtp(grid_name(n, least), {"controller.min_dwell": n, "controller.min_improvement": least})
        for n, least in product(dwells, thresholds)
    ]
    escaping = [
        Contender(escape_name(belief, on), "dtp", belief, {"controller.escape": on})
        for belief, on in product(("profile", "corrected"), (False, True))
    ]
    moving = [
        replace(one, name=f"{one.name}, {kind}", settings={**one.settings, MIGRATION: kind})
        for one, kind in product(MOVERS, ("warm", "cold"))
    ]
    calmer = [(grid_name(*one), grid_name(*NONE)) for one in SETTINGS]
    freer = [(escape_name(one, True), escape_name(one, False)) for one in ("profile", "corrected")]
    dearer = [(f"{one.name}, cold", f"{one.name}, warm") for one in MOVERS]
    verdicts, tables = [], {}
    for name, claim, problem, scenarios, who, seeds, pairs in (
        ("", "Hysteresis calms DTP, against none", cell, SCENARIOS, grid, scale.some_seeds, calmer),
        ("-escape", "Escape helps DTP", cell, ESCAPES, escaping, scale.all_seeds, freer),
        ("-cold", COSTS, heavy(cell), COLD, moving, scale.all_seeds, dearer),
    ):
        studies = [
            of_cell(
                f"hysteresis{name}{suffix}", problem, mine, who, seeds, windows, references=True
            )
            for suffix, mine, windows in by_length(scenarios, scale.windows, scale.dynamic_windows)
        ]
        runs = pl.concat([run(study).runs for study in studies])
        verdicts += claims(runs, METRICS, scenarios, {claim: pairs}, *studies)
        columns = ("migrations", "returns", "cost", "regret", "violation_rate", "l95_ms")
        tables[f"{claim}: every setting"] = by_policy(runs, columns)
    return Answer(pl.concat(verdicts), tables)


def grid_name(dwell: int, threshold: float) -> str:
    """Name of a contender of the grid."""
    return f"N_min = {dwell}, Δ_min = {threshold:g}"


def escape_name(estimator: str, on: bool) -> str:
    """Name of a contender with or without escape."""
    return f"dtp+{estimator}, escape {'on' if on else 'off'}"


def heavy(cell: Problem) -> Problem:
    """Return the cell with relocatable tasks that take time to start and have state to move."""
    tasks = {
        name: task if task.anchored else replace(task, start_ms=START_MS, state_bytes=STATE_BYTES)
        for name, task in cell.pipeline.tasks.items()
    }
    return replace(cell, pipeline=replace(cell.pipeline, tasks=FrozenDict(tasks)))
