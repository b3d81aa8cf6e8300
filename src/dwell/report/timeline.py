"""A run through time: where it was placed, what that showed, and what the policy believed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.report.palette import INK, MUTED, RULE
from dwell.report.scales import is_wide, set_log_ticks
from dwell.report.svg import inline, new_figure
from dwell.study import AIM

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["timeline"]

Floats: TypeAlias = NDArray[np.float64]


def timeline(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    *,
    placements: Mapping[str, str],
    period_ms: float,
    deadline_ms: float,
    name: str,
) -> str:
    """Draw placement, violation rate, L95 and J of a run, window by window.

    Marks have the colour of the placement that was active. J of the others, as the policy
    estimated it, is a thin line in the colour of each.

    Parameters
    ----------
    windows, decisions : DataFrame
        Of the run.
    placements : mapping of str to str
        Colour of every candidate.
    period_ms, deadline_ms : float
    name : str
        Of the figure, unique in its page.
    """
    begin_s = windows["first_cycle"].to_numpy() * (period_ms / 1e3)
    names = windows["placement"].cast(str).to_list()
    length_s = float(np.median(np.diff(begin_s))) if len(begin_s) > 1 else 1.0
    end_s = np.append(begin_s[1:], begin_s[-1] + length_s)
    middle_s = (begin_s + end_s) / 2
    warmup_s = float(end_s[int(windows["warmup"].sum()) - 1]) if windows["warmup"].any() else 0.0
    colours = [placements[name] for name in names]
    with new_figure(4.5) as figure:
        ratios = [0.28, 1.0, 1.0, 1.35]
        axes = figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": ratios})
        strip, rates, tails, costs = axes
        _strip(strip, begin_s, end_s, names, placements)
        for ax, column, factor, title, line in (
            (rates, "violation_rate", 100.0, "missed (%)", AIM * 100),
            (tails, "seen_l95_ms", 1.0, "L95 (ms)", deadline_ms),
        ):
            values = windows[column].cast(float).fill_null(math.nan).to_numpy() * factor
            _marks(ax, middle_s, values, colours)
            ax.axhline(line, color=INK, lw=0.9, ls=(0, (4, 2)))
            ax.set_ylabel(title)
        _widen(rates, [AIM * 200], bottom=0.0)
        _widen(tails, [deadline_ms], bottom=None)
        _costs(costs, windows, decisions, middle_s, placements, colours)
        for ax in axes[1:]:
            ax.grid(axis="x", visible=False)
        for ax in axes:
            ax.axvspan(0, warmup_s, color=RULE, alpha=0.45, lw=0, zorder=0)
        costs.set_xlim(0, float(end_s[-1]))
        costs.set_xlabel("time (s); shaded: warm-up")
        figure.align_ylabels(axes)
        _legend(figure, placements)
        return inline(figure, name, "Placement, violation rate, L95 and cost over time")


def _strip(
    ax: Axes,
    begin_s: Floats,
    end_s: Floats,
    names: Sequence[str],
    placements: Mapping[str, str],
) -> None:
    """Draw a band that has the colour of the placement."""
    change = [0, *(i for i in range(1, len(names)) if names[i] != names[i - 1]), len(names)]
    stretches = [
        (float(begin_s[i]), float(end_s[j - 1]), names[i]) for i, j in itertools.pairwise(change)
    ]
    for placement, colour in placements.items():
        mine = [(begin, end - begin) for begin, end, name in stretches if name == placement]
        ax.broken_barh(mine, (0, 1), color=colour, lw=0)
    ax.set_ylim(0, 1)
    ax.set_yticks([])
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(length=0)
    ax.set_ylabel("placed", rotation=0, ha="right", va="center")


def _marks(ax: Axes, x: Floats, values: Floats, colours: Sequence[str]) -> None:
    """Draw one mark a window, joined by a faint line."""
    ax.plot(x, values, "-", color=RULE, lw=0.8, zorder=1)
    for colour in dict.fromkeys(colours):
        mine = np.array([c == colour for c in colours])
        ax.plot(x[mine], values[mine], "o", color=colour, ms=3, mew=0, zorder=2)


def _costs(
    ax: Axes,
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    middle_s: Floats,
    placements: Mapping[str, str],
    colours: Sequence[str],
) -> None:
    """Draw measured J as marks, and estimated J of what was not active as lines."""
    measured = windows["cost"].cast(float).fill_null(math.nan).to_numpy()
    _marks(ax, middle_s, measured, colours)
    at = decisions["window"].to_numpy() - int(windows["window"][0])
    known = (at >= 0) & (at < len(middle_s))
    incumbent = decisions["incumbent"].cast(str).to_numpy()
    for name, colour in placements.items():
        estimated = decisions[f"j_{name}"].cast(float).fill_null(math.nan).to_numpy().copy()
        estimated[incumbent == name] = math.nan
        series = np.full(len(middle_s), math.nan)
        series[at[known]] = estimated[known]
        ax.step(middle_s, series, where="mid", color=colour, lw=1.1, zorder=3)
    ax.set_ylabel("cost J")
    _widen(ax, [], bottom=None)


def _widen(ax: Axes, include: Sequence[float], bottom: float | None) -> None:
    """Choose a linear or logarithmic axis that holds the data and what is to be included."""
    data = [line.get_ydata(orig=True) for line in ax.get_lines() if np.size(line.get_xdata()) > 2]
    values = np.concatenate([np.asarray(part, float) for part in data] or [np.zeros(0)])
    values = np.concatenate([values[np.isfinite(values)], np.asarray(include, float)])
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    if bottom is None and is_wide((low, high)):
        ax.set_yscale("log")
        ax.set_ylim(low / 1.25, high * 1.25)
        set_log_ticks(ax.yaxis, low / 1.25, high * 1.25)
        return
    margin = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    ax.set_ylim(low - margin if bottom is None else bottom - 0.3 * margin, high + margin)


def _legend(figure: Figure, placements: Mapping[str, str]) -> None:
    """Say what colours, marks and lines are."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Patch | Line2D] = [
        Patch(color=colour, label=name) for name, colour in placements.items()
    ]
    handles += [
        Line2D([], [], ls="", marker="o", ms=4, mew=0, color=MUTED, label="measured, active"),
        Line2D([], [], color=MUTED, lw=1.1, label="estimated, not active"),
        Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 2)), label="5 % aim, deadline"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles))
