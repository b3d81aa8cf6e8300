"""The first `dwell run`: what it does where no compiled kernels are cached."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest

import dwell
from tests.cli.test_commands import SMALL

FIND = "from dwell.cli.first_answer import find_kernels as f; k = f(); print(k.folder, k.suffix)"


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a cell in the current folder, in which the kernels' cache is empty."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    path = tmp_path / "small.yaml"
    path.write_text(f"{SMALL}controller: {{estimator: corrected}}\n", encoding="utf-8")
    return path


def run(cell: Path, out: str) -> None:
    words = ("run", cell, "--windows", "12", "--scenario", "stress", "--out", out, "--jobs")
    command = (sys.executable, "-m", "dwell", *words)
    found = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert (found.returncode, found.stderr) == (0, "")


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


def test_a_cache_that_cannot_be_written(cell: Path) -> None:
    # Numba then takes the next folder that it knows.
    Path("cache").write_text("no folder", encoding="utf-8")
    run(cell, "first")
    assert Path("cache").read_text(encoding="utf-8") == "no folder"
