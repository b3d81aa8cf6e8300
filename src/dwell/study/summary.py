"""Summary of a run: one row of numbers for statistics over seeds.

The warm-up does not count. The summary covers the other windows, the decisions at their ends, and
every cycle from the first of these windows to the end of the last. (After a migration the next
window begins when the order takes effect. Cycles between two windows count, too. A run has no
cycles after the last complete window.)

The summary has two forms of L95, for two questions:

* ``l95_ms``: mean over windows of the L95 that the controller saw and that J prices. It is always
  finite, because an unfinished cycle counts with its age.
* ``p95_ms``: the 95th percentile of the final latencies of all cycles, an order statistic. A lost
  cycle counts as infinite, so the percentile is infinite if more than 5 % are lost.

Misses in any K consecutive cycles are counted for K = 20 and K = 100. K = 20 is the smallest K for
which 5 % (the aim) is an integer number of misses; K = 100 is about the length of a window. Unlike
windows, these stretches begin at every cycle.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.control.windows import busiest
from dwell.errors import SimulationError
from dwell.model import FrozenDict, Problem
from dwell.model.instants import NEVER_NS
from dwell.model.number_arrays import Floats, Ints, Mask
from dwell.model.order_statistic import rank_of
from dwell.model.stretches import misses_in
from dwell.model.table_columns import SHARE_OF, USE_OF
from dwell.record.moves import by_guard
from dwell.study.metric import further_columns
from dwell.study.quality import actuations, age_of_information, track

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Names, Run, TableArrays

Row: TypeAlias = dict[str, float | int | str]

#: Points per deadline in the latency distributions, and their range in deadlines.
GRID_PER_DEADLINE = 80
DEADLINES = 4

#: Parts of a latency.
PARTS = ("compute", "queue", "network")

#: Column with the digest of placements, latencies and utilisation (see `_played`).
PLAYED = "played"
#: Column with the digest of the latencies alone; shadow jobs may leave it unchanged.
LATENCIES = "latencies"

#: K, the length of a stretch of cycles, and m, 5 % of it.
STRETCHES = {20: 1, 100: 5}


class Counted(NamedTuple):
    """The part of a run for statistics: complete windows after the warm-up."""

    windows: pl.DataFrame
    decisions: pl.DataFrame
    cycles: pl.DataFrame


@dataclass(frozen=True, slots=True)
class Summary:
    """One run in numbers.

    Parameters
    ----------
    row : dict
        One value per column of ``Comparison.runs``.
    costs : list of dict
        One row per candidate: mean estimated J while the candidate was not active, mean measured J
        while it was active, and the share of cycles that each alternative received as shadows then.
    within : int64 array
        Number of cycles that finished within each point of the latency grid.
    compared : mapping
        Values for the comparison of runs with the references (see `dwell.study.player`).
    """

    row: Row
    costs: list[Row]
    within: Ints
    compared: Mapping[str, float | str | bytes] = field(default_factory=FrozenDict)


def latency_grid_ms(deadline_ms: float) -> Floats:
    """Grid points of the latency distributions, ms, ascending; includes the deadline."""
    points = np.arange(1, DEADLINES * GRID_PER_DEADLINE + 1, dtype=np.float64)
    return points / GRID_PER_DEADLINE * deadline_ms


@dataclass(frozen=True, slots=True, eq=False)
class Latencies:
    """Final latencies of cycles, each with its place on the latency grid.

    An order statistic needs no sort: it is selected among the cycles of one place.

    Parameters
    ----------
    latency_ns : int64 array, shape (n,)
        `NEVER_NS` if the cycle never finished.
    place : integer array, shape (n,)
        Index of the first grid point at or above the latency; the number of points if above all.
    within : int64 array
        Number of cycles that finished within each point of the grid.
    """

    latency_ns: Ints
    place: NDArray[np.integer]
    within: Ints

    @classmethod
    def of(cls, latency_ns: Ints, deadline_ms: float) -> Latencies:
        """Place latencies on the grid; its points are rounded to ns like the deadline."""
        ends_ns = np.rint(latency_grid_ms(deadline_ms) * 1e6).astype(np.int64)
        points, step_ns = len(ends_ns), deadline_ms * 1e6 / GRID_PER_DEADLINE
        place: NDArray[np.integer]
        if step_ns < 1.0:  # several points are one
            place = np.searchsorted(ends_ns, latency_ns)
        else:
            # The number of points below a latency, corrected by 1 for the rounding of points.
            below = np.minimum(latency_ns / step_ns, points).astype(np.int16)
            place = below + (latency_ns > np.append(-1, ends_ns)[below]) - 1
        within = np.bincount(place, minlength=points + 1)[:points].cumsum()
        return cls(latency_ns, place, within)

    def percentile_ms(self, percent: int) -> float:
        """Return the ceil(percent n / 100)-th smallest; infinite if that cycle never finished."""
        rank = rank_of(percent, len(self.latency_ns))
        at = int(np.searchsorted(self.within, rank))
        rank -= int(self.within[at - 1]) if at else 0
        ns = int(np.partition(self.latency_ns[self.place == at], rank - 1)[rank - 1])
        return ns / 1e6 if ns < NEVER_NS else np.inf


def count_in(run: Run, window_cycles: int) -> Counted:
    """Return a run without its warm-up and the cycles after the last complete window.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    windows, decisions, cycles = _counting(run, window_cycles)
    return Counted(run.windows.filter(windows), run.decisions.filter(decisions), run.cycles[cycles])


