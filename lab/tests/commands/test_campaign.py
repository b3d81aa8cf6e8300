"""`dwell testbed campaign` and `dwell report` of one: what they print, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from dwell.model.document import to_document
from lab.tests.pages.test_campaign_page import made
from tests.cells.small import make_problem
from tests.cli.small_cell import assert_refused, call, read_json

PROBLEM = make_problem()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("campaign") / "there", (), 2)


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(to_document(PROBLEM)))
    return file


def test_report_makes_the_page_of_a_campaign(folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    document = read_json(call("report", folder, "--out", page, "--json"))
    assert document["done"] == document["planned"]
    assert document["excluded_windows"] == document["done"]
    assert {row["policy"] for row in document["table"]} >= {"LOC", "cusum+corrected"}
    assert page.read_text().startswith("<!DOCTYPE html>")
    assert_refused(call("report", folder, "--trace", tmp_path / "t.json"), "is a campaign")


def test_report_alone_measures_nothing(folder: Path, cell: Path, tmp_path: Path) -> None:
    words = ("testbed", "campaign", cell, "--report", "--out")
    assert call(*words, folder).exit_code == 0
    assert (folder / "report.html").is_file()
    assert_refused(call(*words, tmp_path / "none"), "not a campaign")


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
    arguments: list[str], said: str, cell: Path, tmp_path: Path
) -> None:
    hosts, out = tmp_path / "hosts.yaml", tmp_path / "there"
    commands = {node: {"run": "false", "address": "10.0.0.1"} for node in PROBLEM.fabric.nodes}
    hosts.write_text(yaml.safe_dump({"dwell-inventory": 1, "hosts": commands}))
    words = ("testbed", "campaign", cell, "--inventory", hosts, "--out", out)
    done = call(*words, *arguments)
    assert done.exit_code in (1, 2)
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()
