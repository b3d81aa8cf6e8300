"""What one run comes to: the row of numbers that statistics over seeds are made of.

Only what follows the warm-up counts: the windows not flagged as such, the decisions at their
closes, and every cycle from the first of those windows to the end of the last. (After a migration
the next window begins where the order takes effect, so that some cycles lie between two windows;
they are cycles like any other. What is left after the last complete window is not played.)

L95 is given twice, because the two answer different questions:

* ``l95_ms``: mean over windows of the L95 that the controller saw, which J prices. An unfinished
  cycle counts with its age, so that it is always finite.
* ``p95_ms``: the 95th percentile of the final latencies of all cycles together, an order
  statistic. A lost cycle counts as infinite, and so does this where more than 5 % are lost.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.cost import tier_nodes
from dwell.errors import SimulationError
from dwell.model import Problem

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

__all__ = [
    "GRID_PER_DEADLINE",
    "Counted",
    "Summary",
    "count_in",
    "latency_grid_ms",
    "latency_ms",
    "longest_streak",
    "order_statistic",
    "summarise",
]

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Row: TypeAlias = dict[str, float | int | str]

#: Points of the latency distributions: so many to a deadline, up to four deadlines.
GRID_PER_DEADLINE = 80
DEADLINES = 4


class Counted(NamedTuple):
    """What of a run statistics are made of: no warm-up, no incomplete window."""

    windows: pl.DataFrame
    decisions: pl.DataFrame
    cycles: pl.DataFrame


@dataclass(frozen=True, slots=True)
class Summary:
    """One run in numbers.

    Parameters
    ----------
    row : dict
        One value a column of ``Comparison.runs``.
    costs : list of dict
        One a candidate: mean estimated J while it was not active, mean measured J while it was.
    within : int64 array
        Cycles that finished within each point of the latency grid.
    """

    row: Row
    costs: list[Row]
    within: Ints


def latency_grid_ms(deadline_ms: float) -> Floats:
    """Points at which distributions of latency are kept, ascending; D is one of them."""
    points = np.arange(1, DEADLINES * GRID_PER_DEADLINE + 1, dtype=np.float64)
    return points / GRID_PER_DEADLINE * deadline_ms


def count_in(run: Run, window_cycles: int) -> Counted:
    """Leave out the warm-up, and the cycles after the last complete window.

    Parameters
    ----------
    run : Run
    window_cycles : int
        W.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    import polars as pl

    windows = run.windows.filter(~pl.col("warmup"))
    if windows.is_empty():
        raise SimulationError(
            f"none of {run.windows.height} windows is left after the warm-up; ask for more windows"
        )
    begin, end = windows["first_cycle"][0], windows["first_cycle"][-1] + window_cycles
    return Counted(
        windows,
        run.decisions.filter(pl.col("window") >= windows["window"][0]),
        run.cycles.filter((pl.col("cycle") >= begin) & (pl.col("cycle") < end)),
    )


def summarise(run: Run, problem: Problem, labels: Mapping[str, str | int]) -> Summary:
    """Sum up a run.

    Parameters
    ----------
    run : Run
    problem : Problem
        The one it was made with.
    labels : mapping
        Leading columns of the row: scenario, policy, seed.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    windows, decisions, cycles = count_in(run, problem.window_cycles)
    final_ms = latency_ms(cycles)
    row: Row = {
        **labels,
        "windows": windows.height,
        "cycles": cycles.height,
        "violation_rate": _mean(cycles["missed"]),
        "l95_ms": _mean(windows["seen_l95_ms"]),
        **_percentiles(final_ms),
        **_utilisation(windows, problem),
        **_migrations(decisions),
        **_shares(windows["placement"], tuple(problem.candidates)),
        "cost": _mean(windows["cost"]),
        "lost": int((~cycles["outcome"].is_in(["done", "in_flight"])).sum()),
        "longest_misses": longest_streak(cycles["missed"].to_numpy()),
        "compute_ms": _mean(cycles["compute_ns"]) / 1e6,
        "queue_ms": _mean(cycles["queue_ns"]) / 1e6,
        "network_ms": _mean(cycles["network_ns"]) / 1e6,
    }
    grid = latency_grid_ms(problem.pipeline.deadline_ms)
    within = np.searchsorted(np.sort(final_ms), grid, side="right")
    return Summary(row, _costs(windows, decisions, problem, labels), within)


def longest_streak(missed: NDArray[np.bool_]) -> int:
    """Length of the longest run of consecutive misses."""
    hits = np.flatnonzero(~missed)
    ends = np.concatenate(([-1], hits, [len(missed)]))
    return int(np.diff(ends).max()) - 1


def _mean(values: pl.Series) -> float:
    """Mean of what is there; NaN where nothing is."""
    mean = values.cast(float).mean()
    return float(mean) if isinstance(mean, float) else float("nan")


def latency_ms(cycles: pl.DataFrame) -> Floats:
    """Final latencies, infinite where the cycle never finished."""
    final_ms: Floats = (cycles["latency_ns"].cast(float) / 1e6).fill_null(np.inf).to_numpy()
    return final_ms


def order_statistic(values: Floats, percent: int) -> float:
    """Return the ceil(percent n / 100)-th smallest: a percentile, never interpolated."""
    rank = -(-percent * len(values) // 100)
    return float(np.partition(values, rank - 1)[rank - 1])


def _percentiles(final_ms: Floats) -> dict[str, float]:
    """Percentiles of all cycles together, and how far the 95th is from the median."""
    p95, p50 = (order_statistic(final_ms, percent) for percent in (95, 50))
    # Infinity less infinity is no number: where half of the cycles are lost, the tail has no end.
    return {"p95_ms": p95, "p50_ms": p50, "spread_ms": p95 - p50 if p50 < np.inf else np.inf}


def _utilisation(windows: pl.DataFrame, problem: Problem) -> dict[str, float]:
    """Mean over windows of the busiest node of a tier, and of every node."""
    import polars as pl

    tiers = tier_nodes(problem.objective)
    used: dict[str, float] = {}
    for tier in ("robot", "edge"):
        names = [f"u_{node}" for node in getattr(tiers, tier)]
        busiest = windows.select(pl.max_horizontal(names)).to_series() if names else None
        used[f"u_{tier}"] = 0.0 if busiest is None else _mean(busiest)
    return used | {f"node_{node}": _mean(windows[f"u_{node}"]) for node in problem.fabric.nodes}


def _migrations(decisions: pl.DataFrame) -> dict[str, int]:
    """Count migrations, and those that undo the one before."""
    moves = decisions.filter(decisions["migrated"]).select("incumbent", "placement")
    pairs: Sequence[tuple[str, str]] = moves.rows()
    undone = sum(now == before[::-1] for before, now in itertools.pairwise(pairs))
    return {"migrations": len(pairs), "returns": undone}


def _shares(placements: pl.Series, candidates: tuple[str, ...]) -> dict[str, float]:
    """Share of windows that began under each candidate."""
    return {f"share_{name}": _mean(placements == name) for name in candidates}


def _costs(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    problem: Problem,
    labels: Mapping[str, str | int],
) -> list[Row]:
    """Estimated J of every candidate while another was active, and its measured J."""
    rows: list[Row] = []
    for name in problem.candidates:
        idle = decisions.filter(decisions["incumbent"] != name)
        active = windows.filter(windows["placement"] == name)
        rows.append(
            {
                **labels,
                "candidate": name,
                "estimated": _mean(idle[f"j_{name}"]),
                "measured": _mean(active["cost"]),
                "windows": active.height,
            }
        )
    return rows