def _counting(run: Run, window_cycles: int) -> tuple[Mask, Mask, slice]:
    """Return which windows, decisions and cycles count (see `count_in`)."""
    windows = run.arrays("windows")
    counts = ~windows["warmup"]
    if not counts.any():
        raise SimulationError(
            f"none of {len(counts)} windows is left after the warm-up; ask for more windows"
        )
    first_cycle = windows["first_cycle"][counts]
    ends = (first_cycle[0], first_cycle[-1] + window_cycles)
    begin, end = np.searchsorted(run.arrays("cycles")["cycle"], ends).tolist()
    decided = run.arrays("decisions")["window"] >= windows["window"][counts][0]
    return counts, decided, slice(begin, end)


def summarise(run: Run, problem: Problem, labels: Mapping[str, str | int]) -> Summary:
    """Return the summary of a run.

    Parameters
    ----------
    problem : Problem
        Problem of the run.
    labels : mapping
        Leading columns of the row: scenario, policy, seed.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    counts, decided, counted = _counting(run, problem.window_cycles)
    windows, decisions, cycles = (run.arrays(name) for name in ("windows", "decisions", "cycles"))
    due = _due(cycles, counted, problem)
    missed, final_ns = cycles["missed"][counted][due], cycles["latency_ns"][counted][due]
    latencies = Latencies.of(final_ns, problem.pipeline.deadline_ms)
    answer = _answer(windows, counts, missed)
    placed = windows.names("placement")[counts]
    active = {name: placed.equal(name) for name in problem.candidates}
    used = {name: share[counts] for name, share in used_in(windows, problem).items()}
    row: Row = {
        **labels,
        "windows": int(counts.sum()),
        "cycles": len(missed),
        "violation_rate": answer["violation_rate"],
        "l95_ms": answer["l95_ms"],
        **_percentiles(latencies),
        **_utilisation(used, problem),
        **_migrations(decisions, decided),
        **{SHARE_OF.format(candidate=name): share_of(those) for name, those in active.items()},
        "cost": answer["cost"],
        **_further(windows, counts, active, problem),
        **_unfinished(cycles.names("outcome")[counted][due]),
        "longest_misses": longest_streak(missed),
        **_misses(missed),
        **_actuator(cycles, counted, problem),
        **{f"{part}_ms": mean_of(cycles[f"{part}_ns"][counted]) / 1e6 for part in PARTS},
        LATENCIES: hashlib.blake2b(final_ns.data, digest_size=8).hexdigest(),
        PLAYED: _played(final_ns, cycles.names("placement")[counted][due], used, problem),
    }
    incumbent, cost = decisions.names("incumbent"), windows["cost"][counts]
    fractions = run.meta.get("shadow_fractions", {})
    costs: list[Row] = [
        {
            **labels,
            "candidate": name,
            "estimated": mean_of(decisions[f"j_{name}"][decided & ~incumbent.equal(name)]),
            "measured": mean_of(cost[those]),
            "windows": int(those.sum()),
            "shadow_fraction": fractions.get(name, np.nan),
        }
        for name, those in active.items()
    ]
    return Summary(row, costs, latencies.within)


def answer_of(run: Run, problem: Problem) -> dict[str, float]:
    """Return only `violation_rate`, `l95_ms` and `cost` of a run's summary.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    counts, _, counted = _counting(run, problem.window_cycles)
    cycles = run.arrays("cycles")
    missed = cycles["missed"][counted][_due(cycles, counted, problem)]
    return _answer(run.arrays("windows"), counts, missed)


