"""A real cell at 25 Hz for an hour: what every process has of memory, open files and threads.

``python -m tests.live.soak --minutes 60 --out soak.csv`` looks every ten seconds, and fits
straight lines through what follows the first tenth, and the first minutes, in which tables of
bounded length fill up (the last thousand cycles, for one). It fails where memory grows by more than
its bound, or where a process has ended; after half an hour, also where the interval of the slope
does not show that it keeps to it. Files and threads are counted: what opens one more when it first
hears of something has taken a step, and no line describes it; a leak takes one step after another.
``--table`` judges a file that is there.
"""

from __future__ import annotations

import argparse
import csv
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import psutil

from dwell.errors import DwellError, LiveError
from dwell.live.local.processes import expected
from dwell_lab.chaos.harness import Harness
from dwell_lab.chaos.light_cell import PERIOD_MS
from tests.live.real_cell import RealCell

HOME = "SO"
#: One second each.
WINDOW_CYCLES = 25
EVERY_S = 10.0
#: Most that each process may grow by in an hour. The controller keeps all that it has decided until
#: its run is sealed: 3 600 windows an hour here.
BOUNDS = {"rss_mb": 4.0, "fds": 2.0, "threads": 2.0}
#: Of these the bound is one of the difference between the beginning and the end.
COUNTED = ("fds", "threads")
CONTROLLER_MB = 24.0
#: Stretches of the time that are averaged: what comes of memory now depends on what it was before,
#: but means of stretches hardly on one another.
STRETCHES = 12
#: 97.5 % point of Student's distribution with `STRETCHES` - 2 degrees of freedom.
STUDENT = 2.228
#: Minutes from which on a slope has to be shown to keep to its bound.
LONG_MINUTES = 30.0
#: In which the tables fill up; a run that is hardly longer is not judged.
SETTLE_S = 120.0
START_S = 60.0

Rows = dict[str, list[tuple[float, dict[str, float]]]]


class Slope(NamedTuple):
    """What something grows by in an hour, and the ends of its 95 % interval."""

    an_hour: float
    low: float
    high: float


def slope_of(times_s: Sequence[float], values: Sequence[float]) -> Slope:
    """Fit a line through the means of `STRETCHES` stretches.

    Raises
    ------
    ValueError
        If there are fewer values than two a stretch.
    """
    each = len(values) // STRETCHES
    if each < 2:
        raise ValueError(f"{len(values)} values; a slope takes {2 * STRETCHES}")
    begins = range(len(values) - each * STRETCHES, len(values), each)
    x = [statistics.fmean(times_s[begin : begin + each]) / 3_600 for begin in begins]
    y = [statistics.fmean(values[begin : begin + each]) for begin in begins]
    slope, at_zero = statistics.linear_regression(x, y)
    spread = sum((there - statistics.fmean(x)) ** 2 for there in x)
    left = sum((value - at_zero - slope * there) ** 2 for there, value in zip(x, y, strict=True))
    half = STUDENT * (left / (STRETCHES - 2) / spread) ** 0.5
    return Slope(slope, slope - half, slope + half)


def bound_of(who: str, what: str) -> float:
    """Most that something of a process may grow by in an hour."""
    return CONTROLLER_MB if what == "rss_mb" and who.startswith("controller") else BOUNDS[what]


def verdicts(rows: Rows, minutes: float) -> Iterator[tuple[str, str, Slope, float, str]]:
    """Yield process, what, slope, last value, and what is wrong with it, or nothing."""
    for who, seen in rows.items():
        begin_s = seen[0][0] + max((seen[-1][0] - seen[0][0]) / 10, SETTLE_S)
        later = [(at_s, found) for at_s, found in seen if at_s >= begin_s]
        for what in BOUNDS:
            slope = slope_of([at_s for at_s, _ in later], [found[what] for _, found in later])
            wrong = ""
            if what in COUNTED:
                tenth = len(later) // 10 + 1
                first, last = (
                    statistics.median(found[what] for _, found in part)
                    for part in (later[:tenth], later[-tenth:])
                )
                wrong = "grows" if last - first > bound_of(who, what) else ""
            elif slope.low > bound_of(who, what):
                wrong = "grows"
            elif slope.high > bound_of(who, what) and minutes >= LONG_MINUTES:
                wrong = "may grow"
            yield who, what, slope, later[-1][1][what], wrong


