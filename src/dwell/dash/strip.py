"""Strip: cycles along a time line, in bins that keep every miss.

A page has some hundred columns of pixels; a run has up to a million cycles. A bin has the least and
the largest latency of its cycles, and the numbers of missed and lost cycles. If the cycles are
fewer than the bins, each bin contains one cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.model.number_arrays import Floats

#: Largest number of stretches (of one placement each) in an exact ribbon.
MOST_STRETCHES = 800
#: Largest number of bins of a ribbon with more stretches.
RIBBON_BINS = 400


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Cycles in the order of their release.

    Parameters
    ----------
    at : float64 array, shape (n,)
        Places on the time line.
    latency_ms : float64 array, shape (n,)
        NaN for cycles that no sink has completed.
    missed : bool array, shape (n,)
    placement : integer array, shape (n,)
        Index of the placement in the cell's candidates.
    number : int64 array, shape (n,)
    due : bool array, shape (n,)
        False for idle cycles, in which no sink is due.
    """

    at: Floats
    latency_ms: Floats
    missed: NDArray[np.bool_]
    placement: NDArray[np.integer[Any]]
    number: NDArray[np.int64]
    due: NDArray[np.bool_]

    def followed_by(self, other: Strip, most: int) -> Strip:
        """Return both strips merged in order of `at`; only the last `most` cycles."""
        named = [field.name for field in fields(self)]
        columns = [np.concatenate((getattr(self, one), getattr(other, one))) for one in named]
        order = np.argsort(columns[0], kind="stable")[-most:]
        return Strip(*(column[order] for column in columns))

    def rows(self, begin: float, end: float) -> slice:
        """Return the cycles between two places, the second one excluded."""
        low, high = np.searchsorted(self.at, (begin, end))
        return slice(int(low), int(high))

    def view(self, begin: float, end: float, bins: int) -> dict[str, Any]:
        """Return the cycles between two places in bins, and a ribbon of their placements.

        Returns
        -------
        dict
            Numbers of ``released`` cycles, of ``cycles`` in which a sink is due, and of ``missed``
            cycles; ``bins``: ``at`` and ``number`` of the first cycle, ``count`` of due cycles,
            ``low`` and ``high`` (ms; None if all cycles are lost), ``missed``, ``lost``;
            ``ribbon``: ``begin``, ``end`` and ``placement`` of stretches. With too many stretches
            ``exact`` is false, and the ribbon has, for each placement, the bins that contain it.
        """
        rows = self.rows(begin, end)
        at, latency_ms, missed = self.at[rows], self.latency_ms[rows], self.missed[rows]
        starts, due = bin_starts(at, begin, end, bins), self.due[rows]
        counts = _reduced(np.add, due.astype(np.int64), starts)
        lost = np.isnan(latency_ms) & due
        return {
            "released": len(at),
            "cycles": int(due.sum()),
            "missed": int(missed.sum()),
            "bins": {
                "at": plain(at[starts], 4),
                "number": self.number[rows][starts].tolist(),
                "count": counts.tolist(),
                "low": plain(_reduced(np.fmin, latency_ms, starts), 3),
                "high": plain(_reduced(np.fmax, latency_ms, starts), 3),
                "missed": _reduced(np.add, missed.astype(np.int64), starts).tolist(),
                "lost": _reduced(np.add, lost.astype(np.int64), starts).tolist(),
            },
            "ribbon": self._ribbon(rows, begin, end, bins),
        }

    def _ribbon(self, rows: slice, begin: float, end: float, bins: int) -> dict[str, Any]:
        at, placement = self.at[rows], self.placement[rows]
        if not len(at):
            return {"begin": [], "end": [], "placement": [], "exact": True}
        changes = np.concatenate(([0], np.flatnonzero(np.diff(placement)) + 1))
        exact = len(changes) <= min(bins, MOST_STRETCHES)
        if exact:
            # After earlier cycles, the first placement starts at the left edge.
            first = begin if rows.start else at[0]
            begins = np.concatenate(([first], at[changes[1:]]))
            ends, codes = np.append(begins[1:], end), placement[changes]
        else:
            starts = bin_starts(at, begin, end, min(bins, RIBBON_BINS))
            bin_ends = np.append(at[starts[1:]], end)
            found = [
                (at[starts][inside], bin_ends[inside], np.full(int(inside.sum()), code))
                for code in np.unique(placement).tolist()
                for inside in [_reduced(np.add, (placement == code).astype(int), starts) > 0]
            ]
            begins, ends, codes = (np.concatenate(part) for part in zip(*found, strict=True))
        return {
            "begin": plain(begins, 4),
            "end": plain(ends, 4),
            "placement": codes.tolist(),
            "exact": exact,
        }


