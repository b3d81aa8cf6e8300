"""Work spread over processes: all of it, in order or not, and nothing left behind."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dwell.study.workers import spread

ROOT = Path(__file__).parents[2]


def spread_all(units: list[float], processes: int) -> dict[float, float]:
    found: dict[float, float] = {}
    spread(math.sqrt, units, processes=processes, take=found.__setitem__)
    return found


@pytest.mark.parametrize("processes", [1, 2])
def test_every_unit_comes_back_with_its_result(processes: int) -> None:
    assert spread_all([9.0, 1.0, 4.0], processes) == {9.0: 3.0, 1.0: 1.0, 4.0: 2.0}


def first_of(values: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    return values[0], values[1:]


@pytest.mark.parametrize("processes", [1, 2])
def test_the_rest_of_a_unit_is_a_further_unit(processes: int) -> None:
    found: list[int] = []
    spread(
        first_of,
        [(1, 2, 3), (4,), (5, 6)],
        processes=processes,
        take=lambda _, result: found.append(result[0]),
        rest=lambda result: result[1] or None,
    )
    assert sorted(found) == [1, 2, 3, 4, 5, 6]


def initial_environment(_: int) -> dict[str, str]:
    """Return the variables that this process was started with, whatever it has set since."""
    pairs = Path("/proc/self/environ").read_text(encoding="utf-8").split("\0")
    return dict(pair.split("=", 1) for pair in pairs if "=" in pair)


@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="only Linux shows it")
def test_workers_start_with_one_thread_per_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    monkeypatch.delenv("POLARS_MAX_THREADS", raising=False)
    found: list[dict[str, str]] = []
    spread(initial_environment, [1, 2, 3], processes=2, take=lambda _, known: found.append(known))
    names = ("OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS")
    assert [[known.get(name) for name in names] for known in found] == [["1", "1"]] * 3
    assert [os.environ.get(name) for name in names] == ["7", None]


def test_nothing_to_do_needs_no_process() -> None:
    assert spread_all([], 2) == {}


@pytest.mark.parametrize("processes", [1, 2])
def test_an_interrupt_leaves_no_process_behind(processes: int) -> None:
    def interrupt(_: float, __: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        spread(math.sqrt, [float(i) for i in range(50)], processes=processes, take=interrupt)
    assert not multiprocessing.active_children()


def test_an_error_in_a_process_arrives_as_it_is() -> None:
    with pytest.raises(ValueError, match="math domain"):
        spread_all([1.0, -1.0], 2)
    assert not multiprocessing.active_children()


ENDLESS = """
import multiprocessing
import time
from dwell.study.workers import spread


def take(unit, result):
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)


if __name__ == "__main__":
    spread(time.sleep, [0.0, 1000.0], processes=2, take=take)
"""


def test_workers_end_with_a_process_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "endless.py"
    script.write_text(ENDLESS, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    with subprocess.Popen(
        [sys.executable, script], env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        workers = [int(pid) for pid in process.stdout.readline().split()]
        assert len(workers) == 2
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 60
    while running := [pid for pid in workers if is_running(pid)]:
        assert time.monotonic() < deadline, f"{running} went on without their parent"
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    """Whether a process is there and has not ended; nobody may have collected it yet."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2]
    except FileNotFoundError:
        return False
    return state.split()[0] != "Z"
