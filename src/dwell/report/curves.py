"""Figures of numbers over numbers: lines with bands, and distributions of latency."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from dwell.report.palette import MUTED, PAPER, Style
from dwell.report.panels import (
    Floats,
    Place,
    Scale,
    entries,
    floats,
    folded,
    keys,
    label_of,
    legend,
    legend_lines,
    mark_level,
    only,
    parted,
    scale_of,
    spread,
)
from dwell.report.scales import set_log_ticks
from dwell.report.style import PageStyle
from dwell.report.svg import new_figure
from dwell.report.units import labelled
from dwell.study import AIM
from dwell.study.chapter import Figure

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

__all__ = ["draw_distributions", "draw_lines"]

MOST_PANELS = 4
PANEL_INCHES = 2.05
ALONE_INCHES = 2.9
# Points of a line up to which each has a mark, and which are kept of a longer one.
MARKED = 16
KEPT = 800
# Values across, up to which each has its number.
FEW = 4
# Panels have an axis each where the largest of one is so many times that of another.
APART = 4
# Of cycles that took longer, in percent.
LATER = (0.1, 120.0)
# An axis of latencies ends after so many deadlines.
DEADLINES = 3


def draw_lines(figure: Figure, look: PageStyle) -> Canvas:
    """Draw a line for every series, with a band where it has an interval."""
    grid = parted(figure, look, MOST_PANELS)
    names = keys(figure.frame, figure.series)
    styles = look.styles(names)
    columns = (figure.y, f"{figure.y}_low", f"{figure.y}_high")
    scales = spread(grid, columns)
    highs = [scale_of([place], columns).high for place in grid.places]
    if not grid.own and not grid.sides and max(highs) > APART * max(min(highs), 0):
        # On one axis the smaller would lie flat.
        grid = replace(grid, apart=True)
        scales = {id(place): scale_of([place], columns, linear=True) for place in grid.places}
    across = floats(figure.frame, figure.x)
    labels = entries(figure, look, names) if len(names) > 1 else []
    lines = [one for one in (figure.facet, figure.facet_row, figure.series) if one is not None]
    marked = max(figure.frame.group_by(lines).len()["len"]) <= MARKED
    with new_figure(_height(len(grid.rows), grid.columns, labels, own=grid.own)) as canvas:

        def draw(ax: Axes, place: Place) -> None:
            scale = scales[id(place)]
            mark_level(ax, place.panel, scale, upright=True)
            for name in names:
                mine = only(place.frame, figure.series, name).sort(figure.x)
                _line(
                    ax,
                    styles[name],
                    scale,
                    *(floats(mine, one) for one in (figure.x, *columns)),
                    marked=marked,
                )
            scale.apply(ax, upright=True)
            _across(ax, across, log=figure.log_x)
            if place.own:
                ax.set_ylabel(label_of(place.panel, scale))

        grid.draw(canvas, draw, values="y")
        canvas.supxlabel(
            _logarithmic(figure.x_label or figure.x, log=figure.log_x), size=9, color=MUTED
        )
        if not grid.own:
            label = label_of(grid.places[0].panel, scales[id(grid.places[0])])
            label += "; each on its own scale" if grid.apart else ""
            # One line of a panel's height, or of two where there are more.
            label = folded(label, 24 if len(grid.rows) == 1 else 48)
            canvas.supylabel(label, size=9, color=MUTED)
        legend(canvas, _handles(styles, marked=marked) if labels else [], labels)
    return canvas


def _line(
    ax: Axes,
    style: Style,
    scale: Scale,
    x: Floats,
    y: Floats,
    low: Floats,
    high: Floats,
    *,
    marked: bool,
) -> None:
    keep = np.isfinite(x) & ~np.isnan(y)
    x, y, low, high = (part[keep] for part in (x, y, low, high))
    if len(x) > KEPT:
        some = np.unique(np.rint(np.linspace(0, len(x) - 1, KEPT)).astype(int))
        x, y, low, high = (part[some] for part in (x, y, low, high))
    if not np.isnan(low).all():
        ax.fill_between(
            x, scale.place(low), scale.place(high), color=style.colour, alpha=0.13, lw=0, zorder=1.5
        )
    # A single point has no line.
    marker = style.marker if marked or len(x) == 1 else ""
    hidden = scale.hidden(y)
    ax.plot(
        x,
        scale.place(y),
        color=style.colour,
        ls=style.dashes,
        lw=style.width,
        marker=marker,
        mew=0,
        ms=4.5,
        zorder=2,
    )
    if hidden.any():
        ax.plot(
            x[hidden],
            scale.place(y)[hidden],
            ls="",
            marker=marker or "o",
            mfc=PAPER,
            mec=style.colour,
            ms=4.5,
            zorder=2.5,
            clip_on=False,
        )


def draw_distributions(figure: Figure, look: PageStyle) -> Canvas:
    """Draw the share of cycles that took longer than a latency, on a logarithmic scale.

    One less the distribution: what is left at the deadline is what counts, and a tail of one in a
    thousand is as far from one in a hundred as that is from one in ten.
    """
    grid = parted(figure, look, MOST_PANELS)
    names = keys(figure.frame, figure.series)
    styles = look.styles(names)
    across = floats(figure.frame, figure.x)
    deadline = figure.line_at
    end = float(np.max(across[np.isfinite(across)], initial=1.0))
    if deadline is not None:
        end = min(end, DEADLINES * deadline)
    across = across[across <= end]
    labels = entries(figure, look, names)
    with new_figure(_height(len(grid.rows), grid.columns, labels, own=False)) as canvas:

        def draw(ax: Axes, place: Place) -> None:
            for name in names:
                mine = only(place.frame, figure.series, name).sort(figure.x)
                later = 100 * (1 - floats(mine, figure.y))
                # Zero has no place on a logarithmic axis.
                later[later < LATER[0] / 10] = math.nan
                style = styles[name]
                ax.plot(
                    floats(mine, figure.x),
                    later,
                    color=style.colour,
                    ls=style.dashes,
                    lw=style.width,
                )
            if deadline is not None:
                ax.axvline(deadline, color=MUTED, lw=0.9, ls=(0, (4, 2)), zorder=1)
            ax.axhline(100 * AIM, color=MUTED, lw=0.8, ls=(0, (1, 2)), zorder=1)
            ax.set_yscale("log")
            ax.set_ylim(*LATER)
            set_log_ticks(ax.yaxis, *LATER)
            _across(ax, across, log=figure.log_x)

        grid.draw(canvas, draw, values="none")
        marks = [] if deadline is None else [f"dashed: {figure.line_label or 'deadline'}"]
        label = _logarithmic(labelled(figure.x_label or "latency", "ms"), log=figure.log_x)
        canvas.supxlabel("; ".join([label, *marks]), size=9, color=MUTED)
        canvas.supylabel("cycles that took longer (%)\ndotted: 5 %", size=9, color=MUTED)
        legend(canvas, _handles(styles, marked=False), labels)
    return canvas


def _height(rows: int, columns: int, labels: Sequence[str], *, own: bool) -> float:
    panel = ALONE_INCHES if columns == 1 and rows == 1 else PANEL_INCHES
    return rows * panel + 0.35 + 0.22 * legend_lines(labels) + (0.1 if own else 0.0)


def _across(ax: Axes, values: Floats, *, log: bool) -> None:
    """Give the horizontal axis its ends and numbers."""
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    if not len(values):
        return
    low, high = float(values.min()), float(values.max())
    if log and low < high:
        margin = (high / low) ** 0.03
        ax.set_xscale("log")
        ax.set_xlim(low / margin, high * margin)
        few = np.unique(values)
        set_log_ticks(ax.xaxis, low / margin, high * margin, few if len(few) <= FEW else None)
        return
    margin = 0.03 * (high - low) or 0.1 * abs(high) or 1.0
    ax.set_xlim(0 if 0 <= low <= 0.05 * high else low - margin, high + margin)


def _logarithmic(label: str, *, log: bool) -> str:
    return f"{label}, logarithmic" if log else label


def _handles(styles: Mapping[str, Style], *, marked: bool) -> list[Artist]:
    from matplotlib.lines import Line2D

    return [
        Line2D(
            [],
            [],
            color=style.colour,
            ls=style.dashes,
            lw=style.width,
            mew=0,
            ms=4.5,
            marker=style.marker if marked else "",
        )
        for style in styles.values()
    ]