def difference_of_misses(
    one: Strip, other: Strip, begin: float, end: float, bins: int, length: float
) -> dict[str, Any]:
    """Return the share of missed cycles in one strip less the share in another, per bin.

    Parameters
    ----------
    bins : int
        Most bins; each is a whole number of windows.
    length : float
        Length of a window.

    Returns
    -------
    dict
        ``begin``, ``end`` of each bin and ``points`` of per cent; None if a strip has no due
        cycle in the bin.
    """
    step = length * max(1, -(-(end - begin) // (length * bins)))
    edges = np.arange(begin // step, -(-end // step) + 1) * step
    shares = []
    for strip in (one, other):
        rows = np.searchsorted(strip.at, edges)
        missed, due = (
            np.concatenate(([0], np.cumsum(of)))[rows] for of in (strip.missed, strip.due)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            shares.append(np.diff(missed) / np.diff(due))
    return {
        "begin": plain(edges[:-1], 4),
        "end": plain(edges[1:], 4),
        "points": plain(100 * (shares[0] - shares[1]), 3),
    }


def bin_starts(at: Floats, begin: float, end: float, bins: int) -> NDArray[np.intp]:
    """Return the first row of each bin with rows; one bin per row if rows are at most `bins`."""
    if len(at) <= bins:
        return np.arange(len(at))
    starts = np.unique(np.searchsorted(at, np.linspace(begin, end, bins, endpoint=False)))
    return starts[starts < len(at)]


def binned_means(
    at: Floats, columns: Mapping[str, Floats], begin: float, end: float, bins: int
) -> dict[str, Any]:
    """Return the means of columns in each bin between two places, without NaN.

    The rows before and after the range are included: lines then continue to the edges.

    Returns
    -------
    dict
        ``at`` (first place of each bin) and ``of`` (means by column).
    """
    low, high = np.searchsorted(at, (begin, end))
    low, high = max(int(low) - 1, 0), int(high) + 1
    at = at[low:high]
    starts = bin_starts(at, begin, end, bins)
    means = {}
    for name, column in columns.items():
        values = column[low:high]
        known = ~np.isnan(values)
        counts = _reduced(np.add, known.astype(np.int64), starts)
        sums = _reduced(np.add, np.where(known, values, 0.0), starts)
        with np.errstate(invalid="ignore", divide="ignore"):
            means[name] = plain(sums / counts, 4)
    return {"at": plain(at[starts], 4), "of": means}


def _reduced(how: np.ufunc, values: NDArray[Any], starts: NDArray[np.intp]) -> NDArray[Any]:
    """Reduce the rows of each bin; `reduceat` alone fails on empty arrays."""
    if not len(starts):
        return values[:0]
    reduced: NDArray[Any] = how.reduceat(values, starts)
    return reduced


def plain(values: Floats, digits: int) -> Sequence[float | None]:
    """Return rounded numbers for JSON, with None for NaN and infinity."""
    rounded = np.round(values, digits)
    numbers: list[float | None] = rounded.tolist()
    for row in np.flatnonzero(~np.isfinite(rounded)).tolist():
        numbers[row] = None
    return numbers
