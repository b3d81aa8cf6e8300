"""Time what is to be compared in turns, so that a machine's moods fall on all of it alike."""

from __future__ import annotations

import gc
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

#: Folder from which `python -m benchmarks...` works.
ROOT = Path(__file__).resolve().parents[1]

CPP = ("g++", "-O3", "-march=native", "-std=c++17")

Key = TypeVar("Key")


@dataclass(frozen=True, slots=True)
class Took:
    """Elapsed time and CPU time of one piece of work, and how much of the latter was the system's.

    The system's part is mostly page faults: memory that the process touches for the first time.
    """

    wall_s: float
    cpu_s: float
    system_s: float = 0.0

    def __add__(self, other: Took) -> Took:
        return Took(
            self.wall_s + other.wall_s,
            self.cpu_s + other.cpu_s,
            self.system_s + other.system_s,
        )

    def __sub__(self, other: Took) -> Took:
        return Took(
            self.wall_s - other.wall_s,
            self.cpu_s - other.cpu_s,
            self.system_s - other.system_s,
        )


class Stopwatch:
    """Times one piece of work after another; begins with nothing for the garbage collector."""

    def __init__(self) -> None:
        gc.collect()
        self.last = _now()

    def lap(self) -> Took:
        """Time since the lap before, or since the beginning."""
        now = _now()
        passed, self.last = now - self.last, now
        return passed


def _now() -> Took:
    system_s = resource.getrusage(resource.RUSAGE_SELF).ru_stime
    return Took(time.perf_counter(), time.process_time(), system_s)


def took(work: Callable[[], object]) -> Took:
    """Time one piece of work."""
    stopwatch = Stopwatch()
    work()
    return stopwatch.lap()


def in_turns(
    variants: Mapping[Key, Callable[[], Took]], rounds: int, *, warm_up: bool = True
) -> dict[Key, list[Took]]:
    """Run every variant once a round, beginning with another one each time.

    Parameters
    ----------
    variants : mapping
        Functions that do the work and say what it took.
    rounds : int
    warm_up : bool
        Whether a round that does not count goes ahead.
    """
    keys = list(variants)
    if warm_up:
        for key in keys:
            variants[key]()
    results: dict[Key, list[Took]] = {key: [] for key in keys}
    for i in range(rounds):
        begin = i % len(keys)
        for key in keys[begin:] + keys[:begin]:
            results[key].append(variants[key]())
    return results


def ratios(numerator: Iterable[float], denominator: Iterable[float]) -> list[float]:
    """Quotients, round by round."""
    return [one / other for one, other in zip(numerator, denominator, strict=True)]


def shared_core(runs: Iterable[Took]) -> list[str]:
    """Return a note on how much of the elapsed time the core was ours, and on the system's part."""
    total = sum(runs, start=Took(0.0, 0.0))
    share = total.cpu_s / total.wall_s
    text = f"CPU time; {share:.0%} of the elapsed time"
    text += "" if share > 0.9 else ", as others used the core"
    return [f"{text}; {total.system_s / total.cpu_s:.0%} of it was the system's"]


def run_program(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    folder: Path = ROOT,
) -> str:
    """Run a program in a folder, else that of the project, and return what it printed.

    Raises
    ------
    RuntimeError
        If it fails, with what it said.
    """
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = done.stderr.strip() or done.stdout.strip()
        raise RuntimeError(f"{' '.join(command)} failed ({done.returncode}):\n{said}")
    return done.stdout


def run_module(
    name: str, *arguments: str, environment: Mapping[str, str] | None = None
) -> tuple[str, Took]:
    """Run ``python -m name`` and return what it printed and what the whole process took."""
    return run_timed([sys.executable, "-m", name, *arguments], environment)


def run_timed(
    command: Sequence[str],
    environment: Mapping[str, str] | None = None,
    folder: Path = ROOT,
) -> tuple[str, Took]:
    """Run a program and return what it printed and what its processes took."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall = time.perf_counter()
    said = run_program(command, environment, folder)
    wall = time.perf_counter() - wall
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return said, Took(wall, cpu)


def compile_cpp_loop(folder: Path) -> str:
    """Compile the peers' C++ loop into a folder and return the program's path."""
    program = str(folder / "cpp_loop")
    run_program([*CPP, "-o", program, str(ROOT / "benchmarks" / "peers" / "cpp_loop.cpp")])
    return program
