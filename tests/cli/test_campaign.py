"""`dwell testbed campaign` and `dwell report` of one: what they print, and what they refuse."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from dwell.cli.commands import app
from dwell.model.document import to_document
from tests.cells.small import make_problem
from tests.report.test_campaign_page import made

PROBLEM = make_problem()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("campaign") / "there", (), 2)


def test_report_makes_the_page_of_a_campaign(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    done = CliRunner().invoke(app, ["report", str(folder), "--out", str(page), "--json"])
    assert done.exit_code == 0
    told = json.loads(done.stdout)
    assert told["done"] == told["planned"]
    assert told["excluded_windows"] == told["done"]
    assert {row["policy"] for row in told["table"]} >= {"LOC", "cusum+corrected"}
    assert page.read_text().startswith("<!DOCTYPE html>")
    wrong = CliRunner().invoke(app, ["report", str(folder), "--trace", str(tmp_path / "t.json")])
    assert wrong.exit_code == 2
    assert "is a campaign" in wrong.stderr


def test_report_alone_measures_nothing(folder: Path, tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(yaml.safe_dump(to_document(PROBLEM)))
    asked = ["testbed", "campaign", str(cell), "--report", "--out"]
    done = CliRunner().invoke(app, [*asked, str(folder)])
    assert done.exit_code == 0
    assert (folder / "report.html").is_file()
    none = CliRunner().invoke(app, [*asked, str(tmp_path / "none")])
    assert none.exit_code == 2
    assert "not a campaign" in none.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--scenarios", "nowhere"], "nowhere"),
        (["--scenarios", "baseline", "--policies", "nobody"], "nobody"),
        (["--scenarios", "network-impairment"], "no commands that disturb"),
        (["--scenarios", "baseline", "--policies", "LOC,LOC"], "'LOC' twice"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_made(
    arguments: list[str], said: str, tmp_path: Path
) -> None:
    cell, hosts = tmp_path / "cell.yaml", tmp_path / "hosts.yaml"
    cell.write_text(yaml.safe_dump(to_document(PROBLEM)))
    told = {node: {"run": "false", "address": "10.0.0.1"} for node in PROBLEM.fabric.nodes}
    hosts.write_text(yaml.safe_dump({"dwell-inventory": 1, "hosts": told}))
    out = tmp_path / "there"
    asked = ["testbed", "campaign", str(cell), "--inventory", str(hosts), "--out", str(out)]
    done = CliRunner().invoke(app, [*asked, *arguments])
    assert done.exit_code in (1, 2)
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()
