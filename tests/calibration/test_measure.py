"""Measuring: which runs are kept, what counts, and what is left as it was.

Times are only compared with what the same clock shows around them, or with what a run waited for.
"""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from dwell.calibration.measure import (
    Pace,
    Settings,
    measure_task,
    time_runs,
    undisturbed_collector,
)
from dwell.calibration.pinning import pinned
from dwell.errors import MeasurementError, ProblemError, ProfileError

MS = 1_000_000


def burn(ms: float) -> None:
    """Use this much CPU time of this thread."""
    until = time.thread_time_ns() + ms * MS
    while time.thread_time_ns() < until:
        pass


def test_runs_come_in_order_after_the_warm_up() -> None:
    seen: list[object] = []
    timing = time_runs(seen.append, Settings(runs=5, warmup=3), inputs=lambda run: run)
    assert seen == [0, 1, 2, 0, 1, 2, 3, 4]
    assert len(timing.wall_ns) == len(timing.cpu_ns) == 5


def test_without_inputs_nothing_is_given() -> None:
    calls: list[tuple[object, ...]] = []
    time_runs(lambda *given: calls.append(given), Settings(runs=2, warmup=1))
    assert calls == [(), (), ()]


def test_every_run_has_its_own_times() -> None:
    costs_ms = [4, 1, 8, 2]
    start, cpu_start = time.perf_counter_ns(), time.process_time_ns()
    timing = time_runs(burn, Settings(runs=4, warmup=0), inputs=costs_ms.__getitem__)
    elapsed, cpu_elapsed = time.perf_counter_ns() - start, time.process_time_ns() - cpu_start
    for wall_ns, cpu_ns, cost_ms in zip(timing.wall_ns, timing.cpu_ns, costs_ms, strict=True):
        assert wall_ns >= cost_ms * MS
        assert cpu_ns >= cost_ms * MS
    # What a run took is in no other one.
    assert sum(timing.wall_ns) <= elapsed
    assert sum(timing.cpu_ns) <= cpu_elapsed
    assert timing.first_ns == timing.wall_ns[0]


