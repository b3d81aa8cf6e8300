"""Recorded traces: every cell, for as long as its recordings last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dwell.errors import SimulationError
from dwell.model import Problem, Trace, TraceTable
from dwell.study.paper import Runner
from dwell.study.paper.contenders import PAPERS_DTP
from dwell.study.paper.real import DTP, chapter, real_study, verdict
from dwell.study.paper.variants import with_candidates
from tests.study.paper.families import make_family
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import check_written, told


def recorded(name: str, *, rows: int = 4000, wrap: bool = True) -> Problem:
    """Return the small cell with a recorded scale in the place of a drawn one."""
    problem = make_cell("robot-cpu-stress")
    values = 1.0 + 0.2 * np.sin(np.arange(rows) / 7)
    table = TraceTable(f"{name}.parquet", {"scene": values}, wrap=wrap)
    pipeline = replace(problem.pipeline, scales={"scene": Trace(table, "scene")})
    return replace(problem, name=name, pipeline=pipeline)


@pytest.mark.parametrize(
    ("costs", "expected"),
    [
        (["lower", "lower"], "yes"),
        (["lower", "higher"], "in part"),
        (["higher", "open"], "no"),
        (["same", "open"], "not shown"),
    ],
)
def test_the_answer_follows_from_the_cost(costs: Sequence[str], expected: str) -> None:
    pair = f"{DTP}, {PAPERS_DTP}"
    names = ("real: baseline", "real: robot-cpu-stress")
    found = {
        "cost": make_family(
            {f"{name}: {pair}": one for name, one in zip(names, costs, strict=True)}
        ),
        "violation_rate": make_family({f"{name}: {pair}": "open" for name in names}),
    }
    answer, sentence = told(verdict(found, {"LOC": 1, DTP: 2}))
    assert answer == expected
    assert f"costs less in {costs.count('lower')} of 2 replayed scenarios" in sentence
    assert "LOC in 1, dtp+corrected in 2" in sentence


def test_a_short_recording_makes_short_runs() -> None:
    study = real_study(recorded("real-short", rows=80, wrap=False), SCALE)
    assert study.name == "real-short"
    assert 2 < study.windows < SCALE.windows
    assert real_study(recorded("real"), SCALE).windows == SCALE.windows


def test_cells_with_other_candidates_are_refused(tmp_path: Path) -> None:
    runner = Runner(tmp_path, processes=1)
    other = with_candidates(recorded("other"), ("LOC", "SO"))
    with pytest.raises(SimulationError, match="differ in their candidates"):
        chapter([recorded("real"), other], SCALE, runner)
    with pytest.raises(SimulationError, match="problems is empty"):
        chapter([], SCALE, runner)


def test_the_chapter(tmp_path: Path) -> None:
    cells = [recorded("real"), recorded("real-short", rows=80, wrap=False)]
    written = chapter(cells, SCALE, Runner(tmp_path, processes=1))
    check_written(written)
    main = written.tables[0].frame
    assert main.height == 2 * 2 * 7
    assert set(main["scenario"]) == {
        f"{cell}: {scenario}"
        for cell in ("real", "real-short")
        for scenario in ("baseline", "robot-cpu-stress")
    }
    assert set(main["aim"]) <= {"under", "over", "not shown"}