def table(rows: Rows, minutes: float) -> tuple[list[str], bool]:
    """Return the lines of a table, and whether all is well."""
    lines = [
        "| process | what | last | grows in an hour (95 % interval) | at most | |",
        "|---|---|---|---|---|---|",
    ]
    well = True
    for who, what, slope, last, wrong in verdicts(rows, minutes):
        interval = f"{slope.an_hour:.2f} ({slope.low:.2f} to {slope.high:.2f})"
        bound = bound_of(who, what)
        lines.append(f"| {who} | {what} | {last:.1f} | {interval} | {bound:g} | {wrong} |")
        well = well and not wrong
    return lines, well


# ---------------------------------------------------------------------------------- cell


def look(processes: Mapping[str, psutil.Process]) -> dict[str, dict[str, float]]:
    """Return what every process has now.

    Raises
    ------
    LiveError
        If one has ended.
    """
    found = {}
    for who, process in processes.items():
        try:
            with process.oneshot():
                found[who] = {
                    "rss_mb": process.memory_info().rss / 1e6,
                    "fds": float(process.num_fds()),
                    "threads": float(process.num_threads()),
                }
        except psutil.NoSuchProcess:
            raise LiveError(f"{who} has ended") from None
    return found


def soak(path: Path, minutes: float, every_s: float) -> None:
    """Run the cell, and write what is seen.

    Raises
    ------
    LiveError
        If it does not start, a process ends, or it stops actuating.
    """
    with ExitStack() as stack:
        temporary = stack.enter_context(tempfile.TemporaryDirectory(prefix="dwell-soak-"))
        file = stack.enter_context(path.open("w", newline=""))
        folder = Path(temporary) / "cell"
        with RealCell(HOME, folder, seed=1, name="soak", window_cycles=WINDOW_CYCLES) as cell:
            writer = csv.writer(file)
            writer.writerow(["at_s", "process", *BOUNDS])
            cell.wait_for("the whole cell at home", cell.at_home, START_S)
            names = [*expected(cell.problem), *cell.testbed.processes.running]
            processes = {who: psutil.Process(cell.pid(who)) for who in dict.fromkeys(names)}
            begun_s = time.monotonic()
            before = _actuated(cell)
            for turn in range(round(60 * minutes / every_s) + 1):
                time.sleep(max(begun_s + turn * every_s - time.monotonic(), 0.0))
                at_s = time.monotonic() - begun_s
                for who, found in look(processes).items():
                    writer.writerow(
                        [f"{at_s:.1f}", who, *(f"{found[what]:.3f}" for what in BOUNDS)]
                    )
                file.flush()
            lasted_s = time.monotonic() - begun_s
            share = (_actuated(cell) - before) / (lasted_s * 1e3 / PERIOD_MS)
            print(f"{share:.2%} of the cycles were actuated in {lasted_s / 60:.1f} minutes")


def _actuated(cell: Harness) -> int:
    cell.actuations.look()
    return len(cell.actuations.applied)


def read(path: Path) -> Rows:
    """Return what a file has, by process."""
    rows: Rows = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            values = {what: float(row[what]) for what in BOUNDS}
            rows.setdefault(row["process"], []).append((float(row["at_s"]), values))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("soak.csv"))
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--every", type=float, default=EVERY_S, help="seconds between two looks")
    parser.add_argument("--table", action="store_true", help="judge what there is, run nothing")
    asked = parser.parse_args(arguments)
    if not asked.table:
        # Whoever ends this ends the cell, too.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
        try:
            soak(asked.out, asked.minutes, asked.every)
        except DwellError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    rows = read(asked.out)
    minutes = max(seen[-1][0] - seen[0][0] for seen in rows.values()) / 60
    try:
        lines, well = table(rows, minutes)
    except ValueError as error:
        print(f"too short to be judged: {error} after the first {SETTLE_S / 60:g} minutes")
        return 0
    print("\n".join(lines))
    return int(not well)


if __name__ == "__main__":
    sys.exit(main())