def test_only_the_run_stands_between_the_clocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU clock, which is slow to read, stands outside of the other one."""
    events: list[str] = []
    mine = threading.current_thread()

    def logged(name: str, clock: Callable[[], int]) -> Callable[[], int]:
        def read() -> int:
            # Other tests' threads read clocks, too.
            if threading.current_thread() is mine:
                events.append(name)
            return clock()

        return read

    class Result:
        def __init__(self, _: object) -> None:
            events.append("run")

        def __del__(self) -> None:
            events.append("freed")

    monkeypatch.setattr(time, "perf_counter_ns", logged("wall", time.perf_counter_ns))
    monkeypatch.setattr(time, "process_time_ns", logged("cpu", time.process_time_ns))
    time_runs(Result, Settings(runs=2, warmup=0), inputs=lambda _: events.append("inputs"))
    assert events == ["inputs", "cpu", "wall", "run", "wall", "cpu", "freed"] * 2


def test_threads_of_a_run_count_as_its_cpu_time() -> None:
    def two() -> None:
        threads = [threading.Thread(target=burn, args=(3,)) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    timing = time_runs(two, Settings(runs=3, warmup=0))
    assert min(timing.cpu_ns) >= 6 * MS


def test_waiting_takes_wall_time_only() -> None:
    measured = measure_task("t", "n", lambda: time.sleep(0.02), settings=Settings(3, 0))
    assert measured.samples.min() >= 20
    assert measured.about["cores_used"] < 1


def test_the_first_call_is_kept_apart() -> None:
    costs_ms = iter([10, 0, 0])
    timing = time_runs(lambda: burn(next(costs_ms)), Settings(runs=2, warmup=1))
    assert timing.first_ns >= 10 * MS


def test_a_run_sees_the_cores_it_was_given() -> None:
    core = min(os.sched_getaffinity(0))
    seen = []
    with pinned({core}):
        measured = measure_task(
            "t", "n", lambda: seen.append(os.sched_getaffinity(0)), settings=Settings(2, 1)
        )
    assert seen == [{core}] * 3
    assert measured.about["cores"] == [core]


def raising(at: int) -> Callable[[int], None]:
    def call(run: int) -> None:
        if run == at:
            raise ValueError("no frame\nand more")

    return call


@pytest.mark.parametrize(
    ("call", "inputs", "words"),
    [
        (raising(2), lambda run: run, r"^run 2: ValueError: no frame \(test_measure.py:\d+\)$"),
        (lambda _: None, raising(2), "^inputs of run 2: ValueError: no frame"),
        (lambda: None, lambda run: run, "^run 0: TypeError: .* one argument, from --inputs"),
        (lambda _: None, None, "^run 0: TypeError: .* no arguments"),
        (lambda _: None, lambda: None, "^inputs of run 0: TypeError: .* the number of the run"),
        (lambda: int("x"), None, "^run 0: ValueError: invalid literal"),
        (lambda: exec("raise SystemExit"), None, "^run 0: SystemExit"),
    ],
)
def test_a_run_that_raises_is_named(
    call: Callable[..., object], inputs: Callable[[int], object] | None, words: str
) -> None:
    with pytest.raises(MeasurementError, match=words):
        time_runs(call, Settings(runs=4, warmup=0), inputs)


def test_a_warm_up_that_raises_is_named() -> None:
    with pytest.raises(MeasurementError, match=r"^t, run 1 of the warm-up: ValueError") as caught:
        measure_task("t", "n", raising(1), settings=Settings(1, 3), inputs=lambda run: run)
    assert isinstance(caught.value.__cause__, ValueError)


def test_ctrl_c_is_no_failure_of_the_task() -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        time_runs(interrupted, Settings(1, 0))


@pytest.mark.parametrize("settings", [{"runs": 0}, {"warmup": -1}, {"period_ms": 0.0}])
def test_settings_have_bounds(settings: dict[str, float]) -> None:
    with pytest.raises(ProblemError, match=next(iter(settings))):
        Settings(**settings)  # type: ignore[arg-type]


@pytest.mark.parametrize(("task", "node"), [("a@b", "R1"), ("", "R1"), ("t", "R->E"), ("t", "a/b")])
def test_names_are_those_of_cells(task: str, node: str) -> None:
    with pytest.raises(ProfileError, match="is not a name"):
        measure_task(task, node, lambda: None, settings=Settings(1, 0))


def test_the_measurement_says_how_it_was_made() -> None:
    measured = measure_task(
        "t",
        "n",
        raising(-1),
        settings=Settings(runs=6, warmup=2, period_ms=0.5),
        inputs=lambda run: run,
        source="m:f",
    )
    assert measured.name == "t@n"
    assert {name: len(values) for name, values in measured.columns.items()} == {
        "t@n": 6,
        "t@n/cpu_ms": 6,
    }
    about = measured.about
    assert (about["callable"], about["warmup"], about["period_ms"]) == ("m:f", 2, 0.5)
    assert about["gc_enabled"] is gc.isenabled()
    assert about["empty_wall_ms"] > 0
    wall, cpu = measured.columns.values()
    assert about["cores_used"] == pytest.approx(np.sum(cpu) / np.sum(wall))


# ------------------------------------------------------------------------- garbage collection


def test_collections_are_counted() -> None:
    def litter() -> None:
        for _ in range(5000):
            cycle: list[object] = []
            cycle.append(cycle)

    assert gc.isenabled()
    assert sum(time_runs(litter, Settings(3, 0)).collections) > 0
    assert sum(time_runs(lambda: None, Settings(3, 0)).collections) == 0


@pytest.fixture
def _nothing_is_frozen() -> Iterator[None]:
    """Have the collector look at what conftest.py keeps from it."""
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.mark.usefixtures("_nothing_is_frozen")
def test_objects_from_before_are_not_looked_at() -> None:
    before = gc.get_freeze_count()
    mine: list[object] = [[]]
    with undisturbed_collector():
        assert gc.get_freeze_count() > before
        assert all(one is not mine for one in gc.get_objects())
    assert gc.get_freeze_count() == before
    assert any(one is mine for one in gc.get_objects())


def test_what_somebody_else_froze_stays_frozen() -> None:
    gc.freeze()
    count = gc.get_freeze_count()
    with undisturbed_collector():
        pass
    assert gc.get_freeze_count() == count


# --------------------------------------------------------------------------------------- pace


class Clock:
    """A clock that only goes when somebody sleeps or works."""

    def __init__(self) -> None:
        self.now_ns = 7 * MS

    def read(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        # Sleeping a little too long, as everybody does.
        self.now_ns += round(seconds * 1e9) + 50_000

    def paced(self, period_ms: float | None, work_ms: list[float]) -> tuple[list[float], int]:
        """Return when each run began, ms after the first, and how many were late."""
        pace = Pace(period_ms, self.read, self.sleep)
        begun = []
        for work in work_ms:
            pace.wait()
            begun.append(self.now_ns)
            self.now_ns += round(work * MS)
        return [(instant - begun[0]) / MS for instant in begun], pace.late


def test_releases_do_not_drift() -> None:
    begun, late = Clock().paced(10, [1] * 100)
    # Each oversleeps by 0.05 ms: none of it adds up.
    assert begun == pytest.approx([0, *(10 * run + 0.05 for run in range(1, 100))])
    assert late == 0


def test_a_late_run_begins_at_once_and_shifts_nobody() -> None:
    begun, late = Clock().paced(10, [25, 1, 1, 1])
    assert begun == pytest.approx([0, 25, 26, 30.05])
    assert late == 2


def test_without_a_pace_nobody_waits() -> None:
    begun, late = Clock().paced(None, [3, 4, 5])
    assert (begun, late) == ([0, 3, 7], 0)


def test_paced_runs_never_begin_before_their_release() -> None:
    begun: list[int] = []
    start = time.perf_counter_ns()
    timing = time_runs(lambda: begun.append(time.perf_counter_ns()), Settings(5, 2, 3.0))
    assert len(begun) == 7
    assert all(instant >= start + 3 * MS * run for run, instant in enumerate(begun))
    assert 0 <= timing.late <= 5
