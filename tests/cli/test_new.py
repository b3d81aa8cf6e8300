"""`dwell new`: what it makes, and what it refuses."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dwell
from tests.cli.small_cell import ROOT, call

FILES = {"cell.yaml", "policy.py", "stages.py", "test_cell.py", "cell.schema.json"}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder, the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("origin", ["canonical", "live"])
def test_a_new_cell_passes_its_check_and_its_own_test(here: Path, origin: str) -> None:
    assert call("new", "hall", "--from", origin).exit_code == 0
    assert {path.name for path in (here / "hall").iterdir()} == FILES
    assert call("check", "hall/cell.yaml").exit_code == 0
    assert dwell.load("hall/cell.yaml").name == "hall"
    for command in (["test_cell.py"], ["-m", "pytest", "-q", "-p", "no:cacheprovider"]):
        found = subprocess.run(
            (sys.executable, *command), cwd="hall", capture_output=True, text=True, check=False
        )
        assert found.returncode == 0, found.stdout + found.stderr


def test_the_head_lists_the_keys_of_a_first_cell(here: Path) -> None:
    assert call("new", "hall").exit_code == 0
    head = (here / "hall/cell.yaml").read_text(encoding="utf-8").partition("\ndwell:")[0]
    assert "#   nodes               tier, cores\n" in head
    assert "background" not in head


def test_a_new_live_cell_runs_under_its_own_policy(here: Path) -> None:
    assert "dwell live run cell.yaml" in call("new", "hall", "--from", "live").stdout
    words = ("live", "run", "hall/cell.yaml", "--seconds", "5", "--out", "out")
    found = subprocess.run(
        (sys.executable, "-m", "dwell", *words, "--policy", "policy:Patient"),
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    (folder,) = (here / "out" / "runs").iterdir()
    shutil.rmtree("hall")
    assert dwell.open_run(folder).meta["policy"] == "policy:Patient"


def test_the_default_is_the_canonical_cell(here: Path) -> None:
    assert call("new", "hall").exit_code == 0
    ours, theirs = (
        dwell.load(path) for path in ("hall/cell.yaml", ROOT / "examples" / "canonical.yaml")
    )
    assert ours.candidates == theirs.candidates
    assert ours.scenarios == theirs.scenarios


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".hall", "a:b", "a b", "a\tb", "x" * 64, "./-hall"]
)
def test_names_that_are_no_folders(here: Path, name: str) -> None:
    found = call("new", name)
    assert found.exit_code == 2
    assert "is no name for a folder" in found.stderr
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_nothing_is_overwritten(here: Path, kind: str) -> None:
    if kind == "folder":
        Path("hall").mkdir()
    elif kind == "file":
        Path("hall").write_text("mine", encoding="utf-8")
    else:
        Path("hall").symlink_to("nowhere")
    found = call("new", "hall")
    assert (found.exit_code, found.stderr) == (
        2,
        "error: hall exists already; choose another name\n",
    )
    assert kind != "folder" or list(Path("hall").iterdir()) == []
    assert kind != "file" or Path("hall").read_text(encoding="utf-8") == "mine"


def test_a_folder_around_it_that_is_missing(here: Path) -> None:
    found = call("new", "absent/hall")
    assert (found.exit_code, found.stderr.count("\n")) == (2, 1)
    assert "absent is not a folder" in found.stderr


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written(here: Path) -> None:
    here.chmod(0o555)
    for command in (("new", "hall"), ("schema", "--write")):
        found = call(*command)
        assert (found.exit_code, found.stderr.count("\n")) == (1, 1)
    here.chmod(0o755)
