"""The first answer does not wait for the compiler.

Compiling the simulator takes longer than playing a few windows as plain Python. So where no
compiled kernels are cached and the work is short, the process plays interpreted from its start,
with the same results, while a detached process compiles for the runs after it. Long work compiles
before it begins, once for all the processes that it takes.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from typing import Any

import typer

import dwell
from dwell.cli.output import working
from dwell.model import Problem, QoS

#: Cycles that are played sooner than the kernels are compiled, whatever the cell.
SHORT_CYCLES = 30_000

#: Whether this process is a command of its own: in another one kernels stay as they are.
own_process = False


@dataclass(frozen=True, slots=True)
class Kernels:
    """The compiled kernels of this version on this processor.

    Parameters
    ----------
    folder : Path, optional
        Folder of Numba's cache; None where no folder can hold one.
    suffix : str
        Part of the names of their files that tells versions and processors apart.
    """

    folder: Path | None
    suffix: str

    @property
    def cached(self) -> bool:
        """Whether the event loop is there, which is nearly all that has to be compiled."""
        pattern = f"advance.advance-*.{self.suffix}.*.nbc"
        return self.folder is not None and any(self.folder.glob(pattern))


def find_kernels() -> Kernels:
    """Look where Numba keeps the code of the kernels, before they are imported."""
    from numba.core import caching

    from dwell.kernels.cache_name import cache_suffix

    # Numba chooses the folder by a function's file.
    source = str(Path(dwell.__file__).parent / "kernels" / "advance.py")
    namespace: dict[str, Any] = {}
    exec(compile("def advance(): pass", source, "exec"), namespace)  # noqa: S102
    try:
        cache: Any = caching.CompileResultCacheImpl
        place = cache(namespace["advance"]).locator.get_cache_path()
    except RuntimeError:
        return Kernels(None, cache_suffix())
    return Kernels(Path(place), cache_suffix())


def prepare(cycles: int) -> str | None:
    """Choose, before the simulator is imported, how this process plays so many cycles.

    Returns
    -------
    str or None
        A remark for the user; None where compiled kernels are there.
    """
    kernels = None if "dwell.kernels.compiled" in sys.modules else _uncompiled()
    if kernels is None:
        return None
    if cycles > SHORT_CYCLES:
        _compile(kernels)
        return None
    _numba_config().DISABLE_JIT = 1
    if kernels.folder is None:
        return "no folder can keep the compiled simulator: interpreting it"
    started = _start_compiler(kernels.folder, kernels.suffix)
    return f"interpreting the simulator; {'' if started else 'no '}compiler runs beside it"


def compile_first() -> None:
    """Compile before several processes begin, each of which would have to."""
    kernels = _uncompiled()
    if kernels is None:
        return
    if kernels.folder is None:
        typer.echo(
            "note: no folder can keep the compiled simulator: each process compiles", err=True
        )
    else:
        _compile(kernels)


def _uncompiled() -> Kernels | None:
    """Return where this process has to compile to; None where it need not."""
    if not own_process or _numba_config().DISABLE_JIT:
        return None
    kernels = find_kernels()
    return None if kernels.cached else kernels


def _numba_config() -> Any:
    """Return Numba's configuration, whose settings its types do not know."""
    from numba.core import config

    return config


def _compile(kernels: Kernels) -> None:
    nowhere = "" if kernels.folder else ": no folder can keep it"
    with working(f"compiling the simulator{nowhere or ', once'}"):
        compile_kernels()


def _start_compiler(folder: Path, suffix: str) -> bool:
    """Start the process that compiles, but where there is one; return whether one runs now.

    The process inherits the lock, which ends with it, however it ends.
    """
    import fcntl

    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / f"compiling.{suffix}.lock", os.O_RDWR | os.O_CREAT, 0o666)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        subprocess.Popen(
            (sys.executable, "-m", "dwell.cli.first_answer"),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # Where this package is found, installed or not, and no folder of the user's is held.
            cwd=Path(dwell.__file__).parents[1],
            env=_environment(),
            pass_fds=(lock,),
            start_new_session=True,
        )
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(lock)
    return True


def _environment() -> dict[str, str]:
    """Return that of this process, with a cache folder that another current folder leaves."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    return {**os.environ, **({"NUMBA_CACHE_DIR": str(Path(given).resolve())} if given else {})}


class _Restless:
    """The policy that moves at every close."""

    def start(self, problem: Problem) -> None:
        self.placements = cycle(problem.candidates)

    def decide(self, *, observed: QoS, estimates: Mapping[str, QoS]) -> str:
        return next(self.placements)


def compile_kernels() -> None:
    """Compile every kernel, and have Numba keep the code."""
    from dwell.cli.examples import find_examples
    from dwell.study.summary import summarise

    problem = dwell.load(find_examples(None) / "canonical.yaml")
    # Steps of a cold migration, and the state that it carries, have kernels of their own.
    tasks = problem.pipeline.tasks
    stateful = {name: replace(task, state_bytes=1000) for name, task in tasks.items()}
    problem = replace(
        problem,
        pipeline=replace(problem.pipeline, tasks=stateful),
        controller=replace(problem.controller, migration="cold"),
    )
    windows = problem.warmup_windows + 2
    run = dwell.simulate(problem, policy=_Restless(), seed=1, windows=windows)
    summarise(run, problem, {})  # the servo's loop


if __name__ == "__main__":
    with suppress(OSError):
        os.nice(19)
    compile_kernels()
