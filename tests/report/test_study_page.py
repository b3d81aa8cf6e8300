"""The report of a study, from its folder, and the command that writes it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

from dwell.cellfile.study_paths import with_settings
from dwell.cli.commands import app
from dwell.errors import RunError
from dwell.report import study_html
from dwell.report.figure import printed_svg, svg
from dwell.report.figure_files import figure_files, table_tex
from dwell.report.formatting import shown_contender
from dwell.report.page import Definitions
from dwell.report.page import Page as LaidOut
from dwell.report.study_page import study_page
from dwell.study import Contender, Point, Study, open_study, run_study
from tests.cells.small import make_problem
from tests.report.pages import Page, figure_of, silent_on_warmup, table_of

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
    # Nothing is averaged but seeds: the other parameter has a row and a panel for each value.
    late = f"parameter.{LATE}"
    at = {"scenario": "baseline", "policy": "dtp", late: 0.2}
    mine = saved.runs.filter(pl.col(f"parameter.{DWELL}") == 4, **at)
    row = next(one for one in table_of(page, "pivot-cost-0").rows if at.items() <= one.items())
    assert row["4"] == pytest.approx(mine["cost"].mean())
    curve = figure_of(page, "cost-0").frames["rows"]
    assert set(curve["at"]) == {1, 4}
    point = curve.filter(at=4, policy="DTP", scenario="Baseline", panel=f"{LATE}: 0.2")
    assert point["mean"].to_list() == [pytest.approx(mine["cost"].mean())]
    assert len(table_of(page, "points").rows) == 4 * 2 * 2


def first_slugs(page: LaidOut) -> set[str]:
    """Return the slugs of the figures and tables of the first values, which name their files."""
    slugs = [*(figure.slug for figure in page.figures), *(table.slug for table in page.tables)]
    return {slug for slug in slugs if slug.endswith("-0")}


def test_a_table_and_a_figure_say_what_they_average_over(folder: Path) -> None:
    """Of three parameters, the third: in the page, in LaTeX, in CSV and on paper."""
    saved = open_study(folder)
    third = "parameter.window_cycles"
    wider = saved.runs.with_columns(pl.lit(50).alias(third), violation_rate=pl.lit(0.0))
    runs = pl.concat([saved.runs.with_columns(pl.lit(20).alias(third)), wider], how="diagonal")
    three = replace(saved, runs=runs, labels={"window_cycles": "W"})
    page = study_page(three)
    assert Definitions({"averaged over": "W"}) in page.sections[0].blocks
    first = replace(page, sections=page.sections[:1])
    files = {name: data for name, data in figure_files(first) if name.endswith("-0.csv")}
    assert "averaged_over" in str(files["violation_rate-0.csv"])
    assert "averaged_over" in str(files["pivot-violation_rate-0.csv"])
    assert "averaged over" in table_tex(table_of(page, "pivot-violation_rate-0"))
    assert "averaged over W" in printed_svg(figure_of(page, "violation_rate-0"))
    at = {"scenario": "baseline", "policy": "dtp", f"parameter.{LATE}": 0.2}
    mine = saved.runs.filter(pl.col(f"parameter.{DWELL}") == 4, **at)
    rows = table_of(page, "pivot-violation_rate-0").rows
    row = next(one for one in rows if at.items() <= one.items())
    # Seed by seed, and then over the seeds.
    assert row["4"] == pytest.approx(mine["violation_rate"].to_numpy().mean() / 2)
    of_two = study_page(saved)
    assert first_slugs(of_two) == first_slugs(page)
    assert {name.removesuffix(".csv") for name in files} <= first_slugs(page)
    assert "averaged" not in table_tex(table_of(of_two, "pivot-violation_rate-0"))


def test_parameters_that_go_together_are_one_axis_with_its_label(tmp_path: Path) -> None:
    points = tuple(
        Point({"period_ms": period_ms, DWELL: n}, with_settings(make_problem(), {DWELL: n}))
        for period_ms, n in ((40, 1), (50, 4))
    )
    labelled = replace(study(points), labels={"period_ms": "P (ms)"})
    run_study(labelled, folder=tmp_path / "one", processes=1)
    page = study_page(open_study(tmp_path / "one"))
    assert [section.title for section in page.sections[:3]] == [
        "By P (ms)",
        "More by P (ms)",
        "The cell and its placements",
    ]
    assert Definitions({"together with it": DWELL}) in page.sections[0].blocks
    assert figure_of(page, "cost-0").frames["rows"]["at"].unique().sort().to_list() == [40, 50]
    assert "panel" not in figure_of(page, "cost-0").frames["rows"].columns
    # Points of several deadlines have no deadline in common.
    assert "deadline" not in str(figure_of(page, "l95_ms-0").spec())


def test_panels_of_two_parameters_are_told_apart(folder: Path) -> None:
    drawn = svg(figure_of(study_page(open_study(folder)), "violation_rate-0"))
    for heading in ("Baseline", "Robot CPU stress", f"{LATE}: 0.01", f"{LATE}: 0.2"):
        assert heading in drawn


def test_every_table_says_whether_the_warm_up_is_in(folder: Path) -> None:
    assert silent_on_warmup(study_page(open_study(folder))) == []


def test_the_page_is_whole(folder: Path) -> None:
    page = Page(study_html(open_study(folder), static=True))
    assert page.outside == []
    assert len(page.ids) == len(set(page.ids))
    assert "Method" in page.headings


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


def test_a_page_shows_the_references(tmp_path: Path) -> None:
    played = replace(study((Point({}, make_problem()),)), references=True)
    saved = run_study(played, folder=tmp_path / "there", processes=1)
    page = study_page(saved)
    rows = table_of(page, "results").rows
    names = ("SO", "dtp", "clairvoyant", "clairvoyant-dwell", "oracle", "oracle-dwell")
    assert [row["policy"] for row in rows] == 2 * [*names]
    frame = figure_of(page, "oracle_regret").frames["rows"]
    means = frame.filter(pl.col("mean").is_not_null(), scenario="Baseline")
    costs = saved.runs.filter(scenario="baseline").pivot("policy", index="seed", values="cost")
    assert dict(means.select("policy", "mean").iter_rows()) == {
        shown_contender(name): pytest.approx(
            100 * (costs[name].to_numpy() / costs["oracle"].to_numpy() - 1).mean()
        )
        for name in names
    }
    method = next(one for one in page.sections if one.title == "Method")
    defined = [one.entries for one in method.blocks if isinstance(one, Definitions)]
    assert any("Oracle" in entries for entries in defined)
