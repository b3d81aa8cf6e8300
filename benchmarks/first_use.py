"""First use: `dwell run`, compiling the kernels, loading them, and two processes at once."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.canonical import CELL
from benchmarks.figures import Figure, Goal, Section
from benchmarks.machine import available_cores
from benchmarks.timing import ROOT, run_module


def measure(quick: bool) -> Section:
    """Seconds of the first simulation of a process, with an empty and with a filled cache."""
    rounds = 1 if quick else 2
    firsts, seconds = zip(*(_two_runs() for _ in range(rounds)), strict=True)
    empty: list[dict[str, Any]] = []
    filled: list[dict[str, Any]] = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            for said in (empty, filled):
                text, _took = run_module("benchmarks.first_use", environment=_cache(folder))
                said.append(json.loads(text))
    ratios = [first / second for first, second in zip(firsts, seconds, strict=True)]
    figures = [
        Figure("`dwell run`, 20 windows, empty cache", firsts, "s"),
        Figure("  filled cache", seconds, "s"),
        Figure("  empty / filled", ratios, "×", Goal(high=2.5)),
        Figure("empty cache", [one["cpu_s"] for one in empty], "s", Goal(high=15)),
        Figure("  elapsed", [one["first_s"] for one in empty], "s"),
        Figure("filled cache", [one["cpu_s"] for one in filled], "s"),
        Figure("  elapsed", [one["first_s"] for one in filled], "s"),
        Figure("the same again, elapsed", [one["again_s"] for one in filled], "s"),
    ]
    notes = [f"compiled with a filled cache: {sum(one['misses'] for one in filled)} kernels"]
    if not quick:
        with tempfile.TemporaryDirectory() as folder:
            pair, wall_s = _two_at_once(folder)
            third = json.loads(run_module("benchmarks.first_use", environment=_cache(folder))[0])
            files = sorted(path.suffix for path in Path(folder).rglob("*.nb*"))
        figures.append(Figure("two at once, empty cache", [one["cpu_s"] for one in pair], "s each"))
        figures.append(Figure("  elapsed until both are done", [wall_s], "s"))
        figures.append(Figure("a third after them", [third["cpu_s"]], "s"))
        notes += [
            f"two at once compiled {[one['misses'] for one in pair]} kernels, the third "
            f"{third['misses']}; {files.count('.nbi')} index and {files.count('.nbc')} code files; "
            f"same results: {len({one['l95_ms'] for one in [*pair, third]}) == 1}",
        ]
    notes += [
        "`dwell run`: elapsed; with an empty cache interpreted, while a compiler runs beside it",
        "below it: CPU time of the first `simulate` of a process, imports by it included",
    ]
    return Section("First use: one window of the canonical cell", figures, notes)


def _two_runs() -> tuple[float, float]:
    """Return how long the first `dwell run` takes, and the one after its compiler has ended."""
    with tempfile.TemporaryDirectory() as folder:

        def run(seed: int) -> float:
            words = (
                "run",
                CELL,
                "--windows",
                "20",
                "--seed",
                str(seed),
                "--out",
                f"{folder}/{seed}",
            )
            begin = time.perf_counter()
            subprocess.run(
                (sys.executable, "-m", "dwell", *words),
                check=True,
                env={**os.environ, **_cache(folder)},
                stdout=subprocess.DEVNULL,
            )
            return time.perf_counter() - begin

        first = run(1)
        # The compiler's; it ends with its process.
        (lock,) = Path(folder).rglob("compiling.*.lock")
        with lock.open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
        return first, run(2)


def _cache(folder: str) -> dict[str, str]:
    return {"NUMBA_CACHE_DIR": folder}


def _two_at_once(folder: str) -> tuple[list[dict[str, Any]], float]:
    """Start two processes on one empty cache, each on a core of its own where there are two."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "benchmarks.first_use", "--any-core"]
    processes = [
        subprocess.Popen(
            [*command, str(i)],
            cwd=ROOT,
            env={**os.environ, **_cache(folder)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for i in range(2)
    ]
    said = [json.loads(process.communicate()[0]) for process in processes]
    return said, time.perf_counter() - begin


def _unpin(i: int) -> None:
    """Undo the pinning of the parent: take the i-th of all cores the machine lets us have."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
        cores = available_cores()
        os.sched_setaffinity(0, {cores[i % len(cores)]})


def _run_alone() -> None:
    import dwell

    problem = dwell.load(CELL)
    begin, cpu = time.perf_counter(), time.process_time()
    run = dwell.simulate(problem, policy="dtp", seed=1, windows=1)
    l95_ms = run.windows["l95_ms"][0]
    first, cpu = time.perf_counter(), time.process_time() - cpu
    dwell.simulate(problem, policy="dtp", seed=1, windows=1)
    again = time.perf_counter()
    print(
        json.dumps(
            {
                "first_s": first - begin,
                "cpu_s": cpu,
                "again_s": again - first,
                "l95_ms": l95_ms,
                "misses": _misses(),
            }
        )
    )


def _misses() -> int:
    """Kernels that this process had to compile."""
    from dwell.kernels import advance, streams

    kernels: list[Any] = [advance.advance, streams.ar1_path]
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in kernels)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _unpin(int(sys.argv[-1]))
    _run_alone()
