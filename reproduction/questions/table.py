"""The paper's table: what it predicts for the steady scenarios, beside what is simulated.

The predictions about DTP are held against four adaptive policies, so that it can be seen what a
better estimator, and another rule, change about them.
"""

from __future__ import annotations

from dataclasses import replace

import polars as pl

from dwell.model import Problem
from dwell.study import paper_predictions
from reproduction.cell import PAPERS_DTP
from reproduction.questions import Run, study_file
from reproduction.scale import Scale
from reproduction.verdicts import Answer, by_policy, claims, under_aim

TITLE = "Do the paper's predictions for the steady scenarios hold?"

CORRECTED = "dtp+corrected"
ADAPTIVE = (PAPERS_DTP, CORRECTED, "cusum+corrected", "work-function+corrected")

MAIN = ("violation_rate", "l95_ms", "u_robot", "u_edge", "cost", "migrations", "returns")
ACTUATOR = (
    "longest_misses",
    "misses_in_20",
    "over_5_in_100",
    "aoi_mean_ms",
    "aoi_p95_ms",
    "aoi_peak_ms",
    "tracking_rms_mm",
    "tracking_iae_mm",
)


def answer(cell: Problem, scale: Scale, run: Run) -> Answer:
    """Hold the paper's table against the simulated cell."""
    study = replace(study_file("table"), seeds=scale.all_seeds, windows=scale.windows)
    result = run(study)
    candidates = tuple(cell.candidates)
    pairs = [(PAPERS_DTP, other) for other in candidates]
    pairs += [(CORRECTED, other) for other in (*candidates, PAPERS_DTP)]
    asked = {"DTP against the static placements": pairs}
    main = by_policy(result.runs, [*MAIN, *(f"share_{name}" for name in candidates)])
    verdicts = [
        under_aim(main, result.runs, study),
        *claims(result.runs, ("violation_rate", "cost"), study.scenarios, asked, study),
    ]
    predictions = paper_predictions(result, ADAPTIVE)
    of_policies = pl.col("policy").is_in(ADAPTIVE)
    return Answer(
        pl.concat(verdicts),
        {
            "What the paper predicts of DTP": predictions.filter(of_policies),
            "What the paper says of the static placements": predictions.filter(~of_policies).select(
                "scenario", "policy", "words", "reading", "answer"
            ),
            "Every policy in every steady scenario": main,
            "What the actuator got": by_policy(result.runs, ACTUATOR),
        },
    )
