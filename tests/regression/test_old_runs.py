"""Folders of runs that an earlier commit wrote open, are reported and validated."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dwell.cli.commands import app
from tests.regression.old_runs import EXPECTED, FOLDER, VALIDATED, facts, measured

KNOWN = json.loads(EXPECTED.read_text(encoding="utf-8"))


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
    assert measured(FOLDER / name) == pytest.approx(KNOWN[name]["measured"], rel=1e-7)
