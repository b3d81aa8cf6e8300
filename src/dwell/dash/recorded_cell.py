"""RecordedCell: a run's folder as the page sees it; also one that another process still writes."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dwell.dash.paged_cell import (
    MOST_WITH_JOBS,
    Plain,
    Unit,
    cell_document,
    cycle_since,
    health_by,
    job_since,
)
from dwell.dash.strip import Strip, binned_means, plain
from dwell.errors import RunError
from dwell.model.disturbed import disturbed
from dwell.model.instants import NEVER_NS
from dwell.model.live import RECENT_WINDOWS
from dwell.record import Run, TableArrays, open_run

#: Events of a view at most.
MOST_EVENTS = 300
#: Cycles before a place among which the newest one in effect is looked for.
LOOK_BACK = 4_000
#: What is both estimated and seen of a window, and the columns that say what was seen.
SEEN = {"l95_ms": "seen_l95_ms", "violation_rate": "seen_violation_rate", "cost": "cost"}
#: A run that is being written is read again after this many times what that takes, and a while.
REST, LEAST_REST_S = 5.0, 1.0


class RecordedCell:
    """See the module and `PagedCell`.

    Parameters
    ----------
    unit : {"s", "cycle"}
        What its time line counts.

    Raises
    ------
    RunError
        If the folder is no run, is damaged, or has no cycles.
    """

    live = False

    def __init__(self, folder: Path, unit: Unit = "s") -> None:
        self.folder, self.unit = folder, unit
        self._reading = threading.Lock()
        self._size, self._read_again_s = self._bytes(), 0.0
        self._contents = self._read()

    def __repr__(self) -> str:
        return f"<RecordedCell of {str(self.folder)!r}>"

    def _bytes(self) -> int:
        """Return how long the folder's files are."""
        return sum(file.stat().st_size for file in self.folder.glob("*") if file.is_file())

    def _read(self) -> _Contents:
        began_s = time.monotonic()
        contents = _Contents(open_run(self.folder), self.unit, self.folder.resolve().name)
        took_s = time.monotonic() - began_s
        self._read_again_s = time.monotonic() + max(REST * took_s, LEAST_REST_S)
        return contents

    def refreshed(self) -> bool:
        """See `PagedCell`; what cannot be read meanwhile is read the next time."""
        if not self._contents.growing or time.monotonic() < self._read_again_s:
            return False
        with self._reading:
            size = self._bytes()
            if size == self._size:
                return False
            try:
                self._contents = self._read()
            except (RunError, OSError):
                self._read_again_s = time.monotonic() + LEAST_REST_S
                return False
            self._size = size
        return True

    @property
    def run(self) -> Run:
        """The run as it was read last."""
        return self._contents.run

    def described(self) -> Plain:
        """See `PagedCell`."""
        return self._contents.described()

    def view(self, begin: float, end: float, bins: int) -> Plain:
        """See `PagedCell`."""
        return self._contents.view(begin, end, bins)

    def state(self, at: float) -> Plain:
        """See `PagedCell`."""
        return self._contents.state(at)

    def jobs(self, begin: float, end: float) -> Plain:
        """See `PagedCell`."""
        return self._contents.jobs(begin, end)


def same_realisation(one: Run, other: Run) -> bool:
    """Whether two runs met the same draws, cycle by cycle."""
    simulated = all(run.meta.get("kind", "simulated") == "simulated" for run in (one, other))
    drawn = [(run.meta.get("seed"), run.meta.get("scenario")) for run in (one, other)]
    return simulated and drawn[0] == drawn[1] and one.problem.drawn == other.problem.drawn


