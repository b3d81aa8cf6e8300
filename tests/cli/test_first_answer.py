"""The first command that simulates: what it does where no compiled kernels are cached."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest

import dwell
from tests.cli.small_cell import ROOT, SMALL, interrupt_at_first_sign

FIND = "from dwell.cli.first_answer import find_kernels as f; k = f(); print(k.folder, k.suffix)"


@pytest.fixture
def cell(cell: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a cell in the current folder, in which the kernels' cache is empty."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cell.with_name("cache")))
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    cell.write_text(f"{SMALL}controller: {{estimator: corrected}}\n", encoding="utf-8")
    return cell


def start(cell: Path, out: str) -> subprocess.Popen[str]:
    words = ("run", cell, "--windows", "12", "--scenario", "stress", "--out", out, "--jobs")
    command = (sys.executable, "-m", "dwell", *words)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (0, "")


def run(cell: Path, out: str) -> None:
    finish(start(cell, out))


def lock_file() -> Path:
    found = subprocess.run(
        (sys.executable, "-c", FIND), capture_output=True, text=True, check=True
    ).stdout.split()
    Path(found[0]).mkdir(parents=True, exist_ok=True)
    return Path(found[0], f"compiling.{found[1]}.lock")


@contextmanager
def locked(lock: Path) -> Iterator[None]:
    """Hold the lock as a compiler does."""
    with lock.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield


def wait_until_free(lock: Path) -> None:
    """Wait until the process that held the lock has ended."""
    with lock.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)


def compilers(lock: Path) -> list[psutil.Process]:
    """Return the processes that have the lock's file open."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if any(Path(one.path) == lock for one in process.open_files()):
                found.append(process)
    return found


def test_who_plays_a_run_does_not_matter(cell: Path) -> None:
    lock = lock_file()
    with locked(lock):
        run(cell, "interpreted")
    # Neither this run nor a compiler of its own has compiled.
    assert [path for path in lock.parent.iterdir() if path != lock] == []
    one = dwell.open_run("interpreted")
    # In this process, which is no command of its own, kernels are compiled.
    other = dwell.simulate(dwell.load(cell), scenario="stress", seed=1, windows=12, jobs=True)
    assert json.dumps(one.meta) == json.dumps(other.meta)
    for name in ("cycles", "windows", "decisions", "jobs"):
        assert getattr(one, name).equals(getattr(other, name))


def test_one_compiler_runs_for_all_and_may_be_killed(cell: Path) -> None:
    lock = lock_file()
    for out in ("first", "second"):
        run(cell, out)
        (compiler,) = compilers(lock)
        assert os.getsid(compiler.pid) == compiler.pid
    compiler.kill()
    wait_until_free(lock)
    run(cell, "third")
    (another,) = compilers(lock)
    assert another.pid != compiler.pid
    another.kill()
    wait_until_free(lock)


def test_two_that_start_at_once(cell: Path) -> None:
    lock = lock_file()
    both = [start(cell, out) for out in ("first", "second")]
    for process in both:
        finish(process)
    (compiler,) = compilers(lock)
    compiler.kill()
    wait_until_free(lock)
    assert dwell.open_run("first").cycles.equals(dwell.open_run("second").cycles)


@pytest.mark.parametrize("command", ["run", "study", "demo"])
def test_long_work_says_that_it_compiles(cell: Path, command: str) -> None:
    Path("study.yaml").write_text(
        "dwell-study: 1\nname: s\ncell: small.yaml\nseeds: 2\nwindows: 12\n"
        "policies: [LOC]\nscenarios: [baseline]\n",
        encoding="utf-8",
    )
    words = {"run": [str(cell), "--windows", "4000"], "study": ["study.yaml"]}.get(command, [])
    sign = "compiling the simulator, once"
    code, stdout, shown = interrupt_at_first_sign([command, *words], cell.parent, sign=sign)
    assert (code, stdout) == (130, "")
    assert "simulating" not in shown


