"""The rows behind the demo's figure of deadlines are those that the study plays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dwell.errors import ProblemError
from dwell.study import load_study, run_study, stored_deadlines
from tests.cells.examples import EXAMPLES

STUDY = EXAMPLES / "studies" / "deadline.yaml"


def test_stored_rows_are_those_of_the_study() -> None:
    study = load_study(STUDY)
    rows = stored_deadlines(EXAMPLES)
    assert rows.height == len(study.points) * len(study.scenarios) * len(study.contenders)
    cell = next(
        point
        for point in study.points
        if point.problem.pipeline.period_ms == 33.333333 and 12.5 in point.values.values()
    )
    static = tuple(one for one in study.contenders if one.name == "LOC")
    played = run_study(
        replace(study, points=(cell,), scenarios=("baseline",), contenders=static), processes=1
    )
    kept = rows.filter(scenario="Baseline", policy="LOC", at=33.333333)
    (mine,) = (row for row in kept.to_dicts() if row["panel"].endswith(": 12.5"))
    shown = played.table(["violation_rate"]).row(0, named=True)
    for ours, theirs in (("mean", ""), ("low", "_low"), ("high", "_high")):
        assert mine[ours] == pytest.approx(100 * shown[f"violation_rate{theirs}"], rel=1e-6)


def test_missing_rows_say_what_makes_them(tmp_path: Path) -> None:
    with pytest.raises(ProblemError, match="make deadlines"):
        stored_deadlines(tmp_path)