class _Contents:
    """The tables of a run as arrays, on its time line."""

    def __init__(self, run: Run, unit: Unit, source: str) -> None:
        self.run, self.unit, self.source, self.problem = run, unit, source, run.problem
        recovered = run.meta.get("recovered", {})
        self.growing = bool(recovered) and not recovered.get("sealed", True)
        self._candidates = tuple(self.problem.candidates)
        cycles = run.arrays("cycles")
        self._release_ns = cycles["release_ns"].astype(np.int64, copy=False)
        if not len(self._release_ns):
            raise RunError(f"{source}: this run has no cycles yet")
        latency_ms = cycles["latency_ns"] / 1e6
        latency_ms[latency_ms >= NEVER_NS / 1e6] = np.nan
        self._cycle = cycles["cycle"].astype(np.int64, copy=False)
        seconds = np.maximum.accumulate(self._release_ns) / 1e9
        self.strip = Strip(
            at=seconds if unit == "s" else self._cycle.astype(np.float64),
            latency_ms=latency_ms,
            missed=cycles["missed"].astype(bool, copy=False),
            placement=self._codes(cycles, "placement"),
            number=self._cycle,
        )
        windows = self._windows = run.arrays("windows")
        self._window = windows["window"].astype(np.int64)
        first = windows["first_cycle"].astype(np.int64)
        size, period_s = self.problem.window_cycles, self.problem.pipeline.period_ms / 1e3
        rows = np.minimum(np.searchsorted(self._cycle, first), len(self._cycle) - 1)
        self._opens = self.strip.at[rows]
        self._closes = self._opens + (size * period_s if unit == "s" else size)
        # What the close saw, by how an estimate calls it; and V_D as it came to be.
        self._seen = {name: windows[of].astype(np.float64) for name, of in SEEN.items()}
        self._rates = windows["violation_rate"].astype(np.float64)
        self._used = {
            name: windows[f"u_{name}"].astype(np.float64)
            for name in self.problem.fabric.resources
            if f"u_{name}" in windows
        }
        self._decide(run.arrays("decisions"))
        self._events = sorted(self._all_events(), key=lambda event: event["at"])
        self._events_at = np.array([event["at"] for event in self._events])

    def _codes(self, table: TableArrays, column: str) -> NDArray[np.int32]:
        """Return the names of a column as places among the candidates."""
        names = table.names(column)
        place = {name: i for i, name in enumerate(self._candidates)}
        codes = np.array([place.get(name, -1) for name in names.known] or [-1], np.int32)
        return codes[names.places] if len(names.places) else codes[:0]

    def _decide(self, table: TableArrays) -> None:
        """Take in the decisions: those at a window's close, by window, and all of them."""
        self._decisions = table
        windows, reasons = table["window"].astype(np.int64), table.names("reason")
        self._reasons = reasons.to_list()
        self._moves_to = self._codes(table, "placement"), self._codes(table, "incumbent")
        at_close = ~reasons.equal("guard")
        # Of a window, the row of its decision; -1 where nothing was decided.
        self._row = np.full(len(self._window), -1)
        # The place of its window; one that is missing has none.
        places = np.searchsorted(self._window, windows)
        known = np.isin(windows, self._window)
        self._decided_at = np.where(known, places, -1)
        fits = at_close & known
        self._row[places[fits]] = np.flatnonzero(fits)
        self._costs = {
            name: self._by_window(table[f"j_{name}"].astype(np.float64))
            for name in self._candidates
            if f"j_{name}" in table
        }

    def _by_window(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a column of the decisions by window; NaN where nothing was decided."""
        values = np.full(len(self._row), np.nan)
        known = self._row >= 0
        values[known] = column[self._row[known]]
        return values

    def _all_events(self) -> Iterator[Plain]:
        """Yield what happened: moves, refusals, disturbances."""
        table = self._decisions
        migrated = table["migrated"].astype(bool)
        refused = self._texts("refused")
        target, source = self._moves_to
        for row in np.flatnonzero(migrated | np.array([bool(text) for text in refused], bool)):
            place = int(self._decided_at[row])
            if place < 0:
                continue
            reason = self._reasons[row]
            # The guard's move is noted under the window that follows it.
            at = float((self._opens if reason == "guard" else self._closes)[place])
            names = [self._candidates[code] for code in (source[row], target[row])]
            event = {"at": at, "window": int(self._window[place])}
            if refused[row]:
                yield {**event, "kind": "refused", "text": f"{reason}: {refused[row]}"}
            else:
                kind = "guard" if reason == "guard" else "move"
                yield {**event, "kind": kind, "text": f"{names[0]} → {names[1]}: {reason}"}
        end_s = float(self._release_ns[-1]) / 1e9
        for item in disturbed(self.run.disturbances, self.problem.fabric):
            for at_s, word in ((item.begin_s, "begins"), (item.end_s, "ends")):
                if 0 <= at_s <= end_s:
                    text = f"{item.kind} {word}: {item.what}"
                    yield {"at": self._place(at_s), "kind": "disturbance", "text": text}

    def _texts(self, column: str) -> list[str]:
        """Return a column of texts of the decisions; empty where there is none."""
        if column not in self._decisions:
            return [""] * len(self._decided_at)
        return [text or "" for text in self.run.decisions[column].to_list()]

    def _place(self, at_s: float) -> float:
        """Return the place on the time line of an instant, seconds since the first release."""
        if self.unit == "s":
            return at_s
        row = int(np.searchsorted(self._release_ns, round(at_s * 1e9)))
        return float(self._cycle[min(row, len(self._cycle) - 1)])

    @property
    def end(self) -> float:
        """Where the time line ends."""
        period_s = self.problem.pipeline.period_ms / 1e3
        return float(self.strip.at[-1]) + (period_s if self.unit == "s" else 1.0)

    def described(self) -> Plain:
        meta = self.run.meta
        told = ("kind", "scenario", "policy", "estimator", "seed")
        return {
            **cell_document(self.problem),
            "source": self.source,
            "live": False,
            "growing": self.growing,
            "unit": self.unit,
            "begin": float(self.strip.at[0]),
            "end": self.end,
            "about": {name: str(meta[name]) for name in told if meta.get(name) is not None},
            "cycles": len(self.strip.at),
            "missed": int(self.strip.missed.sum()),
            "windows": len(self._window),
            "has_jobs": self.run.has_jobs,
            "notes": list(self._notes()),
        }

    def _notes(self) -> Iterator[str]:
        recovered = self.run.meta.get("recovered", {})
        if self.growing:
            yield "This run was not closed: it goes on, or its controller was killed."
        for name in ("torn_bytes", "damaged_bytes", "missing_cycles", "missing_windows"):
            if recovered.get(name):
                yield f"{name.replace('_', ' ').capitalize()}: {recovered[name]}."

    def view(self, begin: float, end: float, bins: int) -> Plain:
        low, high = np.searchsorted(self._events_at, (begin, end))
        events = self._events[low:high]
        costs = {f"j {name}": column for name, column in self._costs.items()}
        used = {f"u {name}": column for name, column in self._used.items()}
        windows = {**costs, **used, "cost": self._seen["cost"]}
        return {
            "begin": begin,
            "end": end,
            **self.strip.view(begin, end, bins),
            "windows": binned_means(self._closes, windows, begin, end, bins // 2),
            "events": events[-MOST_EVENTS:],
            "more_events": max(len(events) - MOST_EVENTS, 0),
        }

    def state(self, at: float) -> Plain:
        row = int(np.searchsorted(self.strip.at, at, "right")) - 1
        k = int(np.searchsorted(self._closes, at, "right")) - 1
        recent = self._rates[max(k + 1 - RECENT_WINDOWS, 0) : k + 1]
        code = int(self.strip.placement[row]) if row >= 0 else -1
        return {
            "at": at,
            "cycle": int(self._cycle[row]) if row >= 0 else None,
            "placement": self._candidates[code] if code >= 0 else None,
            **health_by(self.problem, recent.tolist()),
            "age_ms": self._age_ms(at, row),
            **({} if k < 0 else self._window_state(k)),
        }

    def _window_state(self, k: int) -> Plain:
        """Return the k-th window, what was predicted of it, and what was decided on it."""
        placement = self._windows.names("placement")[k : k + 1].to_list()
        before = int(self._row[k - 1]) if k > 0 else -1
        return {
            "window": {
                "number": int(self._window[k]),
                "begin": float(self._opens[k]),
                "end": float(self._closes[k]),
                "placement": placement[0],
                "seen": {name: plain(self._seen[name][k : k + 1], 4)[0] for name in SEEN},
            },
            "predicted": None if before < 0 else self._estimate(before, placement[0]),
            "used": {name: plain(column[k : k + 1], 4)[0] for name, column in self._used.items()},
            **({} if self._row[k] < 0 else self._decision(int(self._row[k]))),
        }

    def _decision(self, row: int) -> Plain:
        target, incumbent = self._moves_to
        return {
            "decision": {
                "incumbent": self._candidates[incumbent[row]],
                "placement": self._candidates[target[row]],
                "reason": self._reasons[row],
                **self._numbers(self._decisions, row, "delta_j", "dwell"),
            },
            "candidates": {name: self._estimate(row, name) for name in self._candidates},
        }

    def _estimate(self, row: int, name: str) -> Plain:
        """Return what a decision believed of a candidate: cost, L95, V_D, whether it is in caps."""
        columns = (f"j_{name}", f"est_l95_ms_{name}", f"est_violation_rate_{name}")
        values = self._numbers(self._decisions, row, *columns)
        eligible = f"eligible_{name}"
        within = bool(self._decisions[eligible][row]) if eligible in self._decisions else True
        found = zip(("cost", "l95_ms", "violation_rate"), values.values(), strict=True)
        return {**dict(found), "eligible": within}

    @staticmethod
    def _numbers(table: TableArrays, row: int, *columns: str) -> Plain:
        """Return values of a row; None where there is none."""
        return {
            name: plain(table[name][row : row + 1].astype(np.float64), 4)[0]
            if name in table
            else None
            for name in columns
        }

    def _age_ms(self, at: float, row: int) -> float | None:
        """Return the age of the newest cycle in effect at a place."""
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
        if rows.start >= rows.stop or not self.run.has_jobs:
            return {"origin_s": 0.0, "jobs": [], "cycles": [], "known": self.run.has_jobs}
        origin_ns = int(self._release_ns[rows.start])
        rows = slice(rows.start, min(rows.stop, rows.start + MOST_WITH_JOBS))
        first, last = int(self._cycle[rows.start]), int(self._cycle[rows.stop - 1])
        table = self.run.jobs
        mine = table.filter(table["cycle"].is_between(first, last))
        cycles = [
            cycle_since(
                int(self._cycle[row]),
                int(self._release_ns[row]),
                None if np.isnan(self.strip.latency_ms[row]) else self.strip.latency_ms[row] * 1e6,
                origin_ns,
                missed=bool(self.strip.missed[row]),
            )
            for row in range(rows.start, rows.stop)
        ]
        jobs = [job_since(job, origin_ns) for job in mine.iter_rows(named=True)]
        return {"origin_s": origin_ns / 1e9, "jobs": jobs, "cycles": cycles, "known": True}