def test_a_cache_that_cannot_be_written(cell: Path) -> None:
    # Numba then takes the next folder that it knows.
    Path("cache").write_text("no folder", encoding="utf-8")
    run(cell, "first")
    assert Path("cache").read_text(encoding="utf-8") == "no folder"


def test_no_cache_can_be_written_at_all(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = copied(Path("package").resolve(), "0.8")
    (package / "dwell" / "kernels" / "__pycache__").write_text("no folder", encoding="utf-8")
    for name, value in (("PYTHONPATH", package), ("HOME", "/dev/null"), ("NUMBA_CACHE_DIR", "")):
        monkeypatch.setenv(name, str(value))
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null/cache")
    run(cell, "first")
    arguments = ["demo", "--out", "demo"]
    code, _, shown = interrupt_at_first_sign(arguments, cell.parent, sign="each process compiles")
    assert (shown.splitlines()[0][:5], code) == ("note:", 130)


# ----------------------------------------------------------------- versions side by side

# With all that kernels are for: state is carried, and the guard moves.
PLAY = """
import sys
from dataclasses import replace
import dwell

for path in sys.argv[1:]:
    problem = dwell.load(path)
    tasks = {n: replace(t, state_bytes=9) for n, t in problem.pipeline.tasks.items()}
    problem = replace(
        problem,
        pipeline=replace(problem.pipeline, tasks=tasks),
        controller=replace(problem.controller, migration="cold"),
    )
    for scenario in problem.scenarios:
        run = dwell.simulate(problem, scenario=scenario, seed=1, windows=40, jobs=True, guard=True)
"""


def play(package: Path, *cells: Path) -> None:
    command = (sys.executable, "-c", PLAY, *map(str, cells))
    environment = {**os.environ, "PYTHONPATH": str(package)}
    subprocess.run(command, check=True, timeout=300, env=environment)


def copied(folder: Path, version: str) -> Path:
    """Copy the package under another version, with kernels of other sources."""
    package = folder / "dwell"
    shutil.copytree(ROOT / "src" / "dwell", package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "examples").symlink_to(ROOT / "examples")
    start = package / "__init__.py"
    known = f'__version__ = "{dwell.__version__}"'
    text = start.read_text(encoding="utf-8")
    assert known in text
    start.write_text(text.replace(known, f'__version__ = "{version}"'), encoding="utf-8")
    with (package / "kernels" / "nodes.py").open("a", encoding="utf-8") as file:
        file.write(f"\n# {version}\n")
    return folder


def files(cache: Path) -> dict[str, int]:
    """Return when each file of compiled code was written."""
    return {str(path): path.stat().st_mtime_ns for path in cache.rglob("*.nb?")}


def test_after_the_compiler_nobody_compiles_and_versions_stand_side_by_side(
    cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = copied(Path("one").resolve(), "0.8"), copied(Path("two").resolve(), "0.9")
    monkeypatch.setenv("PYTHONPATH", str(one))
    compiling = "from dwell.cli.first_answer import compile_kernels as c; c()"
    subprocess.run((sys.executable, "-c", compiling), check=True, timeout=600)
    cache = cell.parent / "cache"
    written = files(cache)
    examples = [ROOT / "examples" / name for name in ("canonical.yaml", "fan-in.yaml")]
    play(one, *examples, cell)
    run(cell, "first")
    assert files(cache) == written
    assert not compilers(lock_file())

    # The other version finds none of this one's code, nor takes its place.
    monkeypatch.setenv("PYTHONPATH", str(two))
    with locked(lock_file()):
        run(cell, "second")
    assert files(cache) == written
    # Nor does it where it is installed over it.
    shutil.copytree(two / "dwell" / "kernels", one / "dwell" / "kernels", dirs_exist_ok=True)
    monkeypatch.setenv("PYTHONPATH", str(one))
    with locked(lock_file()):
        run(cell, "third")
    assert files(cache) == written
    runs = [dwell.open_run(out) for out in ("first", "second", "third")]
    assert [made.meta["versions"]["dwell"] for made in runs] == ["0.8", "0.9", "0.8"]
    assert all(made.cycles.equals(runs[0].cycles) for made in runs)
