"""CPU time of a cell with a fast and a slow loop over the time of two cells with one loop each."""

from __future__ import annotations

from collections.abc import Iterator

import dwell
from benchmarks.figures import Figure, Goal, Section
from benchmarks.timing import ROOT, Stopwatch
from dwell.cellfile import from_document
from dwell.kernels.advance import play
from dwell.kernels.arrays import lay_out
from dwell.kernels.codes import Status
from dwell.model import Problem
from dwell.model.document import to_document

CELL = ROOT / "examples" / "inner-loop.yaml"
#: Tasks of the loop at the base rate and of the slower loop, and base cycles per cycle.
LOOPS = {"control": (("imu", "control"), 1), "detector": (("camera", "detect"), 10)}
BASE_MS = 10.0
#: Candidate of all simulations: all tasks on the robot.
PLACED = "ROBOT"
#: Base cycles: 20 windows, 100, the default number of 300, and 1,000.
LENGTHS = (4_000, 20_000, 60_000, 200_000)
PARTS = ("draw", "lay out", "kernel", "simulate, with the table of windows")
#: Sums of parts whose ratio is shown.
RATIOS = {"draw and kernel": (0, 2), "draw and simulate": (0, 3)}
GOAL = Goal(high=1.3)


def measure(quick: bool) -> Section:
    """Least CPU time of each part of a simulation, per cell, and the ratios of sums."""
    both = dwell.load(CELL)
    apart = {name: _loop(both, *loop) for name, loop in LOOPS.items()}
    figures: list[Figure] = []
    for cycles in LENGTHS[:2] if quick else LENGTHS:
        figures += _compared(both, apart, cycles, rounds=5 if quick else 20)
    return Section("Two loops in one cell over two cells", figures, ["the least of all rounds"])


def _compared(
    both: Problem, apart: dict[str, Problem], cycles: int, rounds: int
) -> Iterator[Figure]:
    cells = {"both loops": both, **apart}
    runs = [[_parts_ms(one, cycles) for one in cells.values()] for _ in range(rounds)]
    # Other processes only add to a time.
    best = [[min(part) for part in zip(*of, strict=True)] for of in zip(*runs, strict=True)]
    for name, taken in zip(cells, best, strict=True):
        for part, ms in zip(PARTS, taken, strict=True):
            yield Figure(f"{cycles} cycles, {name}: {part}", [ms], "ms")
    together, *single = best
    for name, parts in RATIOS.items():
        two = sum(one[part] for one in single for part in parts)
        ratio = sum(together[part] for part in parts) / two
        yield Figure(f"{cycles} cycles: {name}, over two cells", [ratio], "times", GOAL)


def _loop(both: Problem, names: tuple[str, ...], base_cycles: int) -> Problem:
    """Return the cell that has some of the tasks, all of which run in each of its cycles."""
    document = to_document(both)
    for name in document["tasks"].keys() - set(names):
        del document["tasks"][name]
        for placed in document["candidates"].values():
            placed.pop(name, None)
    for task in document["tasks"].values():
        task.pop("every", None)
    document["flows"] = [one for one in document["flows"] if {one["from"], one["to"]} <= {*names}]
    if not any(document["candidates"].values()):
        document["candidates"] = {PLACED: {}}
    for key in ("chains", "live", "scenarios"):
        del document[key]
    document["period_ms"] *= base_cycles
    document["deadline_ms"] *= base_cycles
    document["window_cycles"] //= base_cycles
    return from_document(document)


def _parts_ms(problem: Problem, base_cycles: int) -> list[float]:
    """Return the CPU time of each of `PARTS`."""
    windows = round(base_cycles * BASE_MS / problem.pipeline.period_ms / problem.window_cycles)
    watch = Stopwatch()
    real = dwell.draw(problem, seed=1, windows=windows)
    laps = [watch.lap()]
    arrays = lay_out([(problem, real)])
    laps.append(watch.lap())
    while play(arrays) != Status.FINISHED:
        pass
    laps.append(watch.lap())
    run = dwell.simulate_realisation(problem, real, policy=PLACED, estimator="profile")
    assert run.windows.height == windows
    laps.append(watch.lap())
    return [1e3 * lap.cpu_s for lap in laps]
