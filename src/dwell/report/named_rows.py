"""Figures of numbers by name, a line for each name: dots with intervals, and bars."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dwell.report.palette import INK, MUTED, PAPER, RULE, Style
from dwell.report.panels import (
    Place,
    Scale,
    entries,
    folded,
    keys,
    label_of,
    legend,
    legend_lines,
    mark_level,
    parted,
    spread,
)
from dwell.report.style import PageStyle, key
from dwell.report.svg import new_figure
from dwell.study.chapter import Figure

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

__all__ = ["draw_bars", "draw_intervals"]

MOST_PANELS = 5
# Series from which on every name has a panel of its own, whose lines are the series.
MANY_SERIES = 4
MOST_TURNED = 12
LINE_INCHES = 0.235
PART_INCHES = 0.14
# Share of a line that its series take.
TAKEN = 0.74
LONGEST_NAME = 36
# Column of where a bar begins.
BEGIN = " begin"
# Of what is a measure and no placement: whiskers are seen on it, in a light and in a dark page.
GREY = "#a3a3a4"


@dataclass(frozen=True, slots=True)
class Rows:
    """The lines of every panel, and the series on them.

    Parameters
    ----------
    names : list of str
        From top to bottom.
    series : list of str
        Side by side on a line.
    styles : mapping of str to Style
    single : bool
        Whether each line has one series, so that its name says which.
    stacked : bool
        Whether the series of a line stand one behind the other.
    """

    names: list[str]
    series: list[str]
    styles: Mapping[str, Style]
    single: bool
    stacked: bool = False

    @classmethod
    def of(cls, figure: Figure, look: PageStyle) -> Rows:
        """Find the lines of a figure."""
        names, series = keys(figure.frame, figure.x), keys(figure.frame, figure.series)
        pairs = figure.frame.select({figure.x, figure.series}).unique()
        single = pairs.height == len(names)
        return cls(names, series, look.styles(series), single)

    @property
    def inches(self) -> float:
        """Height of a panel."""
        parts = 1 if self.single or self.stacked else len(self.series)
        folds = max((math.ceil(len(name) / LONGEST_NAME) for name in self.names), default=1)
        line = max(LINE_INCHES, PART_INCHES * parts + 0.07, 0.145 * folds + 0.06)
        return max(len(self.names) * line, 0.5)

    def at(self, name: str, series: str) -> float:
        """Where a series stands on the line of a name, from 0 at the top."""
        row = self.names.index(name)
        if self.single or self.stacked:
            return float(row)
        share = (self.series.index(series) + 0.5) / len(self.series) - 0.5
        return row + share * TAKEN


def draw_intervals(figure: Figure, look: PageStyle) -> Canvas:
    """Draw a dot for every name and series, and its interval as a bar.

    Names with many series have a panel each, whose lines are the series.
    """
    figure = _turned(figure)
    rows = Rows.of(figure, look)

    def draw(ax: Axes, place: Place, scale: Scale) -> None:
        for row in place.frame.iter_rows(named=True):
            name, series = key(row[figure.x]), key(row[figure.series])
            style, at = rows.styles[series], rows.at(name, series)
            ends = (row.get(f"{figure.y}_low"), row.get(f"{figure.y}_high"))
            _dot(ax, scale, style, at, row[figure.y], ends)

    handles = [] if rows.single else [_mark(rows.styles[name]) for name in rows.series]
    return _draw_rows(figure, look, rows, draw, handles, bars=False)


def draw_bars(figure: Figure, look: PageStyle) -> Canvas:
    """Draw a bar for every name and series, its interval as a whisker.

    Series that are measures are told apart by their filling: the first is filled, the second an
    outline, the others are hatched. Candidates without intervals are parts of a whole, and stand
    one behind the other.
    """
    rows = Rows.of(figure, look)
    if not rows.single and _are_parts(figure, look, rows):
        rows = replace(rows, stacked=True)
        figure = replace(figure, frame=_stacked(figure))
    looks = {
        name: _filling(i, rows.styles[name], named=look.is_named(name))
        for i, name in enumerate(rows.series)
    }
    alone = rows.single or rows.stacked
    height = 0.62 if alone else 0.84 * TAKEN / len(rows.series)

    def draw(ax: Axes, place: Place, scale: Scale) -> None:
        ax.axvline(0, color=MUTED, lw=0.6, zorder=1)
        for row in place.frame.iter_rows(named=True):
            name, series = key(row[figure.x]), key(row[figure.series])
            at = rows.at(name, series)
            value, low, high, begin = (
                _placed(scale, row.get(column))
                for column in (figure.y, f"{figure.y}_low", f"{figure.y}_high", BEGIN)
            )
            if math.isnan(value):
                continue
            left = 0.0 if math.isnan(begin) else begin
            ax.barh(at, value - left, left=left, height=height, zorder=2, **looks[series])
            # As in tables: a share that is the same extreme in every run stands alone.
            extreme = look.is_named(series) and row[figure.y] in (0, 1)
            if not (math.isnan(low) or math.isnan(high) or extreme):
                ax.plot([low, high], [at, at], "-", color=INK, lw=0.9, zorder=3)

    from matplotlib.patches import Patch

    handles: list[Artist] = []
    if not rows.single or not any(map(look.is_named, rows.series)):
        handles = [Patch(**looks[name]) for name in rows.series]
    return _draw_rows(figure, look, rows, draw, handles, bars=True)


def _are_parts(figure: Figure, look: PageStyle, rows: Rows) -> bool:
    """Whether the bars of a line are shares of the candidates."""
    bare = f"{figure.y}_low" not in figure.frame.columns
    return bare and all(name in look.placements for name in rows.series)


def _stacked(figure: Figure) -> pl.DataFrame:
    """Put the bars of a line one behind the other: where each begins, and where it ends."""
    import polars as pl

    whole = [one for one in (figure.facet, figure.facet_row, figure.x) if one is not None]
    end = pl.col(figure.y).fill_nan(0.0).fill_null(0.0).cum_sum().over(whole)
    return figure.frame.with_columns((end - pl.col(figure.y)).alias(BEGIN), end.alias(figure.y))


def _draw_rows(
    figure: Figure,
    look: PageStyle,
    rows: Rows,
    draw: Callable[[Axes, Place, Scale], None],
    handles: Sequence[Artist],
    *,
    bars: bool,
) -> Canvas:
    """Draw panels that have the same lines."""
    grid = parted(figure, look, MOST_PANELS)
    columns = (figure.y, f"{figure.y}_low", f"{figure.y}_high")
    scales = spread(grid, columns, zero=bars, linear=bars)
    labels = entries(figure, look, rows.series) if handles else []
    lines = len(grid.rows)
    titles = 0.34 if any(place.title for place in grid.places) else 0.08
    labelled = lines if grid.own else 1
    height = lines * (rows.inches + titles) + 0.3 * labelled + 0.12 * lines
    height += 0.22 * legend_lines(labels)
    with new_figure(height) as canvas:

        def panel(ax: Axes, place: Place) -> None:
            scale = scales[id(place)]
            mark_level(ax, place.panel, scale, upright=False)
            draw(ax, place, scale)
            scale.apply(ax, upright=False, ticks=4 if grid.columns > 3 else 6)
            ax.tick_params(axis="y", length=0, labelcolor=INK)
            ax.spines["left"].set_visible(False)
            ax.grid(axis="y", visible=False)
            ax.set_yticks(
                range(len(rows.names)),
                [folded(look.shown(name), LONGEST_NAME) for name in rows.names],
            )
            ax.set_ylim(len(rows.names) - 0.45, -0.55)
            if not rows.single and not rows.stacked:
                for line in range(1, len(rows.names)):
                    ax.axhline(line - 0.5, color=RULE, lw=0.6, zorder=0)
            if place.own:
                ax.set_xlabel(label_of(place.panel, scale))

        grid.draw(canvas, panel, values="x")
        if not grid.own:
            label = label_of(grid.places[0].panel, scales[id(grid.places[0])])
            canvas.supxlabel(label, size=9, color=MUTED)
        legend(canvas, handles, labels)
    return canvas


def _turned(figure: Figure) -> Figure:
    """Give names with many series a panel each."""
    series = keys(figure.frame, figure.series)
    names = keys(figure.frame, figure.x)
    if (
        figure.facet is not None
        or figure.x == figure.series
        or not 1 < len(names) <= MOST_TURNED
        or len(series) < MANY_SERIES
    ):
        return figure
    return replace(figure, facet=figure.x, x=figure.series)


def _placed(scale: Scale, value: float | None) -> float:
    if value is None or math.isnan(value):
        return math.nan
    return float(scale.place(np.array([value]))[0])


def _dot(
    ax: Axes,
    scale: Scale,
    style: Style,
    at: float,
    value: float | None,
    ends: tuple[float | None, float | None],
) -> None:
    """Draw one number; an open mark where it lies beyond the axis, or is 0 on a logarithmic one."""
    x, low, high = (_placed(scale, one) for one in (value, *ends))
    if math.isnan(x) or value is None:
        return
    if not math.isnan(low) and not math.isnan(high) and low < high:
        ax.plot([low, high], [at, at], "-", color=style.colour, lw=2.2, alpha=0.45, zorder=2)
        for end, where, marker in ((low, ends[0], "<"), (high, ends[1], ">")):
            if where is not None and not scale.log and scale.hidden(np.array([where]))[0]:
                ax.plot([end], [at], marker, color=style.colour, ms=3.5, mew=0, clip_on=False)
    marker = style.marker
    if scale.hidden(np.array([value]))[0]:
        marker = style.marker if value * scale.factor < scale.high else ">"
        ax.plot([x], [at], marker, mfc=PAPER, mec=style.colour, mew=1.1, clip_on=False, zorder=3)
        return
    ax.plot([x], [at], marker, color=style.colour, mew=0, clip_on=False, zorder=3)


def _mark(style: Style) -> Artist:
    """Return a dot with its bar, for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=style.colour, marker=style.marker, mew=0, lw=1.3)


def _filling(place: int, style: Style, *, named: bool) -> dict[str, Any]:
    """Return how the bars of a series are filled."""
    if named:
        return {"facecolor": style.colour, "edgecolor": PAPER, "linewidth": 0.6}
    face, hatch = ((GREY, ""), ("none", ""), ("none", "//////"), ("none", "....."))[place % 4]
    return {"facecolor": face, "edgecolor": MUTED, "linewidth": 0.9, "hatch": hatch}
