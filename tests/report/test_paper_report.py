"""The report of the paper's studies: a page that needs nothing else, and files beside it."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from dwell.errors import SimulationError
from dwell.report import paper_report
from dwell.report.formatting import OURS
from dwell.study.chapter import Chapter, Figure, Table
from dwell.study.paper.running import Scale
from tests.report.pages import Page
from tests.report.paper_chapters import every_kind, main_table, one_of
from tests.study.cell import make_problem

HOSTILE = 'a <b> & "c" </p><script>alert(1)</script>'


@dataclass(frozen=True, slots=True)
class Report:
    """A report as it was written."""

    folder: Path
    html: str
    page: Page


def short(chapter: Chapter, kinds: tuple[str, ...]) -> Chapter:
    """Return a chapter with some of its figures, and little in them."""
    figures = [figure for figure in chapter.figures if figure.kind in kinds]
    few = [
        replace(figure, frame=figure.frame.filter(figure.frame["scenario"].is_in(["baseline"])))
        if "scenario" in figure.frame.columns
        else figure
        for figure in figures
    ]
    return replace(chapter, figures=tuple(few))


def small() -> tuple[Chapter, ...]:
    kinds = (("intervals", "ecdf"), ("timeline",), ("bars",), ("map",))
    return tuple(short(one, some) for one, some in zip(every_kind(), kinds, strict=True))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    folder = tmp_path_factory.mktemp("report") / "paper"
    path = paper_report(
        small(),
        make_problem(),
        folder,
        scale=Scale.tiny(),
        elapsed_s=1021.0,
        failures={"real": SimulationError("no traces here")},
        replayed=(replace(make_problem(), name="robot"),),
    )
    assert path == folder / "report.html"
    html = path.read_text(encoding="utf-8")
    return Report(folder, html, Page(html))


# --------------------------------------------------------------------------------------- page


def test_nothing_is_loaded_from_elsewhere(report: Report) -> None:
    # Links to the files beside it are no part of the page.
    assert all(re.fullmatch(r"a href=(figures|tables)/[\w.-]+", one) for one in report.page.outside)
    assert not re.search(r"https?:|@import|url\((?!#)|javascript", report.html)
    assert "script" not in report.page.tags


def test_every_link_leads_somewhere(report: Report) -> None:
    for one in report.page.outside:
        assert (report.folder / one.removeprefix("a href=")).is_file()
    inner = set(re.findall(r'url\(#([^)]*)\)|href="#([^"]*)"', report.html))
    assert {a or b for a, b in inner} <= set(report.page.ids)
    assert len(set(report.page.ids)) == len(report.page.ids)


def test_every_question_has_its_answer_at_the_top(report: Report) -> None:
    top = report.html[: report.html.index("<h2>")]
    for chapter in small():
        assert f'href="#chapter-{chapter.slug}"' in top
        assert chapter.answer == "none asked" or f">{chapter.answer}</span>" in top
    assert "none asked" not in report.page.text
    assert "The chapter “real” is missing: no traces here" in Page(report.html).text


def test_every_chapter_has_design_verdict_and_findings(report: Report) -> None:
    plain = re.sub(r"\s+", "", report.page.text)
    for chapter in small():
        told = (chapter.title, chapter.design, chapter.verdict)
        for text in (*told, *chapter.evidence, *chapter.findings):
            # Indices are set lower, and what is code in a font of its own.
            assert re.sub(r"[\s_`]", "", text) in plain


def test_it_says_how_it_was_made(report: Report) -> None:
    text = report.page.text
    assert "Cell “small”, simulated" in text
    assert "“robot”, which replay traces" in text
    assert "made in 17 minutes" in text
    assert "2 seeds" in text
    assert "A look, with few seeds" in text
    assert re.search(r"dwell \d+\.\d+", text)


def test_contenders_are_called_alike_and_defined(report: Report) -> None:
    text = report.page.text
    assert "DTP (corrected)" in text
    assert "dtp+corrected" not in text
    for words in ("Algorithm 1", "prices what is not active by a static profile", "REV"):
        assert words in text
    # In its definition, under both figures and over the table that show it.
    assert text.count(OURS) >= 4


def test_statistics_and_limits_are_told(report: Report) -> None:
    for words in ("studentised bootstrap", "Holm", "Sobol", "one-sided 95 % limit", "no bound"):
        assert words in report.page.text


def test_texts_are_text(tmp_path: Path) -> None:
    table = replace(main_table(), title=HOSTILE, note=HOSTILE, headings={"aim": HOSTILE})
    table = replace(table, frame=table.frame.with_columns(aim=pl.lit(HOSTILE)))
    figure = replace(one_of("intervals"), title=HOSTILE, note=HOSTILE, y_label=HOSTILE)
    chapter = Chapter("hostile", HOSTILE, HOSTILE, "no", HOSTILE, (HOSTILE,), (table,), (figure,))
    html = paper_report([chapter], make_problem(), tmp_path).read_text(encoding="utf-8")
    page = Page(html)
    assert "script" not in page.tags
    assert "b" not in page.tags
    assert page.text.count("alert(1)") >= 9
    ElementTree.parse(tmp_path / "figures" / "hostile-violations.svg")


def test_a_report_without_chapters_is_a_page(tmp_path: Path) -> None:
    html = paper_report([], make_problem(), tmp_path).read_text(encoding="utf-8")
    assert "How it was measured" in Page(html).text


def test_the_same_chapters_make_the_same_files(report: Report, tmp_path: Path) -> None:
    chapters = [replace(small()[0], figures=small()[0].figures[:1])]
    paper_report(chapters, make_problem(), tmp_path / "one")
    paper_report(chapters, make_problem(), tmp_path / "two")
    files = sorted(path for path in (tmp_path / "one").rglob("*") if path.is_file())
    assert len(files) == 1 + 2 + 2
    for path in files:
        other = tmp_path / "two" / path.relative_to(tmp_path / "one")
        assert path.read_bytes() == other.read_bytes()


# -------------------------------------------------------------------------------------- files


def test_every_figure_and_table_is_a_file(report: Report) -> None:
    names = sorted(str(path.relative_to(report.folder)) for path in report.folder.rglob("*.*"))
    assert names == [
        "figures/dominance-map.pdf",
        "figures/dominance-map.svg",
        "figures/dynamic-timeline.pdf",
        "figures/dynamic-timeline.svg",
        "figures/table-latencies.pdf",
        "figures/table-latencies.svg",
        "figures/table-violations.pdf",
        "figures/table-violations.svg",
        "figures/weights-sobol.pdf",
        "figures/weights-sobol.svg",
        "report.html",
        "tables/dynamic-differences.csv",
        "tables/dynamic-differences.tex",
        "tables/table.csv",
        "tables/table.tex",
    ]


def test_figures_are_whole_and_not_too_large(report: Report) -> None:
    for path in (report.folder / "figures").iterdir():
        assert path.stat().st_size < 400_000
        if path.suffix == ".svg":
            ElementTree.parse(path)
        else:
            assert path.read_bytes().rstrip().endswith(b"%%EOF")
    assert len(report.html) < 2_000_000


def test_a_figure_of_very_many_marks_is_a_picture(tmp_path: Path) -> None:
    count = 6000
    frame = pl.DataFrame(
        {
            "window": range(count),
            "y": [i % 97 / 97 for i in range(count)],
            "series": ["V_D"] * count,
            "placement": ["LOC"] * count,
        }
    )
    figure = Figure("many", "Many", "timeline", frame, "window", "y", "series")
    chapter = replace(small()[0], figures=(figure,), tables=())
    html = paper_report([chapter], make_problem(), tmp_path).read_text(encoding="utf-8")
    assert 'src="data:image/png;base64,' in html
    assert "http" not in html
    assert len(html) < 400_000


def test_a_csv_is_the_frame(report: Report) -> None:
    for chapter in small():
        for table in chapter.tables:
            name = table.slug if table.slug == chapter.slug else f"{chapter.slug}-{table.slug}"
            found = pl.read_csv(
                report.folder / "tables" / f"{name}.csv", schema_overrides=table.frame.schema
            )
            assert_frame_equal(found, table.frame)


def test_files_of_two_with_one_slug_have_names_of_their_own(tmp_path: Path) -> None:
    table = Table("same", "One", pl.DataFrame({"x": [1]}), {"x": "count"})
    other = replace(table, title="Other", frame=pl.DataFrame({"x": [2]}))
    chapter = replace(small()[0], slug="c", tables=(table, other), figures=())
    paper_report([chapter], make_problem(), tmp_path)
    shown = [path.read_text() for path in (tmp_path / "tables").glob("*.csv")]
    assert sorted(shown) == ["x\n1\n", "x\n2\n"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(SimulationError, match="cannot be written"):
            paper_report([], make_problem(), tmp_path / "out")
    finally:
        tmp_path.chmod(0o700)


def test_a_file_in_the_way_is_an_error_and_nothing_is_left_half(tmp_path: Path) -> None:
    (tmp_path / "tables").write_text("in the way")
    chapter = replace(small()[0], figures=())
    with pytest.raises(SimulationError, match=r"tables.*cannot be written.*finished runs stay"):
        paper_report([chapter], make_problem(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["tables"]
