"""`dwell check --node`: what keeps this computer from being a node of a live cell."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

import dwell
from dwell.model.document import to_document
from tests.cells.light import document, write_cell
from tests.cli.live_cell import EXAMPLE
from tests.cli.small_cell import assert_refused, call

HOSTS = {node: {"port": 7_100 + 100 * i} for i, node in enumerate(("R1", "E", "R2"))}
STAGES = """
import time


class Bare:
    pass


class Keeps:
    takes_s = 0.0

    def process(self, inputs):
        return None

    def snapshot(self):
        time.sleep(self.takes_s)
        return bytes(9)

    def restore(self, state):
        assert len(state) == 9


class KeepsLong(Keeps):
    takes_s = 0.3


class NeedsStart(Keeps):
    def snapshot(self):
        raise RuntimeError("not started")
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a cell's stages, which is not looked for modules afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("light_stages", "own_stages"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    (tmp_path / "own_stages.py").write_text(STAGES, encoding="utf-8")
    return tmp_path


def written(folder: Path, perception: Mapping[str, Any] | None = None, **live: object) -> Path:
    """Write the light cell, its perception and its section `live` changed."""
    known = document()
    known["tasks"]["perception"] |= perception or {}
    settings = {**known["live"], "hosts": HOSTS, **live}
    return write_cell(folder, tasks=known["tasks"], live=settings)


def example(folder: Path, stages: str, runs: Mapping[str, str], **live: object) -> Path:
    """Write the example's cell, with some stages from a copy of its own and a changed `live`."""
    known = to_document(dwell.load(EXAMPLE / "cell.yaml"))
    for task, run in runs.items():
        known["tasks"][task]["run"] = run
    for name in (stages, "stages"):
        shutil.copy(EXAMPLE / "stages.py", folder / f"{name}.py")
    file = folder / "cell.yaml"
    # No cell of this name runs here, whatever other tests run.
    changed = {**known, "name": folder.name, "live": live}
    file.write_text(yaml.safe_dump(changed, sort_keys=False))
    return file


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
    cell = written(folder, changes)
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


@pytest.mark.parametrize(
    ("run", "timed", "warning"),
    [
        ("Keeps", True, ""),
        ("KeepsLong", True, "no checkpoints are made"),
        ("NeedsStart", False, "its state was not timed (RuntimeError: not started)"),
    ],
)
def test_the_times_of_a_state_are_shown(folder: Path, run: str, timed: bool, warning: str) -> None:
    cell = written(folder, {"run": f"own_stages:{run}", "state_bytes": 9})
    result = call("check", cell, "--node", "E")
    assert result.exit_code == 0
    assert ("perception: snapshot() takes " in result.stdout) == timed
    assert warning in result.stderr
    assert bool(result.stderr) == bool(warning)
    states = json.loads(call("check", cell, "--node", "E", "--json").stdout)["states"]
    assert set(states) == ({"perception"} if timed else set())
    if timed:
        assert states["perception"]["bytes"] == 9
        assert states["perception"]["snapshot_ms"] >= (300 if run == "KeepsLong" else 0)


def test_what_nobody_applies_and_what_has_no_stage_is_told_at_once(folder: Path) -> None:
    tasks = document()["tasks"]
    del tasks["control"]["run"]
    cell = write_cell(folder, tasks=tasks, live={"hosts": HOSTS})
    result = call("check", cell, "--node", "R2")
    assert result.exit_code == 2
    lines = [line.removeprefix(f"{cell}: node R2: ") for line in result.stderr.splitlines()]
    assert lines == [
        "tasks.control.run: missing; name its stage, as module:Name",
        "live.actuators.control: missing; name what applies its commands, as module:Name",
    ]


def test_a_node_that_there_is_not_is_wrong_input(folder: Path) -> None:
    result = call("check", written(folder), "--node", "R3")
    assert_refused(result, "no node 'R3' in cell 'light'; there are R1, E, R2")


def test_a_cell_that_leaves_this_computer_needs_keys(folder: Path) -> None:
    cell = written(folder, hosts={**HOSTS, "E": {"address": "192.0.2.1", "port": 7_200}})
    assert_refused(call("check", cell, "--node", "R1"), "live.hosts.E")
    assert call("check", cell, "--node", "R1", "--insecure").exit_code == 0


