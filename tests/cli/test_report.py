"""`dwell report` from the command line: what it writes, says and refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

import dwell
from dwell.cli.commands import app
from tests.cells.small import make_problem

RECOVERED = {"sealed": False, "opened": 2, "torn_bytes": 17, "damaged_bytes": 0}


def report(*words: object) -> tuple[int, str, str]:
    """Run the command; returns its exit code and what it printed."""
    done = CliRunner().invoke(app, ["report", *map(str, words)])
    return done.exit_code, done.stdout, done.stderr


def kept(folder: Path, **meta: Any) -> Path:
    """Keep a short run, of which its meta say more."""
    run = dwell.simulate(make_problem(), scenario="baseline", seed=1, windows=6)
    run.save(folder)
    file = folder / "run.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **meta}))
    return folder


def test_it_says_what_was_lost_of_a_run(tmp_path: Path) -> None:
    folder = kept(tmp_path / "run", recovered=RECOVERED)
    code, said, _ = report(folder, "--out", tmp_path / "page.html")
    assert code == 0
    assert "note: The controller was started 2 times while the run went on." in said
    assert "note: 17 bytes at the journal's end were torn by a kill" in said
    assert "note: The run was not closed" in said
    code, said, _ = report(folder, "--out", tmp_path / "page.html", "--json")
    told = json.loads(said)
    assert told["recovered"] == RECOVERED
    assert len(told["lost"]) == 3


def test_of_a_run_that_is_whole_it_says_where_the_page_is(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    code, said, _ = report(kept(tmp_path / "run"), "--out", page, "--static")
    assert (code, said) == (0, f"report: {page}\n")
    assert page.read_text().startswith("<!DOCTYPE html>")


def test_a_trace_wants_jobs(tmp_path: Path) -> None:
    folder, trace = kept(tmp_path / "run"), tmp_path / "trace.json"
    code, _, errors = report(folder, "--out", tmp_path / "page.html", "--trace", trace)
    assert code == 2
    assert "--jobs" in errors
    assert not trace.exists()
