"""A run through time: where it was placed, what that showed, and what the policy believed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.study import AIM
from dwell.study.paper.chapter import Figure, Panel

if TYPE_CHECKING:
    import polars as pl
    from numpy.typing import NDArray

__all__ = ["run_timeline"]


def run_timeline(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    *,
    candidates: Sequence[str],
    period_ms: float,
    deadline_ms: float,
    slug: str,
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
    """
    import polars as pl

    begin_s = windows["first_cycle"].to_numpy() * (period_ms / 1e3)
    length_s = float(np.median(np.diff(begin_s))) if len(begin_s) > 1 else 1.0
    lines = [
        ("V_D", "V_D", _floats(windows["violation_rate"])),
        ("L95", "L95", _floats(windows["seen_l95_ms"])),
        *(("J", name, _cost(windows, decisions, name)) for name in candidates),
    ]
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
    warm = begin_s[: int(windows["warmup"].sum())]
    spans = pl.DataFrame(
        {"begin": [0.0], "end": [float(warm[-1]) + length_s], "label": ["warm-up"]}
        if len(warm)
        else {"begin": [], "end": [], "label": []}
    )
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
        panels={
            "V_D": Panel("V_D", "percent", AIM, "5 %"),
            "L95": Panel("L95", "ms", deadline_ms, "deadline"),
            "J": Panel("J", "cost"),
        },
        spans=spans,
    )


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
