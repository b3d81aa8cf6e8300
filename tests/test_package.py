"""The built wheel: what it holds, and what its extras can do in environments of their own."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

import dwell
from benchmarks.size import unpack_source
from dwell.kernels.library import load
from dwell.kernels.library_file import NAME
from tests.cli.live_cell import RealCell

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that holds what the source distribution holds."""
    return unpack_source(tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def installed(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that holds what the wheel holds, built from the source distribution.

    The kernel of this checkout is taken if its sources and options are those of the distribution:
    to compile it again takes half a minute.
    """
    folder = tmp_path_factory.mktemp("wheel")
    built = source / "build" / re.sub(r"[-.]", "_", sysconfig.get_platform())
    built.mkdir(parents=True)
    shutil.copy2(ROOT / "src" / "dwell" / "kernels" / NAME, built)
    build("wheel", source, folder)
    (wheel,) = folder.glob("dwell_placement-*.whl")
    shutil.unpack_archive(wheel, folder / "site", "zip")
    return folder / "site"


def build(what: str, checkout: Path, folder: Path) -> None:
    command = (sys.executable, "-m", "hatchling", "build", "-t", what, "-d", folder)
    subprocess.run(command, cwd=checkout, check=True, capture_output=True)


def test_the_source_distribution_has_the_kernel_s_sources_and_no_library(source: Path) -> None:
    assert (source / "hatch_build.py").is_file()
    ours = {path.name for path in (ROOT / "src" / "dwell" / "kernels").glob("*.[ch]*")}
    assert ours <= {path.name for path in (source / "src" / "dwell" / "kernels").iterdir()}
    assert not list(source.rglob("*.so"))


def test_the_wheel_is_small_and_has_the_kernel_without_its_sources(installed: Path) -> None:
    (wheel,) = installed.parent.glob("*.whl")
    assert wheel.stat().st_size <= 1.48e6
    kernels = installed / "dwell" / "kernels"
    assert not [*kernels.glob("*.cpp"), *kernels.glob("*.h"), *kernels.glob("*.txt")]
    load(kernels)


def test_the_wheel_has_the_examples_and_nothing_else(installed: Path) -> None:
    tops = {path.name for path in installed.iterdir()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {"dwell"}
    all_of_them = {one.relative_to(ROOT / "examples") for one in (ROOT / "examples").rglob("*.*")}
    ours = {one for one in all_of_them if not {"visual_servoing", "__pycache__"} & {*one.parts}}
    theirs = installed / "dwell" / "examples"
    assert {path.relative_to(theirs) for path in theirs.rglob("*.*")} == ours
    assert not list(installed.rglob("*.pyc"))


# ----------------------------------------------------------------------- clean environments

UV = Path(sys.executable).with_name("uv")


def run(
    *words: str | Path, cwd: Path | None = None, **more: str
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, away from the checkout and from this environment.

    Parameters
    ----------
    more : str
        Variables of its environment.
    """
    ours = ("PYTHONPATH", "VIRTUAL_ENV")
    kept = {name: value for name, value in os.environ.items() if name not in ours}
    return subprocess.run(
        list(map(str, words)),
        check=False,
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**kept, **more},
    )


@pytest.fixture(scope="module")
def environment(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that makes an environment, once per extra, with pins as here."""
    if not UV.is_file():
        pytest.skip("uv is not beside the interpreter; `make env` installs it")
    (wheel,) = installed.parent.glob("*.whl")
    pins = ROOT / "requirements" / "dev.txt"

    @cache
    def made(extra: str) -> Path:
        folder = tmp_path_factory.mktemp(extra or "base") / "environment"
        run(UV, "venv", "--quiet", "--python", sys.executable, folder)
        python = folder / "bin" / "python"
        into = (UV, "pip", "install", "--quiet", "--python", python, "--constraint", pins)
        reached = run(*into, "numpy")
        if reached.returncode:
            pytest.skip(f"no packages can be installed here: {reached.stderr.strip()[-200:]}")
        wanted = f"dwell-placement[{extra}]" if extra else "dwell-placement"
        done = run(*into, f"{wanted} @ {wheel.as_uri()}")
        assert done.returncode == 0, done.stderr
        return python

    return made


def test_a_robot_runs_and_moves_a_cell_with_the_extra_live_alone(
    environment: Callable[[str], Path], tmp_path: Path
) -> None:
    python = environment("live")
    listed = json.loads(run(UV, "pip", "list", "--python", python, "--format", "json").stdout)
    names = {one["name"] for one in listed} - {"dwell-placement"}
    said = (ROOT / "docs" / "howto" / "deploy.md").read_text(encoding="utf-8")
    told = re.search(r"brings these packages, (\d+) MB at most:(.*?)\.", said, re.DOTALL)
    assert told is not None
    assert set(re.findall(r"`([\w.-]+)`", told[2])) == names
    size = sum(path.stat().st_size for path in python.parents[1].rglob("*") if path.is_file())
    assert size / 1e6 <= int(told[1]) <= 150

    # A cell runs without the kernel, if nothing prices its placements.
    (library,) = python.parents[1].rglob(NAME)
    library.unlink()

    cell = RealCell(tmp_path / "cell", python)
    try:
        words = ("--cell", cell.file, "--out", tmp_path / "none", "--policy", "dtp")
        refused = run(python, "-m", "dwell", "controller", *words)
        assert refused.returncode == 1
        assert refused.stderr.startswith("error: the compiled kernel")
        assert refused.stderr.count("\n") == 1
        cell.controller()
        for node in ("R1", "R2", "E"):
            cell.agent(node)
        cell.until(lambda status: not status["silent"] and status["window"])
        moved = run(python, "-m", "dwell", "live", "pin", "SO", "--cell", cell.file)
        assert moved.returncode == 0, moved.stderr
        there = cell.until(lambda status: status["placement"] == "SO")["window"]["number"]
        cell.until(lambda status: status["window"]["number"] > there + 1)
        assert cell.end("controller") == 0
    finally:
        cell.close()
    (folder,) = (cell.folder / "runs").iterdir()
    assert not (folder / "run.json").exists()
    log = (cell.folder / "controller.log").read_text(encoding="utf-8")
    assert "stays a journal, for Polars is not installed here" in log
    assert "placement LOC stays, and its record expects no other of any candidate" in log
    # What the robot could not write, this environment reads of the journal.
    assert "SO" in dwell.open_run(folder).cycles["placement"].cast(str).to_list()


def test_the_extra_report_alone_reports_a_run(
    environment: Callable[[str], Path], tmp_path: Path
) -> None:
    python = environment("report")
    run_folder = shutil.copytree(ROOT / "tests/regression/data/old-runs/simulated", tmp_path / "r")
    done = run(python, "-m", "dwell", "report", run_folder, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (run_folder / "report.html").is_file()


def test_the_doctor_and_completion_work_without_any_extra(
    environment: Callable[[str], Path], tmp_path: Path
) -> None:
    python = environment("")
    done = run(python, "-m", "dwell", "doctor", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["findings"]
    extras = {one["name"]: one for one in found if one["part"] == "extras"}
    assert set(extras) == {"sim", "report", "live", "dash", "mcap", "dask"}
    assert not any(one["ok"] for one in extras.values())
    assert extras["live"]["remedy"] == "pip install 'dwell-placement[live]'"
    assert not [one for one in found if one["part"] == "runs here" and one["ok"]]
    shutil.copy(ROOT / "examples" / "live" / "cell.yaml", tmp_path)
    looked = run(python, "-m", "dwell", "doctor", "cell.yaml", cwd=tmp_path)
    assert looked.returncode == 0, looked.stderr
    words = "dwell live pin --cell cell.yaml H"
    asked = {"_DWELL_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "5"}
    told = run(python, "-m", "dwell", cwd=tmp_path, **asked)
    assert told.stdout.strip() == "HYB"


def test_a_stranger_s_way_from_the_wheel_to_a_report_of_his_own_policy(
    environment: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is compiled, cached or configured; the log gets the seconds of each step."""
    home = tmp_path / "home"
    home.mkdir()
    begin = time.perf_counter()
    took_s: list[tuple[str, float]] = []

    def done(step: str) -> None:
        took_s.append((step, time.perf_counter() - begin - sum(each for _, each in took_s)))

    python = environment("all")
    done("install")
    cell = next((python.parents[1] / "lib").glob("*/site-packages/dwell/examples/canonical.yaml"))

    def dwell_does(words: str) -> str:
        found = run(python, "-m", "dwell", *words.split(), cwd=home, HOME=str(home))
        assert found.returncode == 0, found.stderr
        done(f"dwell {words}".replace(str(cell), "CELL"))
        return found.stdout

    assert "of deadlines missed" in dwell_does(f"run {cell} --windows 20 --out first")
    dwell_does("report first")
    dwell_does("new hall")
    assert "no faults" in dwell_does("check hall/cell.yaml")
    dwell_does("run hall/cell.yaml --windows 20 --out second")
    with (home / "hall" / "policy.py").open("a", encoding="utf-8") as file:
        file.write('\n\nclass Mine(Patient):\n    """A policy of one\'s own."""\n')
    dwell_does("run hall/cell.yaml --windows 20 --out third --policy policy:Mine")
    dwell_does("report third")
    words = "--seeds 2 --windows 12 --processes 1"
    assert json.loads(dwell_does(f"demo --json {words} --out demo"))
    for folder in ("first", "third", "demo"):
        assert (home / folder / "report.html").is_file()
    assert dwell.open_run(home / "third").meta["policy"] == "policy:Mine"
    with capsys.disabled():
        print("", *(f"{seconds:6.1f} s  {step}" for step, seconds in took_s), sep="\n")


def test_the_laboratory_is_a_wheel_of_its_own(
    environment: Callable[[str], Path], tmp_path: Path
) -> None:
    """Goes on from the test before: both need each extra."""
    python = environment("all")
    cell = next((python.parents[1] / "lib").glob("*/site-packages/dwell/examples/canonical.yaml"))
    assert run(python, "-m", "dwell", "check", cell).returncode == 0
    words = ("testbed", "doctor")
    without = run(python, "-m", "dwell", *words)
    assert without.returncode == 2
    assert without.stderr.startswith("error: dwell testbed needs dwell-lab; ")
    build("wheel", ROOT / "lab", tmp_path)
    (wheel,) = tmp_path.glob("dwell_lab-*.whl")
    added = run(UV, "pip", "install", "--quiet", "--no-deps", "--python", python, wheel)
    assert added.returncode == 0, added.stderr
    assert run(python, "-m", "dwell", *words).returncode in (0, 1)
    assert run(python, "-m", "dwell", "validate", "--help").returncode == 0
