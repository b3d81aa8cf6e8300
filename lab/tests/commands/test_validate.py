"""`dwell validate`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import dwell
from dwell.study.predicted_moves import predicted_moves
from tests.cli.small_cell import call, read_json

CALIBRATED = "small.yaml"


@pytest.fixture
def folder(cell: Path) -> Path:
    """Return the current folder, which has a cell and two of its runs."""
    problem = dwell.load(cell)
    for policy in ("LOC", "OFF"):
        dwell.simulate(problem, policy=policy, seed=9, windows=40).save(policy)
    return cell.parent


def test_page_table_and_text(folder: Path) -> None:
    result = call("validate", "LOC", "OFF", "--cell", CALIBRATED, "--seeds", "2", "--out", "out")
    assert result.exit_code == 0, result.output
    assert "2 runs, 0.3 minutes that count, each run simulated 2 times" in result.output
    assert "report: out/report.html" in result.output
    assert (folder / "out" / "report.html").read_text(encoding="utf-8").startswith("<!DOCTYPE")
    told = json.loads((folder / "out" / "validation.json").read_text(encoding="utf-8"))
    assert [group["policy"] for group in told["groups"]] == ["LOC", "OFF"]


def test_json(folder: Path) -> None:
    told = read_json(call("validate", "LOC", "--cell", CALIBRATED, "--seeds", "2", "--json"))
    assert told["report"] == "validations/small/report.html"
    assert (folder / told["report"]).is_file()
    assert set(told["verdicts"]) == {
        "l95_ms",
        "violation_rate",
        "utilisation",
        "dominant",
        "sum_of_means",
    }
    assert told["figures"][0]["metric"] == "l95_ms"
    assert told["moves"] == []


def test_a_validation_of_other_runs_is_not_replaced(folder: Path) -> None:
    words = ("--cell", CALIBRATED, "--seeds", "2")
    assert call("validate", "LOC", *words).exit_code == 0
    kept = {file: file.read_bytes() for file in (folder / "validations/small").iterdir()}
    other = call("validate", "OFF", *words)
    assert (other.exit_code, "was made from something else" in other.stderr) == (2, True)
    assert {file: file.read_bytes() for file in kept} == kept
    assert call("validate", "LOC", *words).exit_code == 0


@pytest.mark.usefixtures("folder")
def test_json_has_the_predicted_moves() -> None:
    problem = dwell.load(CALIBRATED)
    run = dwell.simulate(problem, scenario="stress", policy="dtp", seed=9, windows=40)
    run.save("dtp")
    told = read_json(call("validate", "dtp", "--cell", CALIBRATED, "--seeds", "2", "--json"))
    assert told["moves"]
    labels = {"scenario": "stress", "policy": "dtp+corrected", "run": "dtp"}
    assert told["moves"] == [labels | row for row in predicted_moves(run).to_dicts()]


def refused(*arguments: str) -> str:
    result = call("validate", *arguments, "--cell", CALIBRATED)
    assert result.exit_code == 2
    assert not Path("validations").exists()
    return result.output


def test_calibration_runs_are_refused(folder: Path) -> None:
    assert "LOC: the cell was calibrated from this run" in refused(
        "LOC", "OFF", "--calibrated-from", "./LOC"
    )
    sidecar = folder / "small.calibration.json"
    sidecar.write_text('{"runs": ["elsewhere/OFF"]}', encoding="utf-8")
    assert "OFF: the cell was calibrated from this run" in refused("LOC", "OFF")
    # Ids are what counts where there are any: names may be those of another campaign's runs.
    sidecar.write_text('{"runs": ["OFF"], "ids": ["1795"]}', encoding="utf-8")
    told = read_json(call("validate", "OFF", "--cell", CALIBRATED, "--seeds", "2", "--json"))
    assert told["groups"][0]["runs"] == ["OFF"]
    shutil.rmtree("validations")
    sidecar.write_text("[]", encoding="utf-8")
    assert "small.calibration.json: cannot be read" in refused("LOC")


@pytest.mark.usefixtures("folder")
def test_folders_that_are_no_runs() -> None:
    output = refused("LOC", "nowhere", "LOC")
    assert "nowhere: no such folder" in output
    assert "LOC: named twice" in output
