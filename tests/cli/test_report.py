"""`dwell report` from the command line: what it writes, says and refuses."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from mcap.reader import make_reader

import dwell
from dwell.study import Contender, Point, Study, run_study
from tests.cells.fleets import fleet_of, one_job
from tests.cells.small import make_problem
from tests.cli.small_cell import assert_refused, call, read_json

#: A measured run that kept no jobs.
LIVE_RUN = Path(__file__).parents[1] / "regression/data/old-runs/live-sealed"
RECOVERED = {"sealed": False, "opened": 2, "torn_bytes": 17, "damaged_bytes": 0}


def kept(folder: Path, **meta: Any) -> Path:
    """Keep a short run, of which its meta say more."""
    run = dwell.simulate(make_problem(), scenario="baseline", seed=1, windows=6)
    run.save(folder)
    file = folder / "run.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **meta}))
    return folder


def studied(folder: Path) -> Path:
    """Run a short study."""
    study = Study(
        name="short",
        points=(Point({}, make_problem()),),
        scenarios=("baseline",),
        contenders=(Contender("SO", "SO"), Contender("LOC", "LOC")),
        seeds=(1, 2),
        windows=6,
    )
    run_study(study, folder=folder, processes=1)
    return folder


def test_it_says_what_was_lost_of_a_run(tmp_path: Path) -> None:
    folder, page = kept(tmp_path / "run", recovered=RECOVERED), tmp_path / "page.html"
    result = call("report", folder, "--out", page)
    assert result.exit_code == 0
    for note in (
        "note: The controller was started 2 times while the run went on.",
        "note: 17 bytes at the journal's end were torn by a kill",
        "note: The run was not closed",
    ):
        assert note in result.stdout
    found = read_json(call("report", folder, "--out", page, "--json"))
    assert found["recovered"] == RECOVERED
    assert len(found["lost"]) == 3


def test_of_a_run_that_is_whole_it_says_where_the_page_is(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    result = call("report", kept(tmp_path / "run"), "--out", page, "--static")
    assert (result.exit_code, result.stdout) == (0, f"report: {page}\n")
    assert page.read_text().startswith("<!DOCTYPE html>")


def test_report_writes_the_page_and_the_trace(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept", "--jobs")
    result = call("report", "kept")
    assert (result.exit_code, result.stdout) == (0, "report: kept/report.html\n")
    assert Path("kept/report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    found = read_json(call("report", "kept", "--out", "r.html", "--trace", "t.json", "--json"))
    assert found == {"report": "r.html", "trace": "t.json"}
    assert Path("r.html").is_file()
    assert json.loads(Path("t.json").read_text(encoding="utf-8"))["traceEvents"]


@pytest.mark.parametrize(
    ("kind", "unwanted"),
    [
        ("run", "'scipy', 'dwell.study.runner', 'dwell.report.study_page'"),
        ("study", "'scipy', 'dwell.report.run_page'"),
    ],
)
def test_a_page_imports_nothing_heavy_that_it_has_no_use_for(
    kind: str, unwanted: str, tmp_path: Path
) -> None:
    folder = kept(tmp_path / "run") if kind == "run" else studied(tmp_path / "study")
    script = (
        "import sys; from dwell.cli import main\n"
        f"try: main(['report', {str(folder)!r}, '--out', {str(tmp_path / 'page.html')!r}])\n"
        f"finally: print(sorted({{{unwanted}}} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_report_of_what_is_not_there(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    assert_refused(call("report", "kept", "--trace", "t.json"), "dwell run --jobs")
    assert {path.name for path in cell.parent.iterdir()} == {"small.yaml", "kept"}
    assert not Path("kept/report.html").exists()
    assert call("report", "nowhere").exit_code == 2
    assert call("report", ".").exit_code == 2


@pytest.mark.parametrize(
    ("table", "change", "words"),
    [
        ("windows", pl.exclude("warmup"), "lacks the column 'warmup'"),
        ("windows", pl.all().cast(pl.String), "has the type String"),
        ("cycles", pl.all().reverse(), "'cycle' does not grow"),
        ("cycles", pl.all().head(3), "has 3 cycles; the windows have"),
        ("cycles", pl.all().head(0), "has 0 cycles; the windows have"),
        ("cycles", (pl.exclude("latency_ns"), pl.col("latency_ns") * -1), "which is negative"),
        ("decisions", (pl.exclude("reason"), pl.lit("x").alias("reason")), "'reason' has 'x'"),
    ],
)
def test_a_broken_run_is_refused_by_the_name_of_its_file(
    tmp_path: Path, table: str, change: pl.Expr | Sequence[pl.Expr], words: str
) -> None:
    folder = kept(tmp_path / "run")
    file = folder / f"{table}.parquet"
    pl.read_parquet(file).select(change).write_parquet(file)
    assert_refused(call("report", folder), f"{file}: ", words)


@pytest.mark.parametrize("text", ["[" * 100_000, "[1]", '{"schema_version": 3, "problem": 1}'])
def test_a_run_with_a_broken_record_is_refused(tmp_path: Path, text: str) -> None:
    folder = kept(tmp_path / "run")
    (folder / "run.json").write_text(text)
    assert_refused(call("report", folder))


def test_a_run_that_ended_in_its_warm_up_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "short"
    dwell.simulate(make_problem(), scenario="baseline", seed=1, windows=1).save(folder)
    refused = f"error: {folder}: none of 1 windows is left after the warm-up; ask for more windows"
    assert_refused(call("report", folder), refused)
    assert not (folder / "report.html").exists()


def test_a_page_that_cannot_be_written_is_a_failure(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    result = call("report", "kept", "--out", "small.yaml/report.html")
    assert result.exit_code == 1
    assert "error: " in result.stderr


def test_report_writes_an_mcap_file_beside_the_page(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    result = call("report", "kept", "--mcap", "new/run.mcap")
    assert result.exit_code == 0
    assert result.stdout == "report: kept/report.html\nmcap: new/run.mcap\n"
    with Path("new/run.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert {one.topic for one in summary.channels.values()} == {
        *("/cycles", "/windows", "/decisions")
    }
    found = read_json(call("report", "kept", "--mcap", "run.mcap", "--json"))
    assert found == {"report": "kept/report.html", "trace": None, "mcap": "run.mcap"}


def test_of_a_measured_run_without_jobs_the_rest_is_written(tmp_path: Path) -> None:
    folder = shutil.copytree(LIVE_RUN, tmp_path / "run")
    words = ("report", folder, "--trace", tmp_path / "t.json", "--mcap", tmp_path / "run.mcap")
    result = call(*words)
    assert (result.exit_code, "note: " in result.stdout) == (0, False)
    assert result.stderr == (
        f"note: no {tmp_path / 't.json'}: this run kept no jobs; "
        "`dwell controller --jobs` keeps them\n"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"run", "run.mcap"}
    assert (folder / "report.html").is_file()
    assert read_json(call(*words, "--json"))["trace"] is None


def test_a_page_of_something_else_is_not_replaced(tmp_path: Path) -> None:
    one, page = kept(tmp_path / "one"), tmp_path / "page.html"
    other = kept(tmp_path / "other", seed=2)
    again = kept(tmp_path / "again")
    for folder in (one, one, again):
        assert call("report", folder, "--out", page, "--static").exit_code == 0
    before = page.read_bytes()
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    for target in (page, notes):
        refused = call("report", other, "--out", target, "--mcap", tmp_path / "x.mcap")
        assert_refused(refused, f"{target} was made from something else; name another place")
    assert (page.read_bytes(), notes.read_text()) == (before, "mine")
    assert not (tmp_path / "x.mcap").exists()
    # A folder's own page is made again, whatever is there.
    (other / "report.html").write_text("older")
    assert call("report", other, "--static").exit_code == 0


def test_without_its_package_no_mcap_file_and_no_page_is_written(
    cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    monkeypatch.delitem(sys.modules, "dwell.record.mcap_file", raising=False)
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    refused = call("report", "kept", "--mcap", "run.mcap")
    assert_refused(refused, "mcap is not installed; pip install 'dwell-placement[mcap]'", code=1)
    assert not Path("run.mcap").exists()
    assert not Path("kept/report.html").exists()


def test_a_disk_that_is_full_leaves_no_half_mcap_file(cell: Path) -> None:
    call("run", cell, "--windows", "12", "--out", "kept")
    Path("run.mcap").write_text("older")
    limited = "import resource as r; r.setrlimit(r.RLIMIT_FSIZE, (1 << 20,) * 2); "
    command = "from dwell.cli import main; main('report kept --static --mcap run.mcap'.split())"
    done = subprocess.run(
        [sys.executable, "-c", limited + command], check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (1, "error: run.mcap: File too large\n")
    assert Path("run.mcap").read_text() == "older"
    assert {path.name for path in Path.cwd().iterdir()} == {"small.yaml", "kept", "run.mcap"}


def test_a_study_is_no_run_of_which_there_is_an_mcap_file(tmp_path: Path) -> None:
    (tmp_path / "study.json").touch()
    assert_refused(call("report", tmp_path, "--mcap", "x.mcap"), "is a study; name one of its runs")


def fleet_in(folder: Path) -> Path:
    """Save the runs of two cells that share an edge."""
    return dwell.simulate_fleet(fleet_of((one_job(), 2)), windows=12, policy="OFF").save(folder)


def test_a_fleet_has_a_page_that_leads_to_those_of_its_cells(tmp_path: Path) -> None:
    folder = fleet_in(tmp_path / "hall")
    page = folder / "report.html"
    result = call("report", folder, "--static")
    assert (result.exit_code, result.stdout) == (0, f"report: {page}\n")
    assert "one-01/report.html" not in page.read_text()
    found = read_json(call("report", folder, "--cells", "--static", "--json"))
    names = ("one-01", "one-02")
    assert found == {
        "report": str(page),
        "cells": {name: str(folder / name / "report.html") for name in names},
    }
    assert all((folder / name / "report.html").is_file() for name in names)
    assert '<a href="one-01/report.html">' in page.read_text()
    call("report", folder, "--out", tmp_path / "new/page.html", "--static")
    assert '<a href="../hall/one-01/report.html">' in (tmp_path / "new/page.html").read_text()


def test_what_a_fleet_has_none_of_is_refused(tmp_path: Path) -> None:
    folder = fleet_in(tmp_path / "hall")
    for option, what in (("--trace", "a trace"), ("--mcap", "an MCAP file")):
        refused = call("report", folder, option, "x")
        assert_refused(refused, f"hall is a fleet; name one of its runs for {what}")
    refused = call("report", folder / "one-01", "--cells")
    assert_refused(refused, "is a run, which has no cells; leave out --cells")


def test_an_interrupted_fleet_says_how_many_runs_are_whole(tmp_path: Path) -> None:
    folder = fleet_in(tmp_path / "hall")
    (folder / "fleet.json").rename(folder / ".fleet.json.unfinished")
    (folder / "one-02/run.json").unlink()
    assert_refused(call("report", folder), "1 of 2 runs are whole")
    assert not (folder / "report.html").exists()
