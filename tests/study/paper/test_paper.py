"""All chapters: their order, and that one which fails keeps no other from being written."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import RunError, SimulationError
from dwell.study.paper import CHAPTERS, paper_problem, paper_study
from dwell.study.paper.cell import (
    DYNAMIC,
    STEADY,
    by_length,
    dynamic_scenarios,
    steady_scenarios,
)
from dwell.study.paper.paper import chapter_of
from tests.study.paper.small_cell import SCALE, make_cell

ROOT = Path(__file__).parents[3]


def test_the_cell_has_every_scenario() -> None:
    problem = paper_problem(ROOT / "examples")
    assert steady_scenarios(problem) == STEADY
    assert dynamic_scenarios(problem) == DYNAMIC
    assert tuple(problem.candidates) == ("LOC", "SO", "HYB")


def test_scenarios_with_a_timetable_have_runs_of_their_own() -> None:
    problem = make_cell("step", "flapping")
    assert by_length(problem, ("baseline", "step", "flapping", "drift"), 10, 300) == [
        ("", ("baseline", "flapping"), 10),
        ("-timetable", ("step",), 300),
    ]
    assert by_length(problem, ("drift",), 10, 300) == []


def test_a_chapter_that_fails_keeps_no_other_from_being_written(tmp_path: Path) -> None:
    mine = tmp_path / "runs" / "table"
    mine.mkdir(parents=True)
    (mine / "notes.txt").write_text("mine", encoding="utf-8")
    told: list[str] = []
    paper = paper_study(
        make_cell(),
        folder=tmp_path,
        scale=SCALE,
        processes=1,
        only=("jitter", "table"),
        done=lambda chapter: told.append(chapter.slug),
    )
    assert [chapter.slug for chapter in paper.chapters] == told == ["jitter"]
    assert list(paper.failures) == ["table"]
    assert isinstance(paper.failures["table"], RunError)
    assert (tmp_path / "runs" / "jitter" / "runs.parquet").is_file()


@pytest.mark.parametrize("only", [("tables",), ()])
def test_a_chapter_that_there_is_not_is_refused(tmp_path: Path, only: tuple[str, ...]) -> None:
    with pytest.raises(SimulationError, match="the chapters are table, "):
        paper_study(make_cell(), folder=tmp_path, scale=SCALE, only=only)


@pytest.mark.parametrize("name", CHAPTERS)
def test_every_chapter_is_there(name: str) -> None:
    assert callable(chapter_of(name))
