"""Summary of a run: the row of numbers that statistics over seeds are made of.

Only what follows the warm-up counts: the windows not flagged as such, the decisions at their
closes, and every cycle from the first of those windows to the end of the last. (After a migration
the next window begins where the order takes effect, so that some cycles lie between two windows;
they are cycles like any other. What is left after the last complete window is not played.)

L95 is given twice, because the two answer different questions:

* ``l95_ms``: mean over windows of the L95 that the controller saw, which J prices. An unfinished
  cycle counts with its age, so that it is always finite.
* ``p95_ms``: the 95th percentile of the final latencies of all cycles together, an order
  statistic. A lost cycle counts as infinite, and so does this where more than 5 % are lost.

Misses in any K consecutive cycles are counted for K = 20 and K = 100: 20 is the least K of which
5 %, the aim, is a whole number of misses, and 100 is about as long as a window. Unlike windows,
these stretches begin at every cycle.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.cost import tier_nodes
from dwell.errors import SimulationError
from dwell.model import Problem
from dwell.model.instants import NEVER_NS
from dwell.model.table_columns import NODE_OF, SHARE_OF
from dwell.study.quality import actuations, age_of_information, misses_in, track

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Row: TypeAlias = dict[str, float | int | str]

#: Points of the latency distributions: so many to a deadline, up to four deadlines.
GRID_PER_DEADLINE = 80
DEADLINES = 4

#: Column of what tells runs apart that differ in anything but their names.
PLAYED = "played"

#: K, the lengths of stretches of cycles, with m, the misses that are 5 % of one.
STRETCHES = {20: 1, 100: 5}


class Counted(NamedTuple):
    """The part of a run for statistics: no warm-up, no incomplete window."""

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
    decisions = run.decisions
    return Counted(
        windows,
        decisions.filter(decisions["window"] >= windows["window"][0]),
        run.cycles.slice(*_rows(run.cycles, begin, end)),
    )


def _rows(cycles: pl.DataFrame, begin: int, end: int) -> tuple[int, int]:
    """Return where cycles from begin to before end are in a table, and how many there are."""
    first, after = (int(cycles["cycle"].search_sorted(number)) for number in (begin, end))
    return first, after - first


def summarise(run: Run, problem: Problem, labels: Mapping[str, str | int]) -> Summary:
    """Sum up a run.

    Parameters
    ----------
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
    missed = cycles["missed"].to_numpy()
    ascending_ns = np.sort(cycles["latency_ns"].fill_null(NEVER_NS).to_numpy())
    row: Row = {
        **labels,
        "windows": windows.height,
        "cycles": cycles.height,
        "violation_rate": float(missed.mean()),
        "l95_ms": mean_of(windows["seen_l95_ms"]),
        **_percentiles(ascending_ns),
        **_utilisation(windows, problem),
        **_migrations(decisions),
        **_shares(windows["placement"], tuple(problem.candidates)),
        "cost": mean_of(windows["cost"]),
        "lost": int((~cycles["outcome"].is_in(["done", "in_flight"])).sum()),
        "in_flight": int((cycles["outcome"] == "in_flight").sum()),
        "longest_misses": longest_streak(missed),
        **_misses(missed),
        **_actuator(run.cycles, cycles, problem),
        "compute_ms": mean_of(cycles["compute_ns"]) / 1e6,
        "queue_ms": mean_of(cycles["queue_ns"]) / 1e6,
        "network_ms": mean_of(cycles["network_ns"]) / 1e6,
        PLAYED: _played(windows, cycles, problem),
    }
    within = count_within(ascending_ns, problem.pipeline.deadline_ms)
    return Summary(row, _costs(windows, decisions, problem, labels), within)


def _played(windows: pl.DataFrame, cycles: pl.DataFrame, problem: Problem) -> str:
    """Digest of what was played: of runs on one realisation, equal ones are the same run.

    It is that of every cycle's placement and latency, and of the nodes' utilisation, to which
    shadow jobs add where they delay nobody.
    """
    latencies_ns = cycles["latency_ns"].fill_null(NEVER_NS).to_numpy()
    digest = hashlib.blake2b(latencies_ns.tobytes(), digest_size=8)
    for name in problem.candidates:
        placed = (cycles["placement"] == name).fill_null(value=False)
        digest.update(np.packbits(placed.to_numpy()).tobytes())
    for node in problem.fabric.nodes:
        digest.update(windows[f"u_{node}"].to_numpy().tobytes())
    return digest.hexdigest()


def longest_streak(missed: NDArray[np.bool_]) -> int:
    """Length of the longest run of consecutive misses."""
    hits = np.flatnonzero(~missed)
    ends = np.concatenate(([-1], hits, [len(missed)]))
    return int(np.diff(ends).max()) - 1


def _misses(missed: NDArray[np.bool_]) -> dict[str, float]:
    """Misses in stretches of K cycles: the most, and the share of stretches with more than 5 %."""
    row: dict[str, float] = {}
    for stretch, aim in STRETCHES.items():
        counts = misses_in(missed, stretch)
        row[f"misses_in_{stretch}"] = int(counts.max())
        row[f"over_{aim}_in_{stretch}"] = float((counts > aim).mean())
    return row


