"""Phases of a run, the stretches with the same active disturbances, and their results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from dwell.display import Measure
from dwell.model.disturbed import Disturbed
from dwell.model.order_statistic import percentile
from dwell.model.table_columns import SHARE_OF
from dwell.record.moves import moves
from dwell.report.formatting import FINAL_L95
from dwell.report.palette import Palette
from dwell.report.table import WITH_WARMUP, Columns, Table, Text
from dwell.study.metric import METRICS, metric_of
from dwell.study.summary import due_cycles, latency_ms

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run
    from dwell.report.run_header import RunHeader

CALM = "baseline"
#: Largest number of phases in a table; runs with more phases have no table.
MOST = 16


class Phase(NamedTuple):
    """A stretch of time, named ``baseline`` or by the kinds of its disturbances."""

    name: str
    begin_s: float
    end_s: float


def phases(events: Sequence[Disturbed], end_s: float) -> list[Phase]:
    """Return the phases of a run in order, from 0 to `end_s`."""
    edges = {0.0, end_s}
    for event in events:
        edges.update(edge for edge in (event.begin_s, event.end_s) if 0 < edge < end_s)
    found: list[Phase] = []
    for begin_s, until_s in itertools.pairwise(sorted(edges)):
        kinds = [event.kind for event in events if event.begin_s <= begin_s < event.end_s]
        name = " and ".join(dict.fromkeys(kinds)) or CALM
        if found and found[-1].name == name:
            found[-1] = found[-1]._replace(end_s=until_s)
        else:
            found.append(Phase(name, begin_s, until_s))
    return found


class PhaseRow(NamedTuple):
    """Results of a phase.

    `violation_rate` and `l95_ms` use final latencies; L95 is infinite if more than 5 % of the
    cycles never finished. `lost` counts those cycles. `shares` has the share of the cycles by
    placement, the largest first. A move counts in the phase that releases the first cycle on the
    new placement; `migrations` leaves out moves of the guard. `rms_mm` and `rms_px` are the
    tracking error, NaN if unknown.
    """

    name: str
    begin_s: float
    end_s: float
    cycles: int
    violation_rate: float
    l95_ms: float
    lost: int
    shares: Mapping[str, float]
    migrations: int
    guard_moves: int
    rms_mm: float
    rms_px: float


def phase_rows(run: Run, header: RunHeader) -> list[PhaseRow]:
    """Return the phases of a run that have cycles; an empty list for more than `MOST` phases."""
    import polars as pl

    cycles = run.cycles[: run.last_window_end]
    if cycles.is_empty():
        return []
    released_s = cycles["release_ns"].to_numpy() / 1e9
    period_s = header.problem.pipeline.period_ms / 1e3
    found = phases(header.disturbed, float(released_s[-1]) + period_s)
    if len(found) > MOST:
        return []
    moved_s = _moves(cycles)
    guard_s = _guarded(run, moved_s)
    rows = []
    for phase in found:
        inside = (phase.begin_s <= released_s) & (released_s < phase.end_s)
        mine = due_cycles(cycles.filter(pl.Series(inside)))
        if mine.is_empty():
            continue
        count = sum(phase.begin_s <= at_s < phase.end_s for at_s, _ in moved_s)
        guards = sum(phase.begin_s <= at_s < phase.end_s for at_s in guard_s)
        counts = mine["placement"].cast(pl.String).value_counts(sort=True)
        rms_mm, rms_px = (math.nan, math.nan)
        if header.tracking is not None:
            rms_mm, rms_px = header.tracking.rms(phase.begin_s, phase.end_s)
        rows.append(
            PhaseRow(
                *phase,
                mine.height,
                float(mine["missed"].to_numpy().mean()),
                percentile(latency_ms(mine), 95),
                int(mine["latency_ns"].is_null().sum()),
                {name: count / mine.height for name, count in counts.rows()},
                max(count - guards, 0),
                guards,
                rms_mm,
                rms_px,
            )
        )
    return rows


def phase_table(rows: Sequence[PhaseRow], palette: Palette) -> Table:
    """Return a table with one row per phase; it has the tracking error if a phase knows it."""
    used = {name for row in rows for name in row.shares}
    shares = {SHARE_OF.format(candidate=name): name for name in palette.placements if name in used}
    columns: Columns = [
        Text("name", "phase"),
        Measure("begin_s", "from", "s", decimals=0),
        Measure("end_s", "to", "s", decimals=0),
        METRICS["violation_rate"],
        FINAL_L95,
        METRICS["lost"],
        *map(metric_of, shares),
        METRICS["migrations"],
        METRICS["guard_moves"],
    ]
    if any(math.isfinite(row.rms_mm) for row in rows):
        errors = Measure("rms_mm", "error", "mm", decimals=2), Measure("rms_px", "error", "px")
        columns += errors
    shown = [
        {**row._asdict(), **{one: row.shares.get(name, 0.0) for one, name in shares.items()}}
        for row in rows
    ]
    caption = (
        "All cycles with a due sink by when they were released. Lost: cycles that never finished. "
        f"{WITH_WARMUP}"
    )
    return Table("phases", "By phase", columns, shown, caption=caption)


def _moves(cycles: pl.DataFrame) -> list[tuple[float, str]]:
    """Return release (seconds) and placement of the first cycle after each change."""
    import polars as pl

    placed = cycles.select("release_ns", pl.col("placement").cast(pl.String))
    changed = placed.filter(pl.col("placement") != pl.col("placement").shift(1))
    return [(at_ns / 1e9, placement) for at_ns, placement in changed.rows()]


def _guarded(run: Run, moved_s: Sequence[tuple[float, str]]) -> list[float]:
    """Return the releases of the first cycles after the guard's moves, seconds."""
    first = dict(zip(run.windows["window"], run.windows["first_cycle"], strict=True))
    released_ns = dict(zip(run.cycles["cycle"], run.cycles["release_ns"], strict=True))
    found = []
    for move in moves(run):
        if not move.by_guard:
            continue
        # Without a next window there is no upper bound.
        until_ns = released_ns.get(first.get(move.window + 1, -1), math.inf)
        before_s = [at_s for at_s, name in moved_s if name == move.target]
        mine = [at_s for at_s in before_s if at_s * 1e9 <= until_ns + 1]
        found += mine[-1:]
    return found
