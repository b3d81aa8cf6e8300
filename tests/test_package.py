"""The built wheel: its name, what it holds, and the demo from it, away from the checkout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that holds what the wheel holds."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    assert wheel.name.startswith("dwell_placement-")
    shutil.unpack_archive(wheel, folder / "site", "zip")
    return folder / "site"


def test_the_wheel_has_the_examples_and_nothing_else(installed: Path) -> None:
    tops = {path.name for path in installed.iterdir()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {"dwell"}
    ours = {path.relative_to(ROOT / "examples") for path in (ROOT / "examples").rglob("*.yaml")}
    theirs = installed / "dwell" / "examples"
    assert {path.relative_to(theirs) for path in theirs.rglob("*.yaml")} == ours
    assert not list(installed.rglob("*.pyc"))


def test_the_demo_of_an_installed_package_needs_no_checkout(
    installed: Path, tmp_path: Path
) -> None:
    words = [sys.executable, "-P", "-m", "dwell", "demo", "--json"]
    words += ["--seeds", "2", "--windows", "12", "--processes", "1", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        words,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(installed)},
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)
    assert (tmp_path / "out" / "report.html").is_file()
