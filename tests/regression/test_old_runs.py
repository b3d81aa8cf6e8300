"""Folders of runs that version 0.1 wrote open, are reported and validated."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import polars as pl
import pytest
from typer.testing import CliRunner

import dwell
from dwell.cli.commands import app
from dwell.study import validate
from tests.regression.old_runs import EXPECTED, FOLDER, facts

KNOWN = json.loads(EXPECTED.read_text(encoding="utf-8"))
VALIDATED = ("simulated", "simulated-atp", "campaign/runs/0001-baseline-LOC")


@pytest.mark.parametrize("name", KNOWN)
def test_a_run_says_what_it_said(name: str) -> None:
    found = json.loads(json.dumps(facts(FOLDER / name)))
    for table in ("cycles", "windows", "decisions"):
        # Columns may have been added.
        known = KNOWN[name][table]
        assert {column: found[table].get(column) for column in known} == known
    for told in ("decided", "violation_rate"):
        assert found[told] == KNOWN[name][told]


@pytest.mark.parametrize("name", [*KNOWN, "campaign"])
def test_a_run_is_reported(name: str, tmp_path: Path) -> None:
    folder = shutil.copytree(FOLDER / name, tmp_path / "run")
    result = CliRunner().invoke(app, ["report", str(folder), "--json"])
    assert result.exit_code == 0, result.output
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") > 1


@pytest.mark.parametrize("name", VALIDATED)
def test_a_run_is_validated(name: str) -> None:
    run = dwell.open_run(FOLDER / name)
    table = validate([run], run.problem, seeds=2).table
    measured = dict(table.select("metric", "measured").iter_rows())
    known = KNOWN[name]["measured"]
    assert {metric: measured[metric] for metric in known} == pytest.approx(known, rel=1e-7)


def test_the_tables_of_a_study_can_be_read() -> None:
    runs = pl.read_parquet(FOLDER / "study" / "runs.parquet")
    assert runs.height == 8
    assert runs["violation_rate"].is_not_null().all()
