"""Measurement of a task: separately timed runs of one callable.

Two clocks time every run: wall time (``perf_counter_ns``) and, around it, the CPU time of the
process (all threads, no child processes). CPU time / wall time is the number of cores used. The
samples include the overhead of timing; runs of an empty callable measure it, and the profile has it
as ``empty_wall_ms`` and ``empty_cpu_ms``.

The garbage collector stays on unless the measured module turns it off: it is on in a live process,
too, and its pauses belong to the tail. It runs once before the warm-up. `undisturbed_collector`
hides existing objects from it, because the imports of the measurement would slow it down.

The result of a run is freed after the clocks are read. Inputs are made before the wait for the next
release and before the clocks are read.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from dwell.calibration.machine_conditions import MachineConditions, MachineCounters, processor
from dwell.calibration.profile_file import Measurement, stamp, task_name
from dwell.errors import MeasurementError, describe_raised
from dwell.model.bounds import MAX_COUNT, PERIOD_MS, Bound

RUNS = Bound(1, MAX_COUNT, whole=True)
WARMUP = Bound(0, MAX_COUNT, whole=True)
EMPTY_RUNS = 1000


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a measurement.

    Parameters
    ----------
    warmup : int
        Number of discarded runs at the start.
    period_ms : float or None
        Time between the starts of two runs; None starts each run at the end of the last.
    """

    runs: int = 500
    warmup: int = 50
    period_ms: float | None = None

    def __post_init__(self) -> None:
        RUNS.check("runs", self.runs)
        WARMUP.check("warmup", self.warmup)
        if self.period_ms is not None:
            PERIOD_MS.check("period_ms", self.period_ms)


