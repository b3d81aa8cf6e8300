"""A run through time: where it was placed, what that showed, and what the policy believed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.study import AIM
from dwell.study.chapter import Figure, Panel

if TYPE_CHECKING:
    import polars as pl
    from numpy.typing import NDArray

    from dwell.report.phases import Disturbed
    from dwell.report.tracking import Tracking

__all__ = ["GUARD", "MIGRATIONS", "run_timeline"]

MIGRATIONS = "migrations"
GUARD = "moves of the guard"


def run_timeline(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    *,
    candidates: Sequence[str],
    period_ms: float,
    deadline_ms: float,
    slug: str,
    begin_s: NDArray[np.float64] | None = None,
    disturbed: Iterable[Disturbed] = (),
    tracking: Tracking | None = None,
) -> Figure:
    """Return placement, violation rate, L95 and J of a run, window by window.

    J of the placement that is active is the measured one; of the others, what the policy estimated
    at the window's close.

    Parameters
    ----------
    windows, decisions : DataFrame
        Of the run.
    candidates : sequence of str
    period_ms, deadline_ms : float
    slug : str
        Of the figure.
    begin_s : float64 array, shape (windows,), optional
        When each window began; by its first cycle's number where left out.
    disturbed : iterable of Disturbed
        What happened meanwhile. What went on beyond the run is cut.
    tracking : Tracking, optional
    """
    import polars as pl

    if begin_s is None:
        begin_s = windows["first_cycle"].to_numpy() * (period_ms / 1e3)
    length_s = float(np.median(np.diff(begin_s))) if len(begin_s) > 1 else 1.0
    lines = [
        ("V_D", "V_D", _floats(windows["violation_rate"])),
        ("L95", "L95", _floats(windows["seen_l95_ms"])),
        *(("J", name, _cost(windows, decisions, name)) for name in candidates),
    ]
    panels = {
        "V_D": Panel("V_D", "percent", AIM, "5 %"),
        "L95": Panel("L95", "ms", deadline_ms, "deadline"),
        "J": Panel("J", "cost"),
    }
    if tracking is not None:
        errors = [tracking.rms(begin, begin + length_s)[0] for begin in begin_s.tolist()]
        lines.append(("error", "error", np.array(errors)))
        panels["error"] = Panel("tracking error (mm)", "number")
    frame = pl.concat(
        pl.DataFrame(
            {
                "time": begin_s + length_s / 2,
                "panel": [panel] * len(values),
                "series": [series] * len(values),
                "y": values,
                "placement": windows["placement"].cast(pl.String),
            }
        )
        for panel, series, values in lines
    )
    end_s = float(begin_s[-1]) + length_s
    spans = [
        *_warmup(windows, begin_s, length_s),
        *((one.begin_s, min(one.end_s, end_s), one.kind) for one in disturbed),
        *_unproven(windows, begin_s, length_s),
        *_moves(windows, decisions, begin_s, length_s),
    ]
    return Figure(
        slug=slug,
        title="Placement, violation rate, L95 and cost over time",
        kind="timeline",
        frame=frame,
        x="time",
        y="y",
        series="series",
        facet="panel",
        x_label="time (s)",
        panels=panels,
        spans=pl.DataFrame(
            [span for span in spans if span[0] < end_s],
            schema={"begin": pl.Float64, "end": pl.Float64, "label": pl.String},
            orient="row",
        ),
    )


def _warmup(
    windows: pl.DataFrame, begin_s: NDArray[np.float64], length_s: float
) -> Iterable[tuple[float, float, str]]:
    count = int(windows["warmup"].sum())
    if count:
        yield 0.0, float(begin_s[count - 1]) + length_s, "warm-up"


def _unproven(
    windows: pl.DataFrame, begin_s: NDArray[np.float64], length_s: float
) -> Iterable[tuple[float, float, str]]:
    """Yield the windows whose latencies the clocks do not prove."""
    if "unproven" not in windows.columns:
        return
    for begin, unproven in zip(begin_s.tolist(), windows["unproven"], strict=True):
        if unproven:
            yield begin, begin + length_s, "clocks unproven"


def _moves(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    begin_s: NDArray[np.float64],
    length_s: float,
) -> Iterable[tuple[float, float, str]]:
    """Yield every move as a span without length.

    A migration comes at its window's close. A move of the guard is noted under the window that
    follows it, and comes before that window begins.
    """
    begin_of = dict(zip(windows["window"], begin_s.tolist(), strict=True))
    last_s = float(begin_s[-1]) + length_s
    moves = decisions.filter(decisions["migrated"])
    for window, reason in zip(moves["window"], moves["reason"].cast(str), strict=True):
        if reason == "guard":
            at_s, label = begin_of.get(window, last_s), GUARD
        else:
            at_s, label = begin_of.get(window, last_s - length_s) + length_s, MIGRATIONS
        yield at_s, at_s, label


def _cost(windows: pl.DataFrame, decisions: pl.DataFrame, name: str) -> NDArray[np.float64]:
    """J of a candidate: measured while it is active, estimated while it is not."""
    measured = _floats(windows["cost"])
    active = windows["placement"].cast(str).to_numpy() == name
    at = decisions["window"].to_numpy() - int(windows["window"][0])
    known = (at >= 0) & (at < len(measured))
    estimated = np.full(len(measured), math.nan)
    estimated[at[known]] = _floats(decisions[f"j_{name}"])[known]
    return np.where(active, measured, estimated)


def _floats(values: pl.Series) -> NDArray[np.float64]:
    found: NDArray[np.float64] = values.cast(float).fill_null(math.nan).to_numpy()
    return found
