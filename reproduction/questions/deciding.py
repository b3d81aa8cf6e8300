"""RQ5: how fast must one decide: DTP's decisions every 5 cycles up to once a window of 100."""

from __future__ import annotations

from dataclasses import replace

import polars as pl

from dwell.model import Problem
from dwell.study import Point
from reproduction.cell import DYNAMIC, STEADY, by_length
from reproduction.maps import map_of
from reproduction.questions import Run, study_file
from reproduction.scale import Scale
from reproduction.verdicts import Answer, by_policy, claims

TITLE = "RQ5: How fast must one decide?"

#: Differences of V_D that are taken for none, written down before any fresh seed was played.
MARGIN = 0.005
METRICS = ("violation_rate", "cost", "returns")
#: Metrics as panels, with the factor of their unit.
PANELS = {
    "violation_rate": ("V_D, points", 100.0),
    "cost": ("J", 1.0),
    "returns": ("Moves that undo the one before", 1.0),
}


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Compare every interval with a decision a window."""
    point = Point({}, cell)
    plan = replace(study_file("deciding"), points=(point,), seeds=scale.fresh_seeds)
    scenarios = (*STEADY, *DYNAMIC)
    studies = [
        replace(plan, name=f"{plan.name}{suffix}", scenarios=mine, windows=windows)
        for suffix, mine, windows in by_length(scenarios, scale.windows, scale.dynamic_windows)
    ]
    runs = pl.concat([run(study).runs for study in studies])
    *sooner, once = plan.policies
    asked = {"Deciding more often changes a metric": [(one, once) for one in sooner]}
    verdicts = pl.concat(claims(runs, METRICS, scenarios, asked, *studies, margin=MARGIN))
    maps = [
        map_of(
            verdicts.filter(metric=metric),
            lambda row: (PANELS[row["metric"]][0], row["scenario"], row["first"]),
            factor,
        )
        for metric, (_, factor) in PANELS.items()
    ]
    every = by_policy(runs, (*METRICS, "migrations"))
    return Answer(verdicts, {"Every interval in every scenario": every}, pl.concat(maps))