def _due(cycles: TableArrays, counted: slice, problem: Problem) -> Mask | slice:
    """Return which of the counted cycles have a sink that is due."""
    if not problem.pipeline.has_idle_cycles:
        return slice(None)
    return ~cycles.names("outcome")[counted].equal("idle")


def _answer(windows: TableArrays, counts: Mask, missed: Mask) -> dict[str, float]:
    return {
        "violation_rate": share_of(missed),
        "l95_ms": mean_of(windows["seen_l95_ms"][counts]),
        "cost": mean_of(windows["cost"][counts]),
    }


def _further(
    windows: TableArrays, counts: Mask, active: Mapping[str, Mask], problem: Problem
) -> dict[str, float]:
    """Return means over windows: ages, and prices of bytes and of the nodes of placements."""
    columns = [column for column in further_columns(problem.pipeline.chains) if column in windows]
    means = {column: mean_of(windows[column][counts]) for column in columns}
    if problem.fabric.has_node_prices:
        means["nodes_price_per_hour"] = sum(
            problem.fabric.price_per_hour(placement.nodes) * share_of(active[name])
            for name, placement in problem.candidates.items()
        )
    return means


def moves_of(run: Run, problem: Problem) -> dict[str, int]:
    """Return only `migrations`, `returns` and `guard_moves` of a run's summary.

    Raises
    ------
    SimulationError
        If the run has no window after its warm-up.
    """
    return _migrations(run.arrays("decisions"), _counting(run, problem.window_cycles)[1])


def _unfinished(outcomes: Names) -> dict[str, int]:
    """Count the lost cycles, and the cycles in flight at the end."""
    done, in_flight = (int(outcomes.equal(name).sum()) for name in ("done", "in_flight"))
    return {"lost": len(outcomes.places) - done - in_flight, "in_flight": in_flight}


def _played(latency_ns: Ints, placed: Names, used: Mapping[str, Floats], problem: Problem) -> str:
    """Digest of a run; runs on one realisation are identical if their digests are equal.

    It covers the placement and latency of every cycle, and the utilisation of resources, which
    shadow jobs change even if they delay no cycle.
    """
    digest = hashlib.blake2b(latency_ns.data, digest_size=8)
    for name in problem.candidates:
        digest.update(np.packbits(placed.equal(name)).data)
    for share in used.values():
        digest.update(share.data)
    return digest.hexdigest()


def longest_streak(missed: Mask) -> int:
    """Length of the longest run of consecutive misses."""
    hits = np.flatnonzero(~missed)
    ends = np.concatenate(([-1], hits, [len(missed)]))
    return int(np.diff(ends).max()) - 1


def _misses(missed: Mask) -> dict[str, float]:
    """Largest number of misses in K cycles, and share of stretches with more than 5 % misses."""
    row: dict[str, float] = {}
    every = misses_in(missed, STRETCHES)
    for (stretch, aim), counts in zip(STRETCHES.items(), every, strict=True):
        row[f"misses_in_{stretch}"] = int(counts.max())
        row[f"over_{aim}_in_{stretch}"] = float((counts > aim).mean())
    return row


def _actuator(cycles: TableArrays, counted: slice, problem: Problem) -> dict[str, float]:
    """Age at the actuator and tracking error, until a period after the last counted release.

    An earlier command may still be in effect at the first counted release, so the cycles of the
    warm-up are needed, too.
    """
    release_ns = cycles["release_ns"][: counted.stop]
    actuated = actuations(release_ns, cycles["latency_ns"][: counted.stop])
    begin_ns = int(release_ns[counted.start])
    end_ns = int(release_ns[-1]) + problem.pipeline.period_ns
    age = age_of_information(actuated, begin_ns, end_ns)
    row = {f"aoi_{name}": value for name, value in age._asdict().items()}
    if problem.servo is not None:
        if problem.objective.latency is not None:
            of_chain = (cycles[name] for name in ("chain_latency_ns", "chain_age_ns"))
            actuated = actuations(release_ns, *(values[: counted.stop] for values in of_chain))
        tracking = track(problem.servo, actuated, begin_ns, end_ns)
        row |= {"tracking_rms_mm": tracking.rms_mm, "tracking_iae_mm": tracking.mean_mm}
    return row


