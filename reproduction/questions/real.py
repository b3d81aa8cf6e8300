"""Cells that replay recorded measurements: what was found in the model, held against them.

The unit is the run: a seed chooses where in the recording replay starts. Runs share rows of it, so
that they are not quite independent: intervals are, if anything, too narrow, and a short recording
is no more than one sample of its radio. Played where the recordings are (`--real FOLDER`).
"""

from __future__ import annotations

from pathlib import Path

import polars as pl

import dwell
from dwell.study import Contender, longest_run
from reproduction.cell import EXAMPLES, PAPERS_DTP, believing, of_cell, rules, statics
from reproduction.questions import Run
from reproduction.scale import Scale
from reproduction.verdicts import Answer, by_policy, claims, under_aim

TITLE = "Do the findings hold where recorded measurements are replayed?"

CELLS = ("real.yaml", "real-5g.yaml")
METRICS = ("violation_rate", "cost", "migrations")
FINDINGS = "The findings hold on recorded traces"


def answer(traces: Path, scale: Scale, run: Run) -> Answer:
    """Play the policies on both cells, for as long as their recordings last."""
    frames, studies = [], []
    for file in CELLS:
        cell = dwell.load(EXAMPLES / file, traces=traces)
        who = (*statics(cell), Contender("atp", "atp"), believing("dtp", "profile"), *rules())
        windows = longest_run(cell, scale.windows)
        name = f"real-{cell.name.removeprefix('real-')}"
        study = of_cell(name, cell, cell.scenarios, who, scale.all_seeds, windows)
        # One frame for both: a scenario is called after its cell, too.
        called = pl.format("{}: {}", pl.lit(cell.name), pl.col("scenario"))
        frames.append(run(study).runs.with_columns(scenario=called))
        studies.append(study)
    runs = pl.concat(frames, how="diagonal")
    dtp, cusum = (one.name for one in rules())
    candidates = [one.name for one in statics(cell)]
    pairs = [(dtp, other) for other in (PAPERS_DTP, "atp", *candidates)]
    pairs += [(cusum, PAPERS_DTP), (cusum, dtp)]
    columns = ("violation_rate", "l95_ms", "u_robot", "cost", "migrations", "aoi_mean_ms")
    main = by_policy(runs, columns)
    scenarios, asked = main["scenario"].unique(maintain_order=True), {FINDINGS: pairs}
    verdicts = [
        under_aim(main, runs, *studies),
        *claims(runs, METRICS, scenarios, asked, *studies),
    ]
    return Answer(pl.concat(verdicts), {"Every policy on the recorded traces": main})