def _actuator(played: pl.DataFrame, counted: pl.DataFrame, problem: Problem) -> dict[str, float]:
    """Age at the actuator and tracking error, until a period after the last counted release.

    What took effect before the first of them may still last, so that every cycle played is needed.
    """
    cycles = played[: played["cycle"].search_sorted(counted["cycle"][-1]) + 1]
    actuated = actuations(
        cycles["release_ns"].to_numpy(), cycles["latency_ns"].fill_null(NEVER_NS).to_numpy()
    )
    begin_ns = counted["release_ns"][0]
    end_ns = counted["release_ns"][-1] + round(problem.pipeline.period_ms * 1e6)
    age = age_of_information(actuated, begin_ns, end_ns)
    row = {f"aoi_{name}": value for name, value in age._asdict().items()}
    if problem.servo is not None:
        tracking = track(problem.servo, actuated, begin_ns, end_ns)
        row |= {"tracking_rms_mm": tracking.rms_mm, "tracking_iae_mm": tracking.mean_mm}
    return row


def count_within(ascending_ns: Ints, deadline_ms: float) -> Ints:
    """Count the cycles that finished within each point of the latency grid.

    Parameters
    ----------
    ascending_ns : int64 array, shape (n,)
        Latencies, `NEVER_NS` where the cycle never finished.

    Returns
    -------
    int64 array
        One a point of `latency_grid_ms`; a point is rounded to nanoseconds as the deadline is.
    """
    ends_ns = np.rint(latency_grid_ms(deadline_ms) * 1e6).astype(np.int64)
    return np.searchsorted(ascending_ns, ends_ns, side="right")


def mean_of(values: pl.Series) -> float:
    """Return the mean of what is there; NaN where nothing is."""
    mean = values.mean()
    return float(mean) if isinstance(mean, float) else float("nan")


def latency_ms(cycles: pl.DataFrame) -> Floats:
    """Final latencies, infinite where the cycle never finished."""
    final_ms: Floats = (cycles["latency_ns"].cast(float) / 1e6).fill_null(np.inf).to_numpy()
    return final_ms


def order_statistic(values: Floats, percent: int) -> float:
    """Return the ceil(percent n / 100)-th smallest: a percentile, never interpolated."""
    rank = -(-percent * len(values) // 100)
    return float(np.partition(values, rank - 1)[rank - 1])


def _percentiles(ascending_ns: Ints) -> dict[str, float]:
    """Percentiles of all cycles together, and how far the 95th is from the median."""
    ranks = [-(-percent * len(ascending_ns) // 100) - 1 for percent in (50, 95)]
    p50, p95 = (float(ns) / 1e6 if ns < NEVER_NS else np.inf for ns in ascending_ns[ranks])
    # Infinity less infinity is no number: where half of the cycles are lost, the tail has no end.
    return {"p95_ms": p95, "p50_ms": p50, "spread_ms": p95 - p50 if p50 < np.inf else np.inf}


def busiest_nodes(problem: Problem) -> dict[str, pl.Expr]:
    """Utilisation of the busiest node of each tier in a window; 0 of a tier without nodes.

    Returns
    -------
    dict of str to expression
        ``u_robot``, ``u_edge`` and ``u_cloud``, of the columns of windows.
    """
    import polars as pl

    return {
        f"u_{tier}": pl.max_horizontal([f"u_{node}" for node in nodes]) if nodes else pl.lit(0.0)
        for tier, nodes in tier_nodes(problem.objective)._asdict().items()
    }


def _utilisation(windows: pl.DataFrame, problem: Problem) -> dict[str, float]:
    """Mean over windows of the busiest node of a tier, and of every node."""
    busiest = windows.select(**busiest_nodes(problem))
    used = {name: mean_of(busiest[name]) for name in ("u_robot", "u_edge")}
    return used | {
        NODE_OF.format(node=node): mean_of(windows[f"u_{node}"]) for node in problem.fabric.nodes
    }


def _migrations(decisions: pl.DataFrame) -> dict[str, int]:
    """Count migrations, those that undo the one before, and the guard's moves, which are apart."""
    by_guard = decisions["reason"] == "guard"
    moves = decisions.filter(decisions["migrated"] & ~by_guard).select("incumbent", "placement")
    pairs: Sequence[tuple[str, str]] = moves.rows()
    undone = sum(now == before[::-1] for before, now in itertools.pairwise(pairs))
    guard_moves = int((decisions["migrated"] & by_guard).sum())
    return {"migrations": len(pairs), "returns": undone, "guard_moves": guard_moves}


def _shares(placements: pl.Series, candidates: tuple[str, ...]) -> dict[str, float]:
    """Share of windows that began under each candidate."""
    return {SHARE_OF.format(candidate=name): mean_of(placements == name) for name in candidates}


def _costs(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    problem: Problem,
    labels: Mapping[str, str | int],
) -> list[Row]:
    """Estimated J of every candidate while another was active, and its measured J."""
    rows: list[Row] = []
    for name in problem.candidates:
        idle = decisions[f"j_{name}"].filter(decisions["incumbent"] != name)
        active = windows["cost"].filter(windows["placement"] == name)
        rows.append(
            {
                **labels,
                "candidate": name,
                "estimated": mean_of(idle),
                "measured": mean_of(active),
                "windows": active.len(),
            }
        )
    return rows
