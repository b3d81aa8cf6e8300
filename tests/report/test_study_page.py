"""The report of a study, from its folder, and the command that writes it."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

from dwell.cellfile.study_paths import with_settings
from dwell.cli.commands import app
from dwell.errors import RunError
from dwell.report import study_html
from dwell.report.study_page import study_page
from dwell.study import Contender, Point, Study, open_study, run_study
from tests.cells.small import make_problem
from tests.report.pages import Page, table_of

DWELL, LATE = "controller.min_dwell", "controller.min_improvement"


def study(points: tuple[Point, ...]) -> Study:
    return Study(
        name="two by two",
        points=points,
        scenarios=("baseline", "robot-cpu-stress"),
        contenders=(Contender("SO", "SO"), Contender("dtp", "dtp")),
        seeds=(1, 2, 3),
        windows=8,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    points = tuple(
        Point(values, with_settings(make_problem(), values))
        for values in ({DWELL: n, LATE: late} for n in (1, 4) for late in (0.01, 0.2))
    )
    there = tmp_path_factory.mktemp("study") / "there"
    run_study(study(points), folder=there, processes=1)
    return there


def test_a_measure_is_pivoted_over_any_parameter(folder: Path) -> None:
    saved = open_study(folder)
    page = study_page(saved)
    assert [section.title for section in page.sections][:4] == [
        f"By {DWELL}", f"More by {DWELL}", f"By {LATE}", f"More by {LATE}"
    ]  # fmt: skip
    rows = table_of(page, "pivot-cost-0").rows
    row = next(one for one in rows if (one["scenario"], one["policy"]) == ("baseline", "dtp"))
    mine = saved.runs.filter(pl.col(f"parameter.{DWELL}") == 4, scenario="baseline", policy="dtp")
    # Means over the other parameter, seed by seed, and then over the seeds.
    by_seed = mine.group_by("seed", maintain_order=True).agg(pl.col("cost").mean())
    assert row["4"] == pytest.approx(by_seed["cost"].mean())
    curve = next(one for one in page.figures if one.slug == "cost-0").frames["rows"]
    assert set(curve["at"]) == {1, 4}
    assert len(table_of(page, "points").rows) == 4 * 2 * 2


def test_the_page_is_whole(folder: Path) -> None:
    page = Page(study_html(open_study(folder), static=True))
    assert page.outside == []
    assert len(page.ids) == len(set(page.ids))
    assert "How it was made" in page.headings


def test_a_study_of_one_point_is_shown_by_policy(tmp_path: Path) -> None:
    run_study(study((Point({}, make_problem()),)), folder=tmp_path / "one", processes=1)
    page = study_page(open_study(tmp_path / "one"))
    assert next(page.figures).slug == "violation_rate"
    assert len(table_of(page, "results").rows) == 4
    assert tuple(page.seeds) == (1, 2, 3)


def test_report_writes_the_page_and_files_for_a_paper(folder: Path, tmp_path: Path) -> None:
    page, figures = tmp_path / "page.html", tmp_path / "figures"
    asked = ["report", str(folder), "--out", str(page), "--figures", str(figures), "--json"]
    done = CliRunner().invoke(app, [*asked, "--static"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {"report": str(page), "figures": str(figures)}
    assert "<script" not in page.read_text()
    assert (figures / "cost-0.pdf").read_bytes().startswith(b"%PDF")
    for end in ("svg", "csv"):
        assert (figures / f"cost-0.{end}").stat().st_size
    assert "\\toprule" in (figures / "pivot-cost-0.tex").read_text()


def test_what_cannot_be_reported_is_said(folder: Path, tmp_path: Path) -> None:
    def said(*words: str) -> str:
        done = CliRunner().invoke(app, ["report", *words])
        assert done.exit_code == 2
        return done.stderr

    assert "is a study" in said(str(folder), "--trace", str(tmp_path / "t.json"))
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    (unfinished / "study.json").write_text((folder / "study.json").read_text())
    assert "not finished" in said(str(unfinished))
    (unfinished / "study.json").write_text("{}")
    assert "study.json: cannot be read" in said(str(unfinished))
    with pytest.raises(RunError, match="is no study"):
        open_study(tmp_path)
