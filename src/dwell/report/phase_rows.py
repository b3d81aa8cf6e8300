"""What every phase of a run showed: misses, latency, placements, moves and tracking error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dwell.report.phases import phases
from dwell.study.summary import latency_ms, order_statistic

if TYPE_CHECKING:
    from dwell.record import Run
    from dwell.report.facts import Facts

__all__ = ["PhaseRow", "phase_rows"]

#: Runs with more are not told phase by phase.
MOST = 16


class PhaseRow(NamedTuple):
    """One phase.

    Parameters
    ----------
    name : str
    begin_s, end_s : float
    cycles : int
        Released in it.
    violation_rate, l95_ms : float
        Of their final latencies; infinite L95 where more than 5 % never finished.
    lost : int
        Cycles that never finished.
    shares : mapping of str to float
        Of the cycles, by placement; the largest first.
    migrations, guard_moves : int
        By when the first cycle on the new placement was released.
    rms_mm, rms_px : float
        Tracking error; NaN where it is not known.
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


def phase_rows(run: Run, facts: Facts) -> list[PhaseRow]:
    """Return the phases of a run that have cycles; none where there are too many of them."""
    import polars as pl

    cycles = run.cycles
    if cycles.is_empty():
        return []
    released_s = cycles["release_ns"].to_numpy() / 1e9
    found = phases(facts.disturbed, float(released_s[-1]) + facts.period_ms / 1e3)
    if len(found) > MOST:
        return []
    placed = cycles["placement"].cast(pl.String)
    moved_s = released_s[1:][(placed[1:] != placed[:-1]).to_numpy()]
    guard_s = _guarded(run, dict(zip(cycles["cycle"], released_s.tolist(), strict=True)))
    rows = []
    for phase in found:
        inside = (phase.begin_s <= released_s) & (released_s < phase.end_s)
        mine = cycles.filter(pl.Series(inside))
        if mine.is_empty():
            continue
        moves = int(np.sum((phase.begin_s <= moved_s) & (moved_s < phase.end_s)))
        guards = sum(phase.begin_s <= at_s < phase.end_s for at_s in guard_s)
        counts = mine["placement"].cast(pl.String).value_counts(sort=True)
        rms_mm, rms_px = (math.nan, math.nan)
        if facts.tracking is not None:
            rms_mm, rms_px = facts.tracking.rms(phase.begin_s, phase.end_s)
        rows.append(
            PhaseRow(
                phase.name,
                phase.begin_s,
                phase.end_s,
                mine.height,
                float(mine["missed"].to_numpy().mean()),
                float(order_statistic(latency_ms(mine), 95)),
                int(mine["latency_ns"].is_null().sum()),
                {name: count / mine.height for name, count in counts.rows()},
                max(moves - guards, 0),
                guards,
                rms_mm,
                rms_px,
            )
        )
    return rows


def _guarded(run: Run, released_s: Mapping[int, float]) -> list[float]:
    """When the guard moved the cell: noted under the window that follows."""
    import polars as pl

    decisions = run.decisions
    moves = decisions.filter(
        decisions["migrated"] & (decisions["reason"].cast(pl.String) == "guard")
    )
    first = dict(zip(run.windows["window"], run.windows["first_cycle"], strict=True))
    last_s = max(released_s.values())
    return [released_s.get(first.get(window, -1), last_s) for window in moves["window"].to_list()]