@pytest.mark.parametrize("node", ["R1", "E", "R2"])
def test_a_node_that_has_all_it_needs(node: str) -> None:
    result = call("check", "--node", node, EXAMPLE / "cell.yaml")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.startswith(f"light-follower: {node} has all that it needs\n")
    assert f"agent@{node}" in result.stdout


def test_all_that_a_node_lacks_is_told_at_once(tmp_path: Path) -> None:
    runs = {
        "camera": "lacking_stages:Drive",
        "perception": "no_such_vision:Detect",
        "planning": "lacking_stages:Plna",
        "control": "lacking_stages:Plan",
    }
    hosts = {"R1": {"port": 7450}}
    file = example(tmp_path, "lacking_stages", runs, hosts=hosts, release="frames")
    result = call("check", "--node", "R1", file)
    start = f"{file}: node R1: "
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.splitlines() == [
        f"{start}live.hosts.E: missing; give its address and first port",
        f"{start}live.hosts.R2: missing; give its address and first port",
        f"{start}tasks.camera.run: lacking_stages:Drive is no stage: it has no method "
        "process(inputs)",
        f"{start}tasks.perception.run: importing no_such_vision failed (ModuleNotFoundError: No "
        "module named 'no_such_vision')",
    ]
    result = call("check", "--node", "R2", file, "--json")
    faults = {fault["path"]: fault["message"] for fault in json.loads(result.stdout)["faults"]}
    assert result.exit_code == 2
    assert faults["tasks.planning.run"] == "lacking_stages has no 'Plna'; did you mean 'Plan'?"
    assert faults["tasks.control.run"] == "its `inputs` name 'perception', but it gets planning"
    assert faults["tasks.control.state_bytes"].startswith("0, but lacking_stages:Plan has a state")
    assert faults["live.actuators.control"].startswith("missing; ")


def test_frames_need_a_method_that_waits_for_them(tmp_path: Path) -> None:
    live = to_document(dwell.load(EXAMPLE / "cell.yaml"))["live"]
    runs = {"camera": "waiting_stages:perceive"}
    file = example(tmp_path, "waiting_stages", runs, **{**live, "release": "frames"})
    words = "waiting_stages:perceive has no method wait(), and live.release is frames"
    assert words in call("check", "--node", "R1", file).stderr


def ros_cell(folder: Path, **changed: object) -> Path:
    """Write the example's cell of ROS 2 topics, with changes of its camera's topic."""
    known = to_document(dwell.load(EXAMPLE / "ros2.yaml"))
    known["tasks"]["camera"]["ros2"] |= changed
    for name in ("stages", "ros_stages"):
        shutil.copy(EXAMPLE / f"{name}.py", folder / f"{name}.py")
    file = folder / "cell.yaml"
    file.write_text(yaml.safe_dump({**known, "name": folder.name}, sort_keys=False))
    return file


def test_topics_of_a_node_are_checked(tmp_path: Path) -> None:
    assert call("check", ros_cell(tmp_path), "--node", "R1").exit_code == 0
    file = ros_cell(tmp_path, type="own_msgs/msg/Picture")
    assert (
        "tasks.camera.ros2.type: unknown type own_msgs/msg/Picture;" in call("check", file).stderr
    )
    result = call("check", file, "--node", "R1")
    assert result.exit_code == 2
    assert "tasks.camera.run: unknown type own_msgs/msg/Picture; types of your own" in result.stderr
    for folder, field in (("wide", "wstring name"), ("plain", "uint8[] pixels")):
        types = tmp_path / folder / "own_msgs" / "msg" / "Picture.msg"
        types.parent.mkdir(parents=True)
        types.write_text(f"{field}\n")
        file = ros_cell(tmp_path, type="own_msgs/msg/Picture", messages=folder)
        assert ("ros2.type: " in call("check", file).stderr) == (folder == "wide")
        result = call("check", file, "--node", "R1")
        assert ("Picture.name: a wstring" in result.stderr) == (folder == "wide")
    assert result.exit_code == 0


def test_topics_without_keys_of_a_cell_with_keys_are_a_warning(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    file = ros_cell(tmp_path)
    assert call("keys", "init", file, "--out", keys).exit_code == 0
    words = "check", file, "--node", "R1", "--keys", keys / "R1"
    assert "tasks.camera.ros2: the cell has keys, and this topic has none" in call(*words).stderr
    ros_cell(tmp_path, connect="tls/router:7447")
    assert "this topic has none" not in call(*words).stderr
