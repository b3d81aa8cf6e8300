"""RecordedWindows: windows and decisions of a recorded run, on a time line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.dash.paged_cell import Plain, health_by
from dwell.dash.strip import plain
from dwell.model import Problem
from dwell.model.live import RECENT_WINDOWS
from dwell.model.number_arrays import Floats
from dwell.record import Names, Run, shown_reason
from dwell.record.moves import GUARD, by_guard

#: Columns of measured values, and of estimates without the candidate's name.
SEEN = {
    "cost": ("cost", "j"),
    "l95_ms": ("seen_l95_ms", "est_l95_ms"),
    "violation_rate": ("seen_violation_rate", "est_violation_rate"),
    "age_ms": ("seen_age_ms", "est_age_ms"),
    "price_per_hour": ("seen_price_per_hour", "est_price_per_hour"),
}
#: Explanation of the reason of a move to the least bad of all candidates.
INFEASIBLE = "all candidates are over a cap, this one least"


class RecordedWindows:
    """Windows and decisions of a recorded run, on a time line.

    Parameters
    ----------
    opens : callable
        Converts numbers of first cycles to the places where their windows begin.
    length : float
        Length of a window, in the unit of the time line.

    Attributes
    ----------
    number : int64 array, shape (n,)
        Numbers of the windows.
    opens, closes : float64 array, shape (n,)
        Places where the windows begin and end.
    rates : float64 array, shape (n,)
        Final V_D of each window.
    counts : bool array, shape (n,)
        Whether the window is after the warm-up.
    placement : int32 array, shape (n,)
        Index of each window's placement in the cell's candidates.
    decisions : TableArrays
        All decisions, including moves of the guard.
    window_of : integer array, shape (decisions,)
        Index of each decision's window; -1 if the window is missing.
    seen, used, costs : dict of str to float64 array, shape (n,)
        Values measured at the end of the window; utilisation by resource; J by candidate, NaN if
        unknown.
    """

    def __init__(
        self,
        run: Run,
        problem: Problem,
        opens: Callable[[NDArray[np.int64]], Floats],
        length: float,
    ) -> None:
        self._problem = problem
        self._candidates = tuple(problem.candidates)
        windows = run.arrays("windows")
        self.number = windows["window"].astype(np.int64)
        self.opens = opens(windows["first_cycle"].astype(np.int64))
        self.closes = self.opens + length
        self._first, self._cycle = windows["first_cycle"], length / problem.window_cycles
        self.rates = windows["violation_rate"].astype(np.float64)
        self.counts = ~windows["warmup"].astype(bool)
        self.placement = placement_codes(windows.names("placement"), self._candidates)
        self.seen = {
            name: windows[of].astype(np.float64) for name, (of, _) in SEEN.items() if of in windows
        }
        self.used = {
            name: windows[f"u_{name}"].astype(np.float64) for name in problem.fabric.resources
        }
        self._decide(run)

    def _decide(self, run: Run) -> None:
        """Read the decisions, and index the decisions at the end of a window by window."""
        self.decisions = table = run.arrays("decisions")
        windows, reasons = table["window"].astype(np.int64), table.names("reason")
        self._reasons = reasons.to_list()
        self._target = placement_codes(table.names("placement"), self._candidates)
        self._incumbent = placement_codes(table.names("incumbent"), self._candidates)
        refused = run.decisions["refused"].to_list() if "refused" in table else []
        self._refused = [text or "" for text in refused] or [""] * len(self._reasons)
        at_close = ~by_guard(table) & (table["cycles"] > 0)
        # Row of each window's decision; -1 without a decision.
        self._row = np.full(len(self.number), -1)
        # Index of each decision's window; decisions of missing windows get -1.
        places = np.searchsorted(self.number, windows)
        known = np.isin(windows, self.number)
        self.window_of = np.where(known, places, -1)
        fits = at_close & known
        self._row[places[fits]] = np.flatnonzero(fits)
        self.costs = {
            name: self._by_window(table[f"j_{name}"].astype(np.float64))
            for name in self._candidates
        }

    def _by_window(self, column: Floats) -> Floats:
        """Return a column of the decisions by window; NaN without a decision."""
        values = np.full(len(self._row), np.nan)
        known = self._row >= 0
        values[known] = column[self._row[known]]
        return values

    def events(self) -> Iterator[Plain]:
        """Yield moves and refusals."""
        migrated = self.decisions["migrated"].astype(bool)
        refused = np.array([bool(text) for text in self._refused], bool)
        for row in np.flatnonzero(migrated | refused).tolist():
            place = int(self.window_of[row])
            if place < 0:
                continue
            reason = shown_reason(self._reasons[row])
            beyond = int(self.decisions["last_cycle"][row]) + 1 - int(self._first[place])
            at = float(self.opens[place]) + beyond * self._cycle
            names = [self._candidates[code[row]] for code in (self._incumbent, self._target)]
            event = {"at": at, "window": int(self.number[place])}
            if refused[row]:
                yield {**event, "kind": "refused", "text": f"{reason}: {self._refused[row]}"}
            else:
                kind = "guard" if reason == GUARD else "move"
                why = f"{reason} ({INFEASIBLE})" if reason == "infeasible" else reason
                yield {**event, "kind": kind, "text": f"{names[0]} → {names[1]}: {why}"}

    def worst(self) -> Plain | None:
        """Return the window with the largest V_D after the warm-up, then with the largest L95."""
        rows = np.flatnonzero(self.counts)
        if not len(rows):
            return None
        keys = (-np.nan_to_num(self.seen["l95_ms"][rows]), -self.rates[rows])
        row = int(rows[np.lexsort(keys)[0]])
        return {
            "number": int(self.number[row]),
            "at": float(self.closes[row]),
            "rate": float(self.rates[row]),
        }

    def closed(self, at: float) -> int:
        """Return the index of the last window that ended up to a place; -1 before the first."""
        return int(np.searchsorted(self.closes, at, "right")) - 1

    def health(self, k: int) -> Plain:
        """Return health and headline at the end of the k-th window."""
        recent = self.rates[max(k + 1 - RECENT_WINDOWS, 0) : k + 1]
        return dict(health_by(self._problem, recent.tolist()))

    def window(self, k: int) -> Plain:
        """Return the k-th window and the decision at its end."""
        row = int(self._row[k])
        return {
            "window": {
                "number": int(self.number[k]),
                "begin": float(self.opens[k]),
                "end": float(self.closes[k]),
                "placement": self._candidates[self.placement[k]],
                "seen": {name: plain(of[k : k + 1], 4)[0] for name, of in self.seen.items()},
            },
            **({} if row < 0 else {"decision": self._decision(row)}),
        }

    def estimates(self, k: int) -> Plain:
        """Return the prediction for the k-th window, its load and the estimates at its end."""
        before, row = int(self._row[k - 1]) if k > 0 else -1, int(self._row[k])
        placement = self._candidates[self.placement[k]]
        names = () if row < 0 else self._candidates
        return {
            "predicted": None if before < 0 else self._estimate(before, placement),
            "used": {name: plain(column[k : k + 1], 4)[0] for name, column in self.used.items()},
            "candidates": {name: self._estimate(row, name) for name in names},
        }

    def _decision(self, row: int) -> Plain:
        return {
            "incumbent": self._candidates[self._incumbent[row]],
            "placement": self._candidates[self._target[row]],
            "reason": self._reasons[row],
            "refused": self._refused[row] or None,
            **self._numbers(row, "delta_j", "dwell"),
        }

    def _estimate(self, row: int, name: str) -> Plain:
        """Return the estimates of a candidate at a decision; `eligible` means within all caps."""
        estimates = {key: f"{of}_{name}" for key, (_, of) in SEEN.items()}
        known = {key: column for key, column in estimates.items() if column in self.decisions}
        values = self._numbers(row, *known.values())
        within = bool(self.decisions[f"eligible_{name}"][row])
        return {**dict(zip(known, values.values(), strict=True)), "eligible": within}

    def _numbers(self, row: int, *columns: str) -> Plain:
        """Return values of a decision by column; None if unknown."""
        rows = slice(row, row + 1)
        return {
            name: plain(self.decisions[name][rows].astype(np.float64), 4)[0] for name in columns
        }


def placement_codes(names: Names, candidates: Sequence[str]) -> NDArray[np.int32]:
    """Return the index of each name in the candidates; -1 for other names."""
    place = {name: i for i, name in enumerate(candidates)}
    codes = np.array([place.get(name, -1) for name in names.known] or [-1], np.int32)
    found: NDArray[Any] = codes[names.places] if len(names.places) else codes[:0]
    return found
