"""Strip: cycles along a time line, drawn in few bins without one miss less.

A page has some hundred columns of pixels, a run a million cycles. A bin says the least and the
largest latency of its cycles, and how many of them missed and were lost; where there are fewer
cycles than bins, a bin is a cycle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dwell.model.number_arrays import Floats

#: Most stretches of one placement that are told one by one.
MOST_STRETCHES = 800
#: Bins of the ribbon where there are more.
RIBBON_BINS = 400


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Cycles in the order of their release.

    Parameters
    ----------
    at : float64 array, shape (n,)
        Their places on the time line.
    latency_ms : float64 array, shape (n,)
        NaN where no sink has completed the cycle.
    missed : bool array, shape (n,)
    placement : integer array, shape (n,)
        Places of their placements among the cell's candidates.
    number : int64 array, shape (n,)
    """

    at: Floats
    latency_ms: Floats
    missed: NDArray[np.bool_]
    placement: NDArray[np.integer[Any]]
    number: NDArray[np.int64]

    def followed_by(self, other: Strip, most: int) -> Strip:
        """Return this and what comes next, in order of instants; the newest `most` of both."""
        named = [field.name for field in fields(self)]
        columns = [np.concatenate((getattr(self, one), getattr(other, one))) for one in named]
        order = np.argsort(columns[0], kind="stable")[-most:]
        return Strip(*(column[order] for column in columns))

    def rows(self, begin: float, end: float) -> slice:
        """Return the cycles between two places, the second one excluded."""
        low, high = np.searchsorted(self.at, (begin, end))
        return slice(int(low), int(high))

    def view(self, begin: float, end: float, bins: int) -> dict[str, Any]:
        """Return the cycles between two places, and where they were placed.

        Returns
        -------
        dict
            ``cycles`` (how many), ``missed`` (how many); ``bins``: ``at`` (the first cycle's
            place), ``number`` (of that cycle), ``count``, ``low`` and ``high`` (ms; None where all
            are lost), ``missed``, ``lost``; ``ribbon``: ``begin``, ``end`` and ``placement`` of
            stretches. Where stretches are too many they are bins in which there is a placement at
            all, and ``exact`` is false.
        """
        rows = self.rows(begin, end)
        at, latency_ms, missed = self.at[rows], self.latency_ms[rows], self.missed[rows]
        starts = bin_starts(at, begin, end, bins)
        counts = np.diff(np.append(starts, len(at)))
        lost = np.isnan(latency_ms)
        return {
            "cycles": len(at),
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
            # The placement that comes first held before, too.
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


def bin_starts(at: Floats, begin: float, end: float, bins: int) -> NDArray[np.intp]:
    """Return the first row of each bin that has rows; a bin a row where there are few."""
    if len(at) <= bins:
        return np.arange(len(at))
    starts = np.unique(np.searchsorted(at, np.linspace(begin, end, bins, endpoint=False)))
    return starts[starts < len(at)]


def binned_means(
    at: Floats, columns: Mapping[str, Floats], begin: float, end: float, bins: int
) -> dict[str, Any]:
    """Return columns between two places: their means in each bin, of what is not NaN.

    The row before and the row after are told, too, so that a line leads in and out.

    Returns
    -------
    dict
        ``at``, and ``of`` the columns by name.
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
    """Reduce the rows of each bin; `reduceat` takes no empty arrays."""
    if not len(starts):
        return values[:0]
    reduced: NDArray[Any] = how.reduceat(values, starts)
    return reduced


def plain(values: Floats, digits: int) -> Sequence[float | None]:
    """Return numbers ready for JSON: what is not finite is None."""
    rounded = np.round(values, digits)
    numbers: list[float | None] = rounded.tolist()
    for row in np.flatnonzero(~np.isfinite(rounded)).tolist():
        numbers[row] = None
    return numbers
