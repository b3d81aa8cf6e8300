"""RunsFolder: the runs in a folder, with the numbers of each.

The page shows the names immediately, even of 10,000 runs. A thread reads the runs one after another
and then reads the growing runs again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from dwell.dash.paged_cell import Plain
from dwell.dash.recorded_cell import RecordedCell, policy_of
from dwell.dash.recorded_windows import placement_codes
from dwell.dash.run_verdict import verdict_document
from dwell.dash.strip import bin_starts, plain
from dwell.errors import DwellError, RunError
from dwell.live.failures import start_thread
from dwell.record import Journal, is_fleet, is_run, open_run
from dwell.study.summary import mean_of

#: Most runs of a folder that are listed.
MOST_RUNS = 10_000
#: Opened runs that stay in memory.
MOST_OPEN = 16
#: Most runs in one plot, and most points of each.
MOST_DRAWN, POINTS = 8, 400
#: Time between two readings of the running runs.
EVERY_S = 3.0


class RunsFolder:
    """Runs and fleets of a folder; the place of a run is its index in the order of names.

    Raises `RunError` if the folder contains no run and no fleet.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.name = folder, folder.resolve().name
        found = sorted(_runs_in(folder))
        self.paths, self._more = found[:MOST_RUNS], len(found) - MOST_RUNS
        if not self.paths:
            raise RunError(f"{folder}: contains no run and no fleet")
        self.count = len(self.paths)
        self._rows: list[Plain] = []
        self.cell = lru_cache(MOST_OPEN)(self._open)

    def start(self) -> None:
        """Start to read the runs in a thread."""
        start_thread("runs", self._read_all)

    def described(self) -> Plain:
        """Return the names of the runs."""
        listed = [path.relative_to(self.folder).as_posix() for path in self.paths]
        return {"name": self.name, "runs": listed, "more": max(self._more, 0)}

    def rows(self, since: int) -> Plain:
        """Return the rows from index `since` on; a later row of a run replaces the earlier."""
        upto = len(self._rows)
        return {"rows": self._rows[since:upto], "upto": upto}

    def lines(self, places: Sequence[int]) -> list[Plain]:
        """Return V_D of several runs over time, in per cent; each point is a mean of windows."""
        found = []
        for place in places[:MOST_DRAWN]:
            windows = self.cell(place).contents.windows
            closes, rates = windows.closes, windows.rates
            starts = bin_starts(closes, float(closes[0]), float(closes[-1]) + 1e-9, POINTS)
            counts = np.diff(np.append(starts, len(closes)))
            means = np.add.reduceat(rates, starts) / counts
            found.append(
                {"place": place, "at": plain(closes[starts], 3), "rates": plain(100 * means, 3)}
            )
        return found

    def _open(self, place: int) -> RecordedCell:
        if is_fleet(self.paths[place]):
            raise RunError(f"{self.paths[place]}: a fleet; `dwell dash` shows it by itself")
        return RecordedCell(self.paths[place])

    def _read_all(self) -> None:
        running = []
        for place, path in enumerate(self.paths):
            row = _row(place, path)
            self._rows.append(row)
            if row["state"] == "running":
                running.append((place, row))
        while running:
            time.sleep(EVERY_S)
            again = [(place, row, _row(place, self.paths[place])) for place, row in running]
            self._rows += [new for _, row, new in again if new != row]
            running = [(place, new) for place, _, new in again if new["state"] == "running"]


def _runs_in(folder: Path) -> Iterator[Path]:
    """Yield the runs and fleets in a folder and in folders without a run, two levels down."""
    for path in _folders(folder):
        if is_run(path) or is_fleet(path):
            yield path
        else:
            yield from (below for below in _folders(path) if is_run(below) or is_fleet(below))


def _folders(folder: Path) -> Iterator[Path]:
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir() and not entry.name.startswith("."):
                    yield Path(entry.path)
    except OSError:
        return


def _row(place: int, path: Path) -> Plain:
    """Return the numbers of a run; `state` is done, running, unfinished, fleet or broken."""
    row: Plain = {"place": place, "state": "fleet", "note": ""}
    if is_fleet(path):
        return {**row, "note": f"dwell dash {path}"}
    try:
        return {**row, **_numbers(path)}
    except (DwellError, OSError, ValueError, KeyError) as error:
        return {**row, "state": "broken", "note": _reason(error, path)}


def _reason(error: Exception, path: Path) -> str:
    """Return the first line of an error, with file names relative to the run's folder."""
    text = (str(error) or type(error).__name__).splitlines()[0]
    return text.replace(f"{path}{os.sep}", "")


def _numbers(path: Path) -> Plain:
    run = open_run(path)
    problem, windows = run.problem, run.arrays("windows")
    placed = placement_codes(windows.names("placement"), tuple(problem.candidates))
    state = "done"
    if run.unfinished:
        state = "running" if Journal.written(path) else "unfinished"
    counts = ~windows["warmup"].astype(bool)
    cost = mean_of(windows["cost"].astype(np.float64)[counts]) if counts.any() else np.nan
    found = verdict_document(run, problem)
    verdict, moves = found.get("verdict", {}), found.get("moves", {})
    return {
        "state": state,
        "cell": problem.name,
        "scenario": run.meta.get("scenario"),
        "policy": policy_of(run, placed),
        "seed": run.meta.get("seed"),
        "windows": len(counts),
        "verdict": None if state == "running" else verdict.get("word"),
        "rate": verdict.get("rate"),
        "interval": [verdict.get("low"), verdict.get("high")],
        "cost": None if np.isnan(cost) else cost,
        "moves": sum(moves[name] for name in ("migrations", "guard_moves")) if moves else None,
    }
