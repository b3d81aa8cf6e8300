"""Folders of runs that an earlier commit wrote, and what it read from them.

`python -m tests.regression old-runs` writes them again; a new version of run folders needs that.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import polars as pl

import dwell
from dwell.record.journal import JOURNAL
from dwell_lab.testbed.campaign import Campaign, entrant
from dwell_lab.testbed.execution import run_campaign
from dwell_lab.validation.validation import validate
from lab.tests.testbed.simulated_runs import ALWAYS_IDLE, SimulatedRuns
from tests.cells.light import write_cell
from tests.cells.small import make_problem

FOLDER = Path(__file__).parent / "data" / "old-runs"
EXPECTED = FOLDER / "facts.json"
VALIDATED = ("simulated", "campaign/runs/0001-baseline-LOC")
EXAMPLE = Path(__file__).parents[2] / "examples" / "canonical.yaml"


def facts(folder: Path) -> dict[str, Any]:
    """Return the sums of all columns of integers and truth values, the rows, and what was decided.

    Parameters
    ----------
    folder : Path
        Of a run, sealed or with a journal only.
    """
    run = dwell.open_run(folder)
    found: dict[str, Any] = {}
    for name in ("cycles", "windows", "decisions"):
        table: pl.DataFrame = getattr(run, name)
        counted = [
            column
            for column, kind in table.schema.items()
            if kind.is_integer() or kind == pl.Boolean
        ]
        found[name] = {"rows": table.height, **{one: table[one].sum() for one in counted}}
    found["decided"] = run.decisions.select("placement", "reason").cast(pl.String).rows()
    rates = run.windows["violation_rate"].fill_nan(None)
    found["violation_rate"] = round(float(rates.drop_nulls().sum()), 9)
    return found


def measured(folder: Path) -> dict[str, float]:
    """Return what a run shows, as `validate` finds it."""
    run = dwell.open_run(folder)
    table = validate([run], run.problem, seeds=2).table
    found: dict[str, float] = dict(table.select("metric", "measured").iter_rows())
    return found


def write() -> None:
    """Write the folders, and what they say."""
    shutil.rmtree(FOLDER)
    dwell.simulate(
        dwell.load(EXAMPLE), scenario="network-impairment", seed=1, windows=12, jobs=True
    ).save(FOLDER / "simulated")
    _write_live()
    _write_campaign(FOLDER / "campaign")
    found = {
        str(file.parent.relative_to(FOLDER)): facts(file.parent)
        for name in ("run.json", JOURNAL)
        for file in sorted(FOLDER.rglob(name))
    }
    for name in VALIDATED:
        found[name]["measured"] = measured(FOLDER / name)
    EXPECTED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def _write_live() -> None:
    """Run a light cell; its journal is copied on the way."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        cell = write_cell(Path(name))
        command: list[str | Path] = [
            sys.executable,
            "-m",
            "dwell",
            "live",
            "run",
            cell,
            "--seconds",
            "12",
        ]
        with subprocess.Popen([*command, "--out", out, "--policy", "LOC"]) as process:
            journal = None
            while process.poll() is None and (journal is None or journal.stat().st_size < 25_000):
                time.sleep(0.1)
                journal = next(out.glob(f"runs/*/{JOURNAL}"), None)
            assert journal is not None
            (FOLDER / "live-journal").mkdir()
            shutil.copy(journal, FOLDER / "live-journal")
        shutil.copytree(journal.parent, FOLDER / "live-sealed")


def _write_campaign(folder: Path) -> None:
    """Begin a campaign of two runs, and interrupt it after the first."""
    problem = make_problem()
    entrants = tuple(entrant(problem, name) for name in ("LOC", "dtp"))
    campaign = Campaign(problem, ("baseline",), entrants, 1, seconds=3.0)
    play = SimulatedRuns(lambda names: "stop" if len(names) == 2 else "")
    with suppress(KeyboardInterrupt):
        run_campaign(campaign, folder, play, tell=lambda line: None, wait=ALWAYS_IDLE)
    shutil.rmtree(folder / ".work")
