"""RecordedCell: the folder of a run on the page; another process may still write the run."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dwell.dash.paged_cell import (
    MOST_WITH_JOBS,
    Plain,
    TimedCycle,
    Unit,
    cell_document,
    jobs_document,
)
from dwell.dash.recorded_events import (
    RecordedEvents,
    bands_of,
    disturbance_events,
    disturbances_met,
    disturbed_at,
    merged,
)
from dwell.dash.recorded_windows import RecordedWindows, placement_codes
from dwell.dash.run_verdict import verdict_document
from dwell.dash.strip import Strip, binned_means, difference_of_misses, plain
from dwell.errors import RunError
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats
from dwell.record import Run, open_run

#: Number of cycles before a place to search for the newest cycle in effect.
LOOK_BACK = 4_000
#: Facts of a run that the page shows; policy for which the page shows the placement.
ABOUT, STATIC = ("kind", "scenario", "policy", "estimator", "seed"), "Static"
#: Pause before a growing run is read again: this multiple of the reading time, and at least 1 s.
REST, LEAST_REST_S = 5.0, 1.0


class RecordedCell:
    """A recorded run on the page (see `PagedCell`); `unit` is the unit of its time line.

    Raises `RunError` if the folder is no run, is damaged, or has no cycles.
    """

    live = False

    def __init__(self, folder: Path, unit: Unit = "s") -> None:
        self.folder, self.unit = folder, unit
        self._reading = threading.Lock()
        self._size, self._read_again_s = self._bytes(), 0.0
        self.contents = self._read()

    def _bytes(self) -> int:
        """Return the total size of the folder's files."""
        return sum(file.stat().st_size for file in self.folder.glob("*") if file.is_file())

    def _read(self) -> _Contents:
        began_s = time.monotonic()
        contents = _Contents(open_run(self.folder), self.unit, self.folder.resolve().name)
        took_s = time.monotonic() - began_s
        self._read_again_s = time.monotonic() + max(REST * took_s, LEAST_REST_S)
        return contents

    def refreshed(self) -> bool:
        """See `PagedCell`; if reading fails, the next call tries again."""
        if not self.contents.growing or time.monotonic() < self._read_again_s:
            return False
        with self._reading:
            size = self._bytes()
            if size == self._size:
                return False
            try:
                self.contents = self._read()
            except (RunError, OSError):
                self._read_again_s = time.monotonic() + LEAST_REST_S
                return False
            self._size = size
        return True

    @property
    def run(self) -> Run:
        """The run as last read."""
        return self.contents.run

    def described(self) -> Plain:
        """See `PagedCell`."""
        return self.contents.described()

    def view(self, begin: float, end: float, bins: int) -> Plain:
        """See `PagedCell`."""
        return self.contents.view(begin, end, bins)

    def state(self, at: float) -> Plain:
        """See `PagedCell`."""
        return self.contents.state(at)

    def jobs(self, begin: float, end: float) -> Plain:
        """See `PagedCell`."""
        return self.contents.jobs(begin, end)


def difference(
    one: RecordedCell, other: RecordedCell, begin: float, end: float, bins: int
) -> Plain:
    """Return V_D of the second run minus V_D of the first between two places, per bin."""
    first, second = one.contents, other.contents
    length = max(first.window, second.window)
    return difference_of_misses(second.strip, first.strip, begin, end, bins, length)


def policy_of(run: Run, placed: NDArray[np.int32]) -> str | None:
    """Return the name of the policy; for a run that never moves, the name of its placement.

    `placed` has the index of each window's placement in the candidates.
    """
    policy = run.meta.get("policy")
    if policy is None:
        return None
    name = str(policy).partition("(")[0].strip()
    if name == STATIC and len(placed) and (placed == placed[0]).all():
        return f"{list(run.problem.candidates)[placed[0]]}, without moves"
    return name


def same_realisation(one: Run, other: Run) -> bool:
    """Whether two runs are simulated with the same random samples, cycle by cycle."""
    simulated = one.is_simulated and other.is_simulated
    drawn = [(run.meta.get("seed"), run.meta.get("scenario")) for run in (one, other)]
    return simulated and drawn[0] == drawn[1] and one.problem.drawn == other.problem.drawn


