"""`dwell check --node`: what keeps this computer from being a node of a live cell."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

import dwell
from dwell.cli.commands import app
from dwell.model.document import to_document
from tests.cells.light import document, write_cell
from tests.cli.live_cell import EXAMPLE
from tests.cli.small_cell import call

HOSTS = {node: {"port": 7_100 + 100 * i} for i, node in enumerate(("R1", "E", "R2"))}
STAGES = """
class Bare:
    pass
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a cell's stages, which is not looked for modules afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("light_stages", "own_stages"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "own_stages.py").write_text(STAGES, encoding="utf-8")
    return tmp_path


def written(folder: Path, **tasks: dict[str, Any]) -> Path:
    """Write the light cell, some of its tasks changed."""
    found = document(live={**document()["live"], "hosts": HOSTS})
    for name, changes in tasks.items():
        found["tasks"][name] |= changes
    cell = write_cell(folder)
    cell.write_text(yaml.safe_dump(found), encoding="utf-8")
    return cell


def test_what_a_node_runs_and_who_reaches_it(folder: Path) -> None:
    cell = written(folder)
    result = call("check", cell, "--node", "E")
    assert (result.exit_code, result.stderr) == (0, "")
    assert "light: E has all that it needs" in result.stdout
    rows = {line.split()[0]: line.split()[1:] for line in result.stdout.splitlines() if "@" in line}
    assert {"agent@E", "perception@E", "planning@E", "controller@E"} <= rows.keys()
    ports = [int(port) for port, *_ in rows.values()]
    assert min(ports) == HOSTS["E"]["port"]
    assert len(set(ports)) == len(ports)
    found = json.loads(call("check", cell, "--node", "E", "--json").stdout)
    assert found["ready"]
    assert found["faults"] == []
    assert set(found["processes"]) == rows.keys()


@pytest.mark.parametrize(
    ("node", "changes", "path", "words"),
    [
        ("R1", {"run": "own_stages:Bare"}, "tasks.perception.run", "has no method process"),
        ("E", {"state_bytes": 9}, "tasks.perception.state_bytes", "no methods snapshot()"),
    ],
)
def test_a_stage_that_cannot_run_there_is_told(
    folder: Path, node: str, changes: dict[str, Any], path: str, words: str
) -> None:
    cell = written(folder, perception=changes)
    result = call("check", cell, "--node", node)
    assert (result.exit_code, result.stdout) == (2, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"{cell}: node {node}: {path}: ")
    assert words in line
    found = json.loads(call("check", cell, "--node", node, "--json").stdout)
    assert not found["ready"]
    assert [one["path"] for one in found["faults"]] == [path]
    # Another node has nothing to do with it.
    assert call("check", cell, "--node", "R2").exit_code == 0


def test_what_nobody_applies_and_what_has_no_stage_is_told_at_once(folder: Path) -> None:
    found = document(live={"hosts": HOSTS})
    del found["tasks"]["control"]["run"]
    cell = write_cell(folder)
    cell.write_text(yaml.safe_dump(found), encoding="utf-8")
    result = call("check", cell, "--node", "R2")
    assert result.exit_code == 2
    told = [line.removeprefix(f"{cell}: node R2: ") for line in result.stderr.splitlines()]
    assert told == [
        "tasks.control.run: missing; name its stage, as module:Name",
        "live.actuators.control: missing; name what applies its commands, as module:Name",
    ]


def test_a_node_that_there_is_not_is_wrong_input(folder: Path) -> None:
    result = call("check", written(folder), "--node", "R3")
    assert result.exit_code == 2
    assert "no node 'R3' in cell 'light'; there are E, R1, R2" in result.stderr


def test_a_cell_that_leaves_this_computer_needs_keys(folder: Path) -> None:
    cell = written(folder)
    hosts = {**HOSTS, "E": {"address": "192.0.2.1", "port": 7_200}}
    found = yaml.safe_load(cell.read_text(encoding="utf-8"))
    found["live"]["hosts"] = hosts
    cell.write_text(yaml.safe_dump(found), encoding="utf-8")
    refused = call("check", cell, "--node", "R1")
    assert refused.exit_code == 2
    assert "live.hosts.E" in refused.stderr
    assert call("check", cell, "--node", "R1", "--insecure").exit_code == 0


def invoke(*arguments: str | Path) -> tuple[int, str, str]:
    """Run a command in this process."""
    result = CliRunner().invoke(app, [str(word) for word in arguments])
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.parametrize("node", ["R1", "E", "R2"])
def test_a_node_that_has_all_it_needs(node: str) -> None:
    code, stdout, stderr = invoke("check", "--node", node, EXAMPLE / "cell.yaml")
    assert (code, stderr) == (0, "")
    assert stdout.startswith(f"light-follower: {node} has all that it needs\n")
    assert f"agent@{node}" in stdout


def test_all_that_a_node_lacks_is_told_at_once(tmp_path: Path) -> None:
    document = to_document(dwell.load(EXAMPLE / "cell.yaml"))
    shutil.copy(EXAMPLE / "stages.py", tmp_path / "lacking_stages.py")
    tasks = document["tasks"]
    tasks["camera"]["run"] = "lacking_stages:Drive"
    tasks["perception"]["run"] = "no_such_vision:Detect"
    tasks["planning"]["run"] = "lacking_stages:Plna"
    tasks["control"]["run"] = "lacking_stages:Plan"
    document["live"] = {"hosts": {"R1": {"port": 7450}}, "release": "frames"}
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(document, sort_keys=False))
    code, stdout, stderr = invoke("check", "--node", "R1", file)
    start = f"{file}: node R1: "
    assert (code, stdout) == (2, "")
    assert stderr.splitlines() == [
        f"{start}live.hosts.E: missing; give its address and first port",
        f"{start}live.hosts.R2: missing; give its address and first port",
        f"{start}tasks.camera.run: lacking_stages:Drive is no stage: it has no method "
        "process(inputs)",
        f"{start}tasks.perception.run: importing no_such_vision failed (ModuleNotFoundError: No "
        "module named 'no_such_vision')",
    ]
    code, stdout, _ = invoke("check", "--node", "R2", file, "--json")
    found = {fault["path"]: fault["message"] for fault in json.loads(stdout)["faults"]}
    assert code == 2
    assert found["tasks.planning.run"] == "lacking_stages has no 'Plna'; did you mean 'Plan'?"
    assert found["tasks.control.run"] == "its `inputs` name 'perception', but it gets planning"
    assert found["tasks.control.state_bytes"].startswith("0, but lacking_stages:Plan has a state")
    assert found["live.actuators.control"].startswith("missing; ")


def test_frames_need_a_method_that_waits_for_them(tmp_path: Path) -> None:
    document = to_document(dwell.load(EXAMPLE / "cell.yaml"))
    document["tasks"]["camera"]["run"] = "waiting_stages:perceive"
    document["live"]["release"] = "frames"
    shutil.copy(EXAMPLE / "stages.py", tmp_path / "waiting_stages.py")
    shutil.copy(EXAMPLE / "stages.py", tmp_path / "stages.py")
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(document, sort_keys=False))
    _, _, stderr = invoke("check", "--node", "R1", file)
    assert "waiting_stages:perceive has no method wait(), and live.release is frames" in stderr