def mean_of(values: NDArray[Any]) -> float:
    """Return the mean of the present values; NaN without any.

    Floats are added in Polars' order, to match the mean of a table's column to the last bit: the
    first len % 128 values one after another; each further row of 128 values in 16 parallel sums;
    the sums of rows in pairs.

    Parameters
    ----------
    values : float64 array, NaN if missing; or int64 array, `NEVER_NS` if missing
    """
    if values.dtype == np.int64:
        there = values if values.max(initial=0) < NEVER_NS else values[values < NEVER_NS]
        return int(there.sum()) / len(there) if len(there) else float("nan")
    missing = np.isnan(values)
    count = len(values) - int(missing.sum())
    if not count:
        return float("nan")
    terms: Floats = np.where(missing, 0.0, values)
    begin = len(terms) % 128
    sums: Floats = terms[begin:].reshape(-1, 8, 16).sum(axis=1)
    for width in (8, 4):
        sums = sums[:, :width] + sums[:, width:]
    rows = (sums[:, 0] + sums[:, 2]) + (sums[:, 1] + sums[:, 3])
    # One after another, without `sum`: it rounds floats differently from Python 3.12 on.
    ahead = float(np.add.accumulate(terms[:begin])[-1]) if begin else 0.0
    return (_sum_of_pairs(rows.tolist()) + ahead) / count


def _sum_of_pairs(values: Sequence[float]) -> float:
    """Return the sum of values, added recursively as the sums of both halves."""
    if len(values) < 2:
        return values[0] if values else 0.0
    half = len(values) // 2
    return _sum_of_pairs(values[:half]) + _sum_of_pairs(values[half:])


def share_of(those: Mask) -> float:
    """Return the share of true values in a mask with at least one row."""
    return float(np.count_nonzero(those) / len(those))


def due_cycles(cycles: pl.DataFrame) -> pl.DataFrame:
    """Return the cycles in which a sink is due; all others have neither a latency nor a loss."""
    import polars as pl

    return cycles.filter(pl.col("outcome").cast(pl.String) != "idle")


def latency_ms(cycles: pl.DataFrame) -> Floats:
    """Final latencies, infinite for cycles that never finished."""
    final_ms: Floats = (cycles["latency_ns"].cast(float) / 1e6).fill_null(np.inf).to_numpy()
    return final_ms


def _percentiles(latencies: Latencies) -> dict[str, float]:
    """Percentiles over all cycles, and the distance of the 95th from the median."""
    p50, p95 = (latencies.percentile_ms(percent) for percent in (50, 95))
    # Infinity minus infinity is NaN: the spread is infinite if half of the cycles are lost.
    return {"p95_ms": p95, "p50_ms": p50, "spread_ms": p95 - p50 if p50 < np.inf else np.inf}


def used_in(windows: TableArrays, problem: Problem) -> dict[str, Floats]:
    """Utilisation of every resource in every window."""
    return {name: windows[f"u_{name}"] for name in problem.fabric.resources}


def _utilisation(used: Mapping[str, Floats], problem: Problem) -> dict[str, float]:
    """Mean utilisation over windows: the busiest resource of each tier, and every resource."""
    robot, edge, _ = busiest(used, problem)
    return {
        "u_robot": mean_of(robot),
        "u_edge": mean_of(edge),
        **{USE_OF.format(resource=name): mean_of(share) for name, share in used.items()},
    }


def _migrations(decisions: TableArrays, decided: Mask) -> dict[str, int]:
    """Count the policy's migrations, its returns to the previous placement, and guard moves."""
    migrated = decided & decisions["migrated"]
    guarded = by_guard(decisions)
    ends = (decisions.names(end)[migrated & ~guarded] for end in ("incumbent", "placement"))
    pairs = list(zip(*(end.to_list() for end in ends), strict=True))
    undone = sum(now == before[::-1] for before, now in itertools.pairwise(pairs))
    guard_moves = int((migrated & guarded).sum())
    return {"migrations": len(pairs), "returns": undone, "guard_moves": guard_moves}