class _Contents:
    """The tables of a run as arrays, on its time line."""

    def __init__(self, run: Run, unit: Unit, source: str) -> None:
        self.run, self.unit, self.source, self.problem = run, unit, source, run.problem
        self.growing = run.unfinished
        self._candidates = tuple(self.problem.candidates)
        cycles, counted = run.arrays("cycles"), slice(run.last_window_end)
        self._release_ns = cycles["release_ns"][counted].astype(np.int64, copy=False)
        if not len(self._release_ns):
            raise RunError(f"{source}: this run has no cycles yet")
        latency_ms = cycles["latency_ns"][counted] / 1e6
        latency_ms[latency_ms >= NEVER_NS / 1e6] = np.nan
        self._cycle = cycles["cycle"][counted].astype(np.int64, copy=False)
        seconds = np.maximum.accumulate(self._release_ns) / 1e9
        self.strip = Strip(
            at=seconds if unit == "s" else self._cycle.astype(np.float64),
            latency_ms=latency_ms,
            missed=cycles["missed"][counted].astype(bool, copy=False),
            placement=placement_codes(cycles.names("placement")[counted], self._candidates),
            number=self._cycle,
            due=~cycles.names("outcome")[counted].equal("idle"),
        )
        size, period_s = self.problem.window_cycles, self.problem.pipeline.period_ms / 1e3
        self.window = size * period_s if unit == "s" else float(size)
        self.windows = RecordedWindows(run, self.problem, self._begins, self.window)
        end_s = float(self._release_ns[-1]) / 1e9
        met = disturbances_met(run, run.disturbances)
        self._bands = bands_of(met, self._place, end_s)
        happened = (
            {**event, "at": self._place(event["at"])}
            for event in disturbance_events(met, self.problem, end_s)
        )
        self._events = RecordedEvents([*self.windows.events(), *happened])
        self._verdict = {} if self.growing else verdict_document(run, self.problem)

    def _begins(self, first: NDArray[np.int64]) -> Floats:
        """Return the places of cycles by their numbers."""
        rows = np.minimum(np.searchsorted(self._cycle, first), len(self._cycle) - 1)
        return self.strip.at[rows]

    def _place(self, at_s: float) -> float:
        """Return the place on the time line of an instant, seconds since the first release."""
        if self.unit == "s":
            return at_s
        row = int(np.searchsorted(self._release_ns, round(at_s * 1e9)))
        return float(self._cycle[min(row, len(self._cycle) - 1)])

    def described(self) -> Plain:
        about = {name: self.run.meta.get(name) for name in ABOUT} | {
            "policy": policy_of(self.run, self.windows.placement)
        }
        cycle = self.problem.pipeline.period_ms / 1e3 if self.unit == "s" else 1.0
        return {
            **cell_document(self.problem),
            "source": self.source,
            "live": False,
            "growing": self.growing,
            "unit": self.unit,
            "begin": float(self.strip.at[0]),
            "end": float(self.strip.at[-1]) + cycle,
            "about": {name: str(value) for name, value in about.items() if value is not None},
            "cycles": int(self.strip.due.sum()),
            "missed": int(self.strip.missed.sum()),
            "windows": len(self.windows.number),
            "has_jobs": self.run.has_jobs,
            "notes": self.run.losses,
            "worst": self.windows.worst(),
            "disturbed": merged(self._bands),
            **self._verdict,
        }

    def view(self, begin: float, end: float, bins: int) -> Plain:
        windows = self.windows
        costs = {f"j {name}": column for name, column in windows.costs.items()}
        used = {f"u {name}": column for name, column in windows.used.items()}
        lines = {**costs, **used, "cost": windows.seen["cost"]}
        return {
            "begin": begin,
            "end": end,
            **self.strip.view(begin, end, bins),
            "windows": binned_means(windows.closes, lines, begin, end, bins // 2),
            **self._events.view(begin, end),
        }

    def state(self, at: float) -> Plain:
        row = int(np.searchsorted(self.strip.at, at, "right")) - 1
        k = self.windows.closed(at)
        code = int(self.strip.placement[row]) if row >= 0 else -1
        return {
            "at": at,
            "cycle": int(self._cycle[row]) if row >= 0 else None,
            "placement": self._candidates[code] if code >= 0 else None,
            **self.windows.health(k),
            "age_ms": self._age_ms(at, row),
            "disturbed": disturbed_at(self._bands, at),
            **({} if k < 0 else self.windows.window(k) | self.windows.estimates(k)),
        }

    def _age_ms(self, at: float, row: int) -> float | None:
        """Return the age in ms of the newest completed cycle at a place; None if unknown."""
        if row < 0:
            return None
        now_ms = float(self._release_ns[row]) / 1e6
        if self.unit == "s":
            now_ms = at * 1e3
        rows = slice(max(row + 1 - LOOK_BACK, 0), row + 1)
        released_ms = self._release_ns[rows] / 1e6
        ended = np.flatnonzero(released_ms + self.strip.latency_ms[rows] <= now_ms)
        return round(now_ms - float(released_ms[ended[-1]]), 3) if len(ended) else None

    def jobs(self, begin: float, end: float) -> Plain:
        rows = self.strip.rows(begin, end)
        rows = slice(rows.start, min(rows.stop, rows.start + MOST_WITH_JOBS))
        if rows.start >= rows.stop or not self.run.has_jobs:
            return jobs_document((), (), known=self.run.has_jobs)
        numbers, latency_ms = self._cycle[rows].tolist(), self.strip.latency_ms[rows]
        columns = (numbers, self._release_ns[rows], plain(latency_ms, 6), self.strip.missed[rows])
        cycles = [
            TimedCycle(number, int(release_ns), latency_ms, bool(missed))
            for number, release_ns, latency_ms, missed in zip(*columns, strict=True)
        ]
        table = self.run.jobs
        mine = table.filter(table["cycle"].is_between(numbers[0], numbers[-1]))
        return jobs_document(cycles, mine.iter_rows(named=True))
