"""QoS sample: cycles and windows of several runs, pooled, and as units that can be resampled.

A unit is a window of a measured run, or a complete simulated run. Every figure is a function of the
units' weights: 1 for the figure itself, random for its interval.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.model.number_arrays import Floats, Ints
from dwell.model.order_statistic import percentile
from dwell.record import arrays_of, moves_in
from dwell.study.summary import PARTS, count_in, latency_ms, mean_of

if TYPE_CHECKING:
    import polars as pl

    from dwell.model import Problem
    from dwell.record import Run


CYCLES = (
    "release_ns",
    "placement",
    "latency_ns",
    "missed",
    *(f"{part}_ns" for part in PARTS),
)
#: Points at which distributions are kept for resampling; the figure itself is exact.
POINTS = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """The counted part of a run: without warm-up and excluded windows.

    Parameters
    ----------
    windows : DataFrame
        As in the run.
    cycles : DataFrame
        Cycles with the columns needed, and ``place``, the row of their window in `windows`.
        Cycles between two windows belong to the earlier window.
    migrations : int
        Migrations by the policy, after the warm-up.
    """

    windows: pl.DataFrame
    cycles: pl.DataFrame
    migrations: int


def piece_of(run: Run, problem: Problem, excluded: Collection[int] = ()) -> Piece:
    """Return the counted part of a run.

    Parameters
    ----------
    excluded : collection of int
        Numbers of windows.

    Raises
    ------
    SimulationError
        If no window is left.
    """
    import polars as pl

    counted = count_in(run, problem.window_cycles)
    first = counted.windows["first_cycle"].to_numpy()
    place = np.searchsorted(first, counted.cycles["cycle"].to_numpy(), side="right") - 1
    keep = ~counted.windows["window"].is_in([*excluded]).to_numpy()
    if not keep.any():
        raise SimulationError("every window after the warm-up is excluded")
    renumbered = np.cumsum(keep) - 1
    moved = sum(not move.by_guard for move in moves_in(counted.decisions))
    cycles = counted.cycles.select(*CYCLES).with_columns(
        place=pl.Series(renumbered[place], dtype=pl.Int64)
    )
    return Piece(counted.windows.filter(keep), cycles.filter(keep[place]), moved)


@dataclass(frozen=True, slots=True, eq=False)
class QosSample:
    """Runs of one group.

    Parameters
    ----------
    latency_ms : float64 array, shape (cycles,)
        Ascending; infinite for cycles that never finished.
    late : bool array, shape (cycles,)
        Whether a cycle missed with a latency of at most D, because its window had ended.
    lengths : tuple of int
        Units of each run.
    grid_ms : float64 array, shape (points,)
    counts : float64 array, shape (units, points + 1)
        Cycles of each unit between the previous point and each point; the last: beyond all.
    sums : mapping of str to float64 array, shape (units, 2)
        By figure: its sum over the unit, and the number of values.
    parts_ms : mapping of str to float
        Mean times of finished cycles for computing, waiting and the network.
    placed : mapping of str to int
        Cycles by candidate.
    """

    latency_ms: Floats
    late: NDArray[np.bool_]
    deadline_ms: float
    lengths: tuple[int, ...]
    grid_ms: Floats
    counts: Floats
    sums: Mapping[str, Floats]
    parts_ms: Mapping[str, float]
    placed: Mapping[str, int]
    windows: int

    @classmethod
    def of(cls, pieces: Sequence[Piece], problem: Problem, *, by_window: bool) -> QosSample:
        """Pool runs.

        Parameters
        ----------
        pieces : sequence of Piece
            At least one.
        by_window : bool
            Whether the units are windows; else they are runs.
        """
        import polars as pl

        heights = [piece.windows.height for piece in pieces]
        lengths = tuple(heights) if by_window else (len(pieces),)
        begin = np.cumsum([0, *heights])
        windows = pl.concat([piece.windows for piece in pieces], how="diagonal_relaxed")
        cycles = pl.concat([piece.cycles for piece in pieces], how="diagonal_relaxed")
        run_of_window = np.repeat(np.arange(len(pieces)), heights)
        run_of_cycle = np.repeat(np.arange(len(pieces)), [one.cycles.height for one in pieces])
        window_of_cycle = begin[run_of_cycle] + cycles["place"].to_numpy()
        of_window = np.arange(len(windows)) if by_window else run_of_window
        of_cycle = window_of_cycle if by_window else run_of_cycle
        units = sum(lengths)
        times = arrays_of(cycles)
        final_ms, missed = latency_ms(cycles), cycles["missed"].to_numpy()
        order = np.argsort(final_ms, kind="stable")
        grid_ms = _grid(final_ms[order])
        deadline_ms = problem.pipeline.deadline_ms
        deadline_ns = round(deadline_ms * 1e6)
        soon = (cycles["latency_ns"].fill_null(deadline_ns + 1) <= deadline_ns).to_numpy()
        return cls(
            latency_ms=final_ms[order],
            late=(missed & soon)[order],
            deadline_ms=deadline_ms,
            lengths=lengths,
            grid_ms=grid_ms,
            counts=_counts(np.searchsorted(grid_ms, final_ms), of_cycle, units, len(grid_ms) + 1),
            sums={
                "violation_rate": _sums(missed.astype(np.float64), of_cycle, units),
                **_window_sums(windows, problem, of_window, units),
                "migrations": _migrations(pieces, of_window, units),
            },
            parts_ms={part: mean_of(times[f"{part}_ns"]) / 1e6 for part in PARTS},
            placed=dict(cycles["placement"].cast(pl.String).value_counts().rows()),
            windows=len(windows),
        )

    @property
    def l95_ms(self) -> float:
        """95th percentile of all cycles, an order statistic; a lost cycle is infinite."""
        return percentile(self.latency_ms, 95)

    @property
    def units(self) -> int:
        """Number of units."""
        return sum(self.lengths)

    @property
    def dominant(self) -> str:
        """Placement of most windows."""
        names = [name for name in self.sums if name.startswith("share_")]
        return max(names, key=self.figure).removeprefix("share_")

    def figure(self, name: str) -> float:
        """Return ``l95_ms``, or the mean of a figure of `sums`; NaN without values."""
        if name == "l95_ms":
            return self.l95_ms
        total, count = self.sums[name].sum(axis=0)
        return float(total / count) if count else math.nan

    def resampled(self, name: str, weights: Floats) -> Floats:
        """Return a figure in every resample.

        Parameters
        ----------
        name : str
            A figure of `sums`, or ``l95_ms``.
        weights : float64 array, shape (draws, units)
            Weight of each unit.
        """
        if name == "l95_ms":
            return self._resampled_l95(weights)
        total, count = (weights @ self.sums[name]).T
        with np.errstate(invalid="ignore", divide="ignore"):
            figures: Floats = total / count
        return figures

    def _resampled_l95(self, weights: Floats) -> Floats:
        within = (weights @ self.counts).cumsum(axis=1)
        rank = np.ceil(0.95 * within[:, -1:] - 1e-9)
        place = (within < rank).sum(axis=1)
        l95_ms: Floats = np.append(self.grid_ms, np.inf)[place]
        return l95_ms

    def rate_if(self, factor: float) -> float:
        """Return V_D with all latencies multiplied by `factor`."""
        longer = self.latency_ms * factor > self.deadline_ms
        return float((longer | self.late).mean())

    def factor_for(self, rate: float) -> float:
        """Return the factor on latencies that gives a V_D of `rate`; NaN at 0 and at 1."""
        here = self.latency_ms[~self.late]
        wanted = round(rate * len(self.latency_ms)) - int(self.late.sum())
        if wanted <= 0 or wanted >= len(here):
            return math.nan
        at = here[len(here) - wanted]
        return self.deadline_ms / float(at) if 0 < at < math.inf else math.nan

    def share_within(self, limits_ms: Floats) -> Floats:
        """Return the share of cycles within each limit."""
        within = np.searchsorted(self.latency_ms, limits_ms, side="right")
        shares: Floats = within / len(self.latency_ms)
        return shares

    def share_near(self, allowed: float) -> float:
        """Return the share of cycles with a latency within `allowed` (relative) of D."""
        low, high = self.deadline_ms * (1 - allowed), self.deadline_ms * (1 + allowed)
        return float(((self.latency_ms >= low) & (self.latency_ms <= high)).mean())


def _grid(ascending: Floats) -> Floats:
    """Return the values themselves, or quantiles of many values."""
    values = np.unique(ascending[np.isfinite(ascending)])
    if len(values) <= POINTS:
        return values
    places = np.rint(np.linspace(0, len(values) - 1, POINTS)).astype(np.int64)
    quantiles: Floats = values[places]
    return quantiles


def _counts(place: Ints, unit: Ints, units: int, points: int) -> Floats:
    flat = np.bincount(unit * points + place, minlength=units * points)
    return flat.reshape(units, points).astype(np.float64)


def _sums(values: Floats, unit: Ints, units: int) -> Floats:
    """Return the sum and number of values other than NaN, by unit."""
    there = ~np.isnan(values)
    total = np.bincount(unit[there], weights=values[there], minlength=units)
    return np.stack([total, np.bincount(unit[there], minlength=units)], axis=1)


def _window_sums(
    windows: pl.DataFrame, problem: Problem, unit: Ints, units: int
) -> dict[str, Floats]:
    def column(name: str) -> Floats:
        values: Floats = windows[name].cast(float).fill_null(math.nan).to_numpy()
        return values

    placed = windows["placement"].cast(str).to_numpy()
    return {
        "window_l95_ms": _sums(column("seen_l95_ms"), unit, units),
        **{
            f"u_{name}": _sums(column(f"u_{name}"), unit, units)
            for name in problem.fabric.resources
        },
        **{
            f"share_{name}": _sums((placed == name).astype(np.float64), unit, units)
            for name in problem.candidates
        },
    }


def _migrations(pieces: Sequence[Piece], of_window: Ints, units: int) -> Floats:
    """Return migrations per run, spread over its windows."""
    heights = np.array([piece.windows.height for piece in pieces])
    moved = np.array([piece.migrations for piece in pieces], np.float64)
    share = np.repeat(1 / heights, heights)
    return np.stack(
        [
            np.bincount(of_window, weights=np.repeat(moved, heights) * share, minlength=units),
            np.bincount(of_window, weights=share, minlength=units),
        ],
        axis=1,
    )
