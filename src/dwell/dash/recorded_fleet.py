"""RecordedFleet: the folder of a fleet on the page.

It reads the windows and decisions of every cell, but cycles only for a cell that the user opens.
Places on its time line are seconds since the begin of the run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.dash.paged_cell import NO_WINDOW, UNMEASURED, Plain
from dwell.dash.recorded_cell import RecordedCell
from dwell.dash.recorded_events import (
    Band,
    RecordedEvents,
    bands_of,
    disturbance_events,
    disturbances_met,
    merged,
)
from dwell.dash.recorded_windows import RecordedWindows
from dwell.dash.strip import Strip, binned_means, plain
from dwell.display import placement_hues
from dwell.errors import RunError
from dwell.model import Problem, Scenario
from dwell.model.fleet import FleetCell
from dwell.model.number_arrays import Floats
from dwell.record import FleetRun, Run, open_fleet
from dwell.record.fleet_run import how_many_are_whole, listed
from dwell.study.verdict import verdict_of

#: Largest number of bins of all cells together (about 90 bytes each); smallest number per cell.
MOST_BINS, LEAST_BINS = 8_000, 10
#: Number of opened cells in memory.
MOST_OPEN = 16
#: Columns of the bins that the page draws.
DRAWN = ("at", "high", "lost")


@dataclass(frozen=True, slots=True, eq=False)
class _Member:
    """A cell whose run is complete.

    Parameters
    ----------
    place : int
        Index in the fleet's file.
    rate : float
        Mean V_D after the warm-up; NaN without such windows.
    verdict : str or None
        Word of the verdict on the cell (`dwell.study.verdict`), if it has such windows.
    strip : Strip
        The windows instead of cycles: L95, and whether it exceeds the deadline.
    """

    place: int
    name: str
    problem: Problem
    windows: RecordedWindows
    rate: float
    verdict: str | None
    strip: Strip

    @property
    def placed(self) -> list[str]:
        """Names of the placements in the windows."""
        names = list(self.problem.candidates)
        return [names[code] for code in np.unique(self.windows.placement).tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class _Rounds:
    """Φ of the fleet at each request to the ledger, sorted by time.

    Parameters
    ----------
    at, before, after : float64 array, shape (n,)
        End of the window, in seconds; Φ before and after the decision.
    number : int64 array, shape (n,)
        Number of the round.
    """

    at: Floats
    before: Floats
    after: Floats
    number: NDArray[np.int64]

    def view(self, begin: float, end: float, bins: int, cells: int) -> Plain:
        """Return Φ per cell between two places, before and after each request to the ledger."""
        phi = np.column_stack([self.before, self.after]).ravel() / cells
        return binned_means(np.repeat(self.at, 2), {"phi": phi}, begin, end, bins)


class RecordedFleet:
    """A recorded fleet on the page; cells are sorted by V_D after the warm-up, worst first.

    Raises `RunError` if the folder has no fleet or no complete run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        run = self._run = open_fleet(folder, whole=False)
        self.name, self.count = run.fleet.name, len(run.fleet.cells)
        self._faults = list(run.faults)
        self._members = sorted(
            self._whole(run), key=lambda one: (-np.nan_to_num(one.rate), one.place)
        )
        if not self._members:
            raise RunError("\n".join([f"{folder}: {self._how_many()}", *listed(self._faults)]))
        candidates = dict.fromkeys(name for one in self._members for name in one.problem.candidates)
        used = {name for one in self._members for name in one.placed}
        self._hues = placement_hues(candidates)
        # Only the placements that some window uses.
        self._placements = {name: i for i, name in enumerate(n for n in candidates if n in used)}
        self._end = max(float(one.windows.closes[-1]) for one in self._members)
        self._rounds = _rounds(self._members)
        self._grid, self._load = self._shared_load()
        self._lines = self._over_time()
        met = [self._met(one) for one in self._members]
        self._events = RecordedEvents(self._all_events(met))
        self._bands = self._all_bands(met)
        self.cell = lru_cache(MOST_OPEN)(self._open)

    # --------------------------------------------------------------------- reading

    def _whole(self, run: FleetRun) -> Iterator[_Member]:
        """Yield the cells with readable windows and decisions; add a fault for each other cell."""
        for place, cell in enumerate(run.fleet.cells):
            if cell.name not in run.cells:
                continue
            try:
                phase_ms = run.phases_ms[cell.name]
                yield _member(place, cell, run.cells[cell.name], phase_ms, run.fleet.aim)
            except RunError as error:
                self._faults.append(str(error))

    def _how_many(self) -> str:
        return how_many_are_whole(len(self._members), self.count)

    def _shared_load(self) -> tuple[Floats, dict[str, Floats]]:
        """Return the ends of the fleet's windows, and the load of the shared nodes in them."""
        try:
            table = self._run.load
        except RunError as error:
            self._faults.append(str(error))
            return self._members[0].windows.closes, {}
        window_ms = min(entry.cell.window_ms for entry in self._run.fleet.entries)
        closes = table["start_ns"].to_numpy() / 1e9 + window_ms / 1e3
        names = [name for name in table.columns if name.startswith("u_")]
        return closes, {name.removeprefix("u_"): table[name].to_numpy() for name in names}

    def _over_time(self) -> dict[str, Floats]:
        """Return the lines of the charts: load, and number of cells by placement."""
        counts = np.zeros((len(self._placements), len(self._grid)))
        for one in self._members:
            codes = self._codes(one)
            rows = _held(one.windows, self._grid)
            counts[codes[one.windows.placement[rows]], np.arange(len(self._grid))] += 1
        return {
            **{f"u {name}": column for name, column in self._load.items()},
            **{f"on {name}": counts[i] for name, i in self._placements.items()},
        }

    def _codes(self, one: _Member) -> NDArray[np.int64]:
        """Return the index of each candidate in the placements; -1 for unused candidates."""
        return np.array([self._placements.get(name, -1) for name in one.problem.candidates])

    def _met(self, one: _Member) -> Scenario:
        """Return the disturbances of a cell, with the sampled times of episodes."""
        planned = one.problem.scenario(self._run.fleet.cells[one.place].entry.scenario)
        return disturbances_met(self._run.cells[one.name], planned)

    def _all_bands(self, met: list[Scenario]) -> list[tuple[float, float]]:
        """Return the periods in which any cell is disturbed."""
        bands: set[Band] = set()
        for scenario in met:
            bands.update(bands_of(scenario, float, self._end))
        return merged(sorted(bands))

    def _all_events(self, met: list[Scenario]) -> Iterator[Plain]:
        """Yield moves and refusals by cell, and disturbances with the number of cells."""
        happened: Counter[tuple[float, str]] = Counter()
        for one, scenario in zip(self._members, met, strict=True):
            for (_, text), events in groupby(
                one.windows.events(), lambda one: (one["kind"], one["text"])
            ):
                first, *again = events
                times = f" ({len(again) + 1} times)" if again else ""
                yield {**first, "text": f"{one.name}: {text}{times}"}
            for event in disturbance_events(scenario, one.problem, self._end):
                happened[event["at"], event["text"]] += 1
        for (at, text), count in happened.items():
            who = "all cells" if count == len(self._members) else f"{count} of the cells"
            yield {"at": at, "kind": "disturbance", "text": f"{who}: {text}"}

    def _open(self, place: int) -> RecordedCell:
        """Open a cell with its cycles, by its index in the fleet's file."""
        return RecordedCell(self.folder / self._run.fleet.cells[place].name)

    # --------------------------------------------------------------------- showing

    def described(self) -> Plain:
        """Return the constant data: the cells, and the begin and end of the time line."""
        run, first = self._run, self._run.fleet.entries[0].cell
        phases = run.fleet.phases
        return {
            "name": run.fleet.name,
            "source": self.folder.resolve().name,
            "live": False,
            "growing": False,
            "unit": "s",
            "begin": 0.0,
            "end": self._end,
            "period_ms": first.pipeline.period_ms,
            "window_cycles": first.window_cycles,
            "count": self.count,
            "about": {
                "coordination": run.fleet.coordination,
                "objective": run.fleet.objective,
                "phases": phases if isinstance(phases, str) else "listed",
                "seed": str(run.seed),
            },
            "notes": list(self._notes()),
            "placements": [{"name": name, "hue": self._hues[name]} for name in self._placements],
            "shared": list(self._load),
            "has_phi": bool(len(self._rounds.at)),
            "mean_rate": _known(np.mean([one.rate for one in self._members])),
            "worst": self._members[0].windows.worst(),
            "disturbed": self._bands,
            "verdicts": dict(Counter(one.verdict for one in self._members if one.verdict)),
            "aim": run.fleet.aim,
            "cells": [
                {
                    "place": one.place,
                    "name": one.name,
                    "deadline_ms": one.problem.pipeline.deadline_ms,
                    "rate": _known(one.rate),
                    "verdict": one.verdict,
                }
                for one in self._members
            ],
        }

    def _notes(self) -> Iterator[str]:
        if self._faults or not self._run.finished:
            ended = "" if self._run.finished else "; writing the fleet was interrupted"
            yield f"{self._how_many()}{ended}."
        yield from listed(self._faults)

    def view(self, begin: float, end: float, bins: int) -> Plain:
        """Return the data of the charts between two places."""
        each = max(min(bins, MOST_BINS // len(self._members)), LEAST_BINS)
        return {
            "begin": begin,
            "end": end,
            "cells": [self._cell_view(one, begin, end, each) for one in self._members],
            "windows": binned_means(self._grid, self._lines, begin, end, bins // 2),
            "rounds": self._rounds.view(begin, end, bins // 2, self.count),
            **self._events.view(begin, end),
        }

    def _cell_view(self, one: _Member, begin: float, end: float, bins: int) -> Plain:
        view = one.strip.view(begin, end, bins)
        ribbon = view["ribbon"]
        ribbon["placement"] = self._codes(one)[ribbon["placement"]].tolist()
        return {
            "windows": view["cycles"],
            "over": view["missed"],
            "bins": {name: view["bins"][name] for name in DRAWN},
            "ribbon": ribbon,
        }

    def state(self, at: float) -> Plain:
        """Return the states of the cells at a place, and the load of the shared nodes."""
        cells = [self._cell_state(one, at) for one in self._members]
        unwell = sum(cell["health"] == "degraded" for cell in cells)
        health = "degraded" if unwell else "ok"
        headline = f"{unwell} of {len(cells)} cells" if unwell else None
        if all(cell["health"] == UNMEASURED for cell in cells):
            health, headline = UNMEASURED, NO_WINDOW
        k = int(np.searchsorted(self._grid, at, "right")) - 1
        row = int(np.searchsorted(self._rounds.at, at, "right")) - 1
        return {
            "at": at,
            "health": health,
            "headline": headline,
            "cells": cells,
            "used": {
                name: None if k < 0 else plain(column[k : k + 1], 4)[0]
                for name, column in self._load.items()
            },
            "phi": None if row < 0 else float(self._rounds.after[row]) / self.count,
            "round": None if row < 0 else int(self._rounds.number[row]),
        }

    @staticmethod
    def _cell_state(one: _Member, at: float) -> Plain:
        k = one.windows.closed(at)
        code = int(one.windows.placement[_held(one.windows, np.array(at))])
        return {
            "placement": list(one.problem.candidates)[code],
            **one.windows.health(k),
            **({} if k < 0 else one.windows.window(k)),
        }


def _member(place: int, cell: FleetCell, run: Run, phase_ms: float, aim: float) -> _Member:
    pipeline = cell.problem.pipeline

    def opens(first: NDArray[np.int64]) -> Floats:
        return (phase_ms + first.astype(np.float64) * pipeline.period_ms) / 1e3

    windows = RecordedWindows(run, cell.problem, opens, cell.problem.window_ms / 1e3)
    if not len(windows.number):
        raise RunError(f"{cell.name}: this run has no windows")
    l95_ms = run.arrays("windows")["l95_ms"].astype(np.float64)
    strip = Strip(
        at=windows.opens,
        latency_ms=np.where(np.isinf(l95_ms), np.nan, l95_ms),
        missed=~(l95_ms <= pipeline.deadline_ms),
        placement=windows.placement,
        number=windows.number,
        due=np.ones(len(windows.number), np.bool_),
    )
    counted = windows.rates[windows.counts]
    rate = float(counted.mean()) if len(counted) else np.nan
    verdict = verdict_of(run, cell.problem, rate, aim).word if len(counted) else None
    return _Member(place, cell.name, cell.problem, windows, rate, verdict, strip)


def _known(value: Any) -> float | None:
    """Return a number for JSON; None for NaN and infinity."""
    return float(value) if np.isfinite(value) else None


def _held(windows: RecordedWindows, at: Any) -> NDArray[np.intp]:
    """Return the index of the window at each place; before the first window, the first."""
    rows: NDArray[np.intp] = np.searchsorted(windows.opens, at, "right") - 1
    return np.maximum(rows, 0)


def _rounds(members: list[_Member]) -> _Rounds:
    """Return Φ at each request to the ledger; a refused move leaves Φ as it was."""
    at, phi, number = [np.zeros(0)], [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for one in members:
        table = one.windows.decisions
        if "phi_before" not in table:
            continue
        before, after = (table[name].astype(np.float64) for name in ("phi_before", "phi_after"))
        asked = ~np.isnan(before) & (one.windows.window_of >= 0)
        came = np.where(table["migrated"].astype(bool), after, before)
        at.append(one.windows.closes[one.windows.window_of[asked]])
        phi.append(np.column_stack([before, came])[asked])
        number.append(table["round"].astype(np.int64)[asked])
    order = np.argsort(np.concatenate(at), kind="stable")
    before, came = np.concatenate(phi)[order].T
    return _Rounds(np.concatenate(at)[order], before, came, np.concatenate(number)[order])