class Pace:
    """Releases at multiples of a period after the first; errors do not add up.

    `wait` returns at once for a past release and counts it as late; later releases do not shift.

    Parameters
    ----------
    period_ms : float or None
        None never waits.
    clock : callable
        Nanoseconds, monotonic.
    sleep : callable
        Takes seconds.
    """

    def __init__(
        self,
        period_ms: float | None,
        clock: Callable[[], int] = time.perf_counter_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._period_ns = None if period_ms is None else round(period_ms * 1e6)
        self._clock = clock
        self._sleep = sleep
        self._next_ns: int | None = None
        self.late = 0

    def wait(self) -> None:
        """Wait for the next release; return at once without a period or after the release."""
        if self._period_ns is None:
            return
        now_ns = self._clock()
        if self._next_ns is None:
            self._next_ns = now_ns
        elif now_ns > self._next_ns:
            self.late += 1
        while (left_ns := self._next_ns - self._clock()) > 0:
            self._sleep(left_ns / 1e9)
        self._next_ns += self._period_ns


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the runs of one callable.

    Parameters
    ----------
    wall_ns, cpu_ns : int64 array, shape (runs,)
        In the order of the runs.
    first_ns : int
        Wall time of the first run, warm-up included.
    late : int
        Runs that started after their release, because earlier runs took too long.
    collections : tuple of int
        Garbage collections during the runs, by generation.
    """

    wall_ns: NDArray[np.int64]
    cpu_ns: NDArray[np.int64]
    first_ns: int
    late: int
    collections: tuple[int, ...]
    conditions: MachineConditions


def time_runs(
    call: Callable[..., object],
    settings: Settings,
    inputs: Callable[[int], object] | None = None,
) -> Timing:
    """Run `call` and time every run.

    Parameters
    ----------
    call : callable
        Takes the result of `inputs`; without `inputs`, no argument.
    inputs : callable, optional
        Called before every run with its number, from 0 (in the warm-up, too): run k has the same
        inputs on every node.

    Raises
    ------
    MeasurementError
        If `call` or `inputs` raises; it names the run.
    """
    pace = Pace(settings.period_ms)
    gc.collect()
    warm_wall, _ = _series(call, inputs, settings.warmup, pace, "run {} of the warm-up")
    pace.late = 0
    watch = MachineCounters(os.sched_getaffinity(0))
    before = [generation["collections"] for generation in gc.get_stats()]
    wall_ns, cpu_ns = _series(call, inputs, settings.runs, pace, "run {}")
    after = [generation["collections"] for generation in gc.get_stats()]
    return Timing(
        wall_ns=wall_ns,
        cpu_ns=cpu_ns,
        first_ns=int((warm_wall if settings.warmup else wall_ns)[0]),
        late=pace.late,
        collections=tuple(late - early for late, early in zip(after, before, strict=True)),
        conditions=watch.conditions(),
    )


def _series(
    call: Callable[..., object],
    inputs: Callable[[int], object] | None,
    count: int,
    pace: Pace,
    what: str,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return wall and CPU time of `count` runs."""
    wall_ns, cpu_ns = np.zeros((2, count), np.int64)
    wall, cpu = time.perf_counter_ns, time.process_time_ns
    arguments: tuple[object, ...] = ()
    run, prepared = 0, True
    try:
        for run in range(count):
            if inputs is not None:
                prepared = False
                arguments = (inputs(run),)
                prepared = True
            pace.wait()
            cpu_start = cpu()
            start = wall()
            result = call(*arguments)
            end = wall()
            cpu_end = cpu()
            wall_ns[run] = end - start
            cpu_ns[run] = cpu_end - cpu_start
            del result
    except (Exception, SystemExit) as error:
        given = "one argument, from --inputs" if inputs else "no arguments (see --inputs)"
        when = what.format(run)
        if not prepared:
            given, when = "the number of the run", f"inputs of {when}"
        # True if the call itself failed, as with wrong arguments, and not code inside it.
        raised_here = error.__traceback__ is not None and error.__traceback__.tb_next is None
        wrong_call = isinstance(error, TypeError) and raised_here
        hint = f"; it is called with {given}" if wrong_call else ""
        raise MeasurementError(f"{when}: {describe_raised(error, users=True)}{hint}") from error
    return wall_ns, cpu_ns


@contextmanager
def undisturbed_collector() -> Iterator[None]:
    """Hide all existing objects from the garbage collector."""
    ours = gc.get_freeze_count() == 0
    if ours:
        gc.freeze()
    try:
        yield
    finally:
        if ours:
            gc.unfreeze()


def measure_task(
    task: str,
    node: str,
    call: Callable[..., object],
    *,
    settings: Settings,
    inputs: Callable[[int], object] | None = None,
    source: str | None = None,
    inputs_source: str | None = None,
) -> Measurement:
    """Measure a task on this node, on the cores that the calling thread may use.

    Parameters
    ----------
    task, node : str
        Names in the cell.
    call, settings, inputs
        See `time_runs`.
    source, inputs_source : str, optional
        Names of `call` and `inputs` in the profile; default: their Python names.

    Returns
    -------
    Measurement
        Column ``task@node``: wall time, ms; ``task@node/cpu_ms``: CPU time of all threads.

    Raises
    ------
    ProfileError
        If a name is not allowed in a cell.
    MeasurementError
        If a run raises; it names the task and the run.
    """
    name = task_name(task, node)
    empty = time_runs(lambda: None, Settings(EMPTY_RUNS))
    try:
        timing = time_runs(call, settings, inputs)
    except MeasurementError as error:
        raise MeasurementError(f"{task}, {error}") from error.__cause__
    wall_ns, cpu_ns = timing.wall_ns, timing.cpu_ns
    about = {
        **stamp(),
        "kind": "task",
        "task": task,
        "node": node,
        "callable": source or _name(call),
        "inputs": inputs_source or (None if inputs is None else _name(inputs)),
        "warmup": settings.warmup,
        "first_ms": timing.first_ns / 1e6,
        "period_ms": settings.period_ms,
        "late": timing.late,
        "cores": sorted(os.sched_getaffinity(0)),
        "processor": processor(),
        "cores_used": float(cpu_ns.sum() / max(wall_ns.sum(), 1)),
        "gc_collections": list(timing.collections),
        "gc_enabled": gc.isenabled(),
        "empty_wall_ms": float(np.median(empty.wall_ns)) / 1e6,
        "empty_cpu_ms": float(np.median(empty.cpu_ns)) / 1e6,
        "conditions": asdict(timing.conditions),
    }
    return Measurement(name, {name: wall_ns / 1e6, f"{name}/cpu_ms": cpu_ns / 1e6}, about)


def _name(call: Callable[..., object]) -> str:
    return getattr(call, "__qualname__", None) or repr(call)
