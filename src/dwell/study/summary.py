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
from collections.abc import Mapping
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


@dataclass(frozen=True, slots=True, eq=False)
class Latencies:
    """Final latencies of cycles, each at its place on the latency grid.

    An order statistic is sought among the cycles of one place, so that nothing is sorted.

    Parameters
    ----------
    latency_ns : int64 array, shape (n,)
        `NEVER_NS` where the cycle never finished.
    place : integer array, shape (n,)
        The first point of the grid that it is within; the number of points where it is in none.
    within : int64 array
        Cycles that finished within each point of the grid.
    """

    latency_ns: Ints
    place: NDArray[np.integer]
    within: Ints

    @classmethod
    def of(cls, latency_ns: Ints, deadline_ms: float) -> Latencies:
        """Place latencies on the grid, whose points are rounded to ns as the deadline is."""
        ends_ns = np.rint(latency_grid_ms(deadline_ms) * 1e6).astype(np.int64)
        points, step_ns = len(ends_ns), deadline_ms * 1e6 / GRID_PER_DEADLINE
        place: NDArray[np.integer]
        if step_ns < 1.0:  # several points are one
            place = np.searchsorted(ends_ns, latency_ns)
        else:
            # So many points are below, give or take the one whose rounding decides.
            below = np.minimum(latency_ns / step_ns, points).astype(np.int16)
            place = below + (latency_ns > np.append(-1, ends_ns)[below]) - 1
        within = np.bincount(place, minlength=points + 1)[:points].cumsum()
        return cls(latency_ns, place, within)

    def percentile_ms(self, percent: int) -> float:
        """Return the ceil(percent n / 100)-th smallest; infinite of one that never finished."""
        rank = -(-percent * len(self.latency_ns) // 100)
        at = int(np.searchsorted(self.within, rank))
        rank -= int(self.within[at - 1]) if at else 0
        ns = int(np.partition(self.latency_ns[self.place == at], rank - 1)[rank - 1])
        return ns / 1e6 if ns < NEVER_NS else np.inf


def count_in(run: Run, window_cycles: int) -> Counted:
    """Leave out the warm-up, and the cycles after the last complete window.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    windows, decisions, cycles = run.windows, run.decisions, run.cycles
    windows = windows.filter(~windows["warmup"])
    if windows.is_empty():
        raise SimulationError(
            f"none of {run.windows.height} windows is left after the warm-up; ask for more windows"
        )
    begin, end = windows["first_cycle"][0], windows["first_cycle"][-1] + window_cycles
    first, after = np.searchsorted(cycles["cycle"].to_numpy(), (begin, end)).tolist()
    return Counted(
        windows,
        decisions.filter(decisions["window"] >= windows["window"][0]),
        cycles.slice(first, after - first),
    )


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
    # Also those of the warm-up: what took effect in it may last.
    after = int(np.searchsorted(run.cycles["cycle"].to_numpy(), cycles["cycle"][-1])) + 1
    release_ns = run.cycles["release_ns"].to_numpy()[:after]
    latency_ns = _final_ns(run.cycles["latency_ns"])[:after]
    counted_ns = latency_ns[after - cycles.height :]
    latencies = Latencies.of(counted_ns, problem.pipeline.deadline_ms)
    row: Row = {
        **labels,
        "windows": windows.height,
        "cycles": cycles.height,
        "violation_rate": np.count_nonzero(missed) / len(missed),
        "l95_ms": mean_of(windows["seen_l95_ms"]),
        **_percentiles(latencies),
        **_utilisation(windows, problem),
        **_migrations(decisions),
        **_shares(windows["placement"], tuple(problem.candidates)),
        "cost": mean_of(windows["cost"]),
        **_unfinished(cycles["outcome"]),
        "longest_misses": longest_streak(missed),
        **_misses(missed),
        **_actuator(release_ns, latency_ns, cycles.height, problem),
        "compute_ms": mean_of(cycles["compute_ns"]) / 1e6,
        "queue_ms": mean_of(cycles["queue_ns"]) / 1e6,
        "network_ms": mean_of(cycles["network_ns"]) / 1e6,
        PLAYED: _played(windows, cycles["placement"], counted_ns, problem),
    }
    return Summary(row, _costs(windows, decisions, problem, labels), latencies.within)


def _final_ns(latency_ns: pl.Series) -> Ints:
    """Final latencies, `NEVER_NS` where the cycle never finished."""
    if latency_ns.null_count():
        latency_ns = latency_ns.set(latency_ns.is_null(), NEVER_NS)
    return latency_ns.to_numpy()


def _unfinished(outcomes: pl.Series) -> dict[str, int]:
    """Count the cycles that were lost, and those that were under way at the end."""
    done, in_flight = (int((outcomes == name).sum()) for name in ("done", "in_flight"))
    return {"lost": outcomes.count() - done - in_flight, "in_flight": in_flight}


def _played(windows: pl.DataFrame, placed: pl.Series, latency_ns: Ints, problem: Problem) -> str:
    """Digest of what was played: of runs on one realisation, equal ones are the same run.

    It is that of every cycle's placement and latency, and of the nodes' utilisation, to which
    shadow jobs add where they delay nobody.
    """
    digest = hashlib.blake2b(latency_ns.data, digest_size=8)
    for name in problem.candidates:
        digest.update(np.packbits((placed == name).to_numpy()).data)
    for node in problem.fabric.nodes:
        digest.update(windows[f"u_{node}"].to_numpy().data)
    return digest.hexdigest()


def longest_streak(missed: NDArray[np.bool_]) -> int:
    """Length of the longest run of consecutive misses."""
    hits = np.flatnonzero(~missed)
    ends = np.concatenate(([-1], hits, [len(missed)]))
    return int(np.diff(ends).max()) - 1


def _misses(missed: NDArray[np.bool_]) -> dict[str, float]:
    """Misses in stretches of K cycles: the most, and the share of stretches with more than 5 %."""
    row: dict[str, float] = {}
    every = misses_in(missed, STRETCHES)
    for (stretch, aim), counts in zip(STRETCHES.items(), every, strict=True):
        row[f"misses_in_{stretch}"] = int(counts.max())
        row[f"over_{aim}_in_{stretch}"] = float((counts > aim).mean())
    return row


def _actuator(
    release_ns: Ints, latency_ns: Ints, counted: int, problem: Problem
) -> dict[str, float]:
    """Age at the actuator and tracking error, until a period after the last release.

    Parameters
    ----------
    release_ns, latency_ns : int64 array
        Every cycle from the first on; the last `counted` of them count.
    """
    actuated = actuations(release_ns, latency_ns)
    begin_ns = int(release_ns[-counted])
    end_ns = int(release_ns[-1]) + round(problem.pipeline.period_ms * 1e6)
    age = age_of_information(actuated, begin_ns, end_ns)
    row = {f"aoi_{name}": value for name, value in age._asdict().items()}
    if problem.servo is not None:
        tracking = track(problem.servo, actuated, begin_ns, end_ns)
        row |= {"tracking_rms_mm": tracking.rms_mm, "tracking_iae_mm": tracking.mean_mm}
    return row


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


def _percentiles(latencies: Latencies) -> dict[str, float]:
    """Percentiles of all cycles together, and how far the 95th is from the median."""
    p50, p95 = (latencies.percentile_ms(percent) for percent in (50, 95))
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
    migrated, by_guard = decisions["migrated"], decisions["reason"] == "guard"
    moves = migrated & ~by_guard
    pairs = [
        *zip(*(decisions[end].filter(moves) for end in ("incumbent", "placement")), strict=True)
    ]
    undone = sum(now == before[::-1] for before, now in itertools.pairwise(pairs))
    guard_moves = int((migrated & by_guard).sum())
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
