"""`dwell study paper`: a line a chapter, verdicts for programs, and how it fails."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from dwell.cli.commands import app
from dwell.cli.paper import Request, chapter_line
from dwell.model.document import to_document
from dwell.study.paper import Chapter
from tests.study.paper.small_cell import make_cell

STUDY = """\
dwell-study: 1
name: dynamic
cell: ../canonical.yaml
scenarios:
  step: [{node: R1, at_s: 1, for_s: 2, stress_threads: 4}]
policies: [LOC]
"""


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of examples whose cell takes no time."""
    folder = tmp_path_factory.mktemp("examples")
    (folder / "studies").mkdir()
    document = to_document(make_cell())
    (folder / "canonical.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    (folder / "studies" / "dynamic.yaml").write_text(STUDY, encoding="utf-8")
    return folder


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["study", "paper", *map(str, arguments)])


def small(examples: Path, out: Path) -> tuple[str | Path, ...]:
    return (
        *("--examples", examples, "--out", out, "--chapter", "table"),
        *("--seeds", "2", "--windows", "12", "--processes", "1"),
    )


def test_verdicts_for_programs_and_the_report(examples: Path, tmp_path: Path) -> None:
    result = call(*small(examples, tmp_path / "out"), "--json")
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    (chapter,) = said["chapters"]
    assert chapter["chapter"] == "table"
    assert chapter["answer"] in ("yes", "no", "in part", "not shown", "none asked")
    assert chapter["verdict"]
    assert said["folder"] == str(tmp_path / "out")
    assert said["failures"] == {}
    assert said["report"] == str(tmp_path / "out" / "report.html")
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert chapter["title"].replace("'", "&#x27;") in page or chapter["title"] in page
    assert (tmp_path / "out" / "runs" / "table" / "runs.parquet").is_file()


def test_a_chapter_that_fails_is_said_and_the_exit_code_too(examples: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out" / "runs" / "table"
    folder.mkdir(parents=True)
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    result = call(*small(examples, tmp_path / "out"))
    assert result.exit_code == 1
    assert "error: chapter table: " in result.stderr
    assert "is no study" in result.stderr


def test_an_unknown_chapter(examples: Path, tmp_path: Path) -> None:
    result = call("--examples", examples, "--out", tmp_path / "out", "--chapter", "tables")
    assert result.exit_code == 2
    assert "there is no chapter 'tables'" in result.stderr


def test_the_chapter_of_measurements_needs_them(examples: Path, tmp_path: Path) -> None:
    result = call("--examples", examples, "--out", tmp_path / "out", "--chapter", "real")
    assert result.exit_code == 2
    assert "--real FOLDER" in result.stderr


def test_options_of_the_paper_are_refused_elsewhere(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["study", str(tmp_path / "study.yaml"), "--quick"])
    assert result.exit_code == 2
    assert "dwell study paper" in result.stderr


def test_a_look_has_a_folder_of_its_own() -> None:
    full, quick = (
        Request(
            quick=quick,
            out=None,
            processes=None,
            dask=None,
            seeds=5,
            windows=40,
            chapters=(),
            real=None,
            examples=None,
        )
        for quick in (False, True)
    )
    assert full.folder != quick.folder
    assert full.scale.seeds == quick.scale.seeds == 5
    assert full.scale.windows == full.scale.dynamic_windows == 40
    assert full.scale.sobol_n > quick.scale.sobol_n


@pytest.mark.parametrize(("answer", "line"), [("no", "Why? No. So."), ("none asked", "Why? So.")])
def test_the_line_of_a_chapter(answer: str, line: str) -> None:
    chapter = Chapter(slug="x", title="Why?", design="", answer=answer, verdict="So.")  # type: ignore[arg-type]
    assert chapter_line(chapter) == line
