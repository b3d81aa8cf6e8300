"""Timelines of a chapter: where a run was placed, what happened to it, and what that showed."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dwell.report.palette import INK, MUTED, RULE
from dwell.report.panels import (
    Floats,
    Place,
    Scale,
    floats,
    folded,
    keys,
    legend,
    legend_lines,
    mark_level,
    only,
    parted,
    scale_of,
)
from dwell.report.scales import is_wide
from dwell.report.style import PageStyle, key
from dwell.report.svg import new_figure
from dwell.report.units import labelled
from dwell.study.chapter import Figure

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

__all__ = ["Span", "draw_timeline"]

PANEL_INCHES = 1.15
STRIP_INCHES = 0.2
SPAN_INCHES = 0.15
# Series that are what a candidate costs when it runs alone, or are otherwise drawn thin and dashed.
DASHES = (0, (1.5, 1.5))
LONGEST_LABEL = 24


class Span(NamedTuple):
    """Something that happened for a while, in units of the horizontal axis; or at an instant."""

    begin: float
    end: float
    label: str

    @property
    def lasts(self) -> bool:
        """Whether it is more than an instant."""
        return self.end > self.begin


def draw_timeline(figure: Figure, look: PageStyle) -> Canvas:
    """Draw panels that share their time, below strips of what happened and of the placement."""
    places = parted(figure, look, 1).places
    x = floats(figure.frame, figure.x)
    first, last = float(np.nanmin(x)), float(np.nanmax(x))
    gaps = np.diff(np.unique(x[np.isfinite(x)]))
    step = float(np.median(gaps)) if len(gaps) else 1.0
    spans = tuple(_spans(figure))
    labels, handles = _legend(figure, look, places)
    strips = (["placement"] if "placement" in figure.frame.columns else []) + (
        ["spans"] if spans else []
    )
    # What happened at instants stands below what went on for a while.
    order = sorted(spans, key=lambda span: not span.lasts)
    names = list(dict.fromkeys(span.label for span in order))
    inches = [
        *(STRIP_INCHES if strip == "placement" else SPAN_INCHES * len(names) for strip in strips),
        *(PANEL_INCHES for _ in places),
    ]
    with new_figure(sum(inches) + 0.5 + 0.1 * len(inches) + 0.22 * legend_lines(labels)) as canvas:
        axes = canvas.subplots(len(inches), 1, sharex=True, squeeze=False, height_ratios=inches)[
            :, 0
        ]
        for ax, strip in zip(axes, strips, strict=False):
            if strip == "placement":
                _placements(ax, figure, look, step)
            else:
                _happened(ax, spans, names)
        for ax, place in zip(axes[len(strips) :], places, strict=True):
            _panel(ax, figure, look, place, spans)
        axes[-1].set_xlim(first - 0.5 * step, last + 0.5 * step)
        axes[-1].set_xlabel(figure.x_label or figure.x)
        canvas.align_ylabels(axes)
        legend(canvas, handles, labels)
    return canvas


def _placements(ax: Axes, figure: Figure, look: PageStyle, step: float) -> None:
    """Draw a band that has the colour of the placement."""
    shown = figure.frame.select(figure.x, "placement").unique(figure.x).sort(figure.x)
    at = floats(shown, figure.x)
    for begin, end, name in _stretches(at, shown["placement"].to_list(), step):
        if name in look.placements:
            ax.broken_barh([(begin, end - begin)], (0, 1), color=look.placements[name], lw=0)
    _as_strip(ax, "placed")


def _stretches(
    at: Floats, names: Sequence[object], step: float
) -> Iterable[tuple[float, float, str]]:
    """Yield begin, end and name of each stretch of equal names; they meet halfway."""
    edges = np.concatenate([[at[0] - step / 2], (at[1:] + at[:-1]) / 2, [at[-1] + step / 2]])
    change = [0, *(i for i in range(1, len(names)) if names[i] != names[i - 1]), len(names)]
    for i, j in itertools.pairwise(change):
        if names[i] is not None:
            yield float(edges[i]), float(edges[j]), key(names[i])


def _happened(ax: Axes, spans: Sequence[Span], names: Sequence[str]) -> None:
    """Draw a line for each thing that happened, and when it did."""
    for row, name in enumerate(names):
        named = [span for span in spans if span.label == name]
        lasting = [(span.begin, span.end - span.begin) for span in named if span.lasts]
        instants = [span.begin for span in named if not span.lasts]
        ax.broken_barh(lasting, (row - 0.32, 0.64), color=MUTED, lw=0)
        ax.plot(instants, [row] * len(instants), "|", color=INK, ms=7, mew=1.6)
        ax.axhline(row, color=RULE, lw=0.6, zorder=0)
    ax.set_ylim(len(names) - 0.4, -0.6)
    ax.set_yticks(range(len(names)), [folded(name, LONGEST_LABEL) for name in names])
    ax.tick_params(length=0, labelsize=8)
    ax.tick_params(axis="x", labelbottom=False)
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)


def _as_strip(ax: Axes, label: str) -> None:
    ax.set_ylim(0, 1)
    ax.set_yticks([0.5], [label])
    ax.tick_params(length=0)
    ax.tick_params(axis="x", labelbottom=False)
    ax.grid(visible=False)
    ax.spines[["left", "bottom"]].set_visible(False)


def _panel(ax: Axes, figure: Figure, look: PageStyle, place: Place, spans: Sequence[Span]) -> None:
    for span in (span for span in spans if span.lasts):
        ax.axvspan(span.begin, span.end, color=RULE, alpha=0.4, lw=0, zorder=0)
    scale = _scale(place, figure.y)
    mark_level(ax, place.panel, scale, upright=True)
    for name in keys(place.frame, figure.series):
        mine = only(place.frame, figure.series, name).sort(figure.x)
        at, values = floats(mine, figure.x), floats(mine, figure.y)
        placed = [None if one is None else key(one) for one in _column(mine, "placement")]
        if name in look.placements:
            colour = look.placements[name]
            ax.step(at, scale.place(values), where="mid", color=colour, lw=1.0, zorder=2)
            active = np.where([one == name for one in placed], values, math.nan)
            ax.plot(at, scale.place(active), "o", color=colour, ms=3, mew=0, zorder=3)
        elif _base(name, look) is not None:
            colour = look.placements[_base(name, look) or ""]
            ax.step(
                at, scale.place(values), where="mid", color=colour, lw=0.9, ls=DASHES, zorder=1.5
            )
        else:
            _marks(ax, at, scale.place(values), placed, look)
    scale.apply(ax, upright=True)
    label = labelled(place.panel.y_label or place.title, place.panel.y_unit)
    ax.set_ylabel(folded(label, 16))
    ax.grid(axis="x", visible=False)


def _marks(
    ax: Axes, at: Floats, values: Floats, placed: Sequence[str | None], look: PageStyle
) -> None:
    """Draw one mark a window, joined by a faint line."""
    ax.plot(at, values, "-", color=RULE, lw=0.8, zorder=1)
    for name in dict.fromkeys(placed):
        mine = np.array([one == name for one in placed])
        colour = look.placements.get(name or "", INK)
        ax.plot(at[mine], values[mine], "o", color=colour, ms=3, mew=0, zorder=2)


def _scale(place: Place, column: str) -> Scale:
    """Choose a logarithmic axis also where nobody asked for one and a linear one would squeeze."""
    values = floats(place.frame, column)
    shown = values[np.isfinite(values)]
    wide = place.panel.y_unit not in ("percent", "change") and is_wide(shown)
    panel = place.panel
    if wide and not panel.log_y:
        place = place._replace(panel=replace(panel, log_y=True))
    return scale_of([place], [column], linear=True)


def _base(name: str, look: PageStyle) -> str | None:
    """Return the candidate that a series is about: ``LOC`` of ``LOC alone``."""
    first = name.split(" ", 1)[0]
    return first if first != name and first in look.placements else None


def _column(frame: pl.DataFrame, name: str) -> Sequence[object]:
    return frame[name].to_list() if name in frame.columns else [None] * frame.height


def _spans(figure: Figure) -> Iterable[Span]:
    """Yield what happened, in the order in which each began first."""
    if figure.spans is None:
        return
    for row in figure.spans.sort("begin", maintain_order=True).iter_rows(named=True):
        yield Span(float(row["begin"]), float(row["end"]), str(row["label"]))


def _legend(
    figure: Figure, look: PageStyle, places: Sequence[Place]
) -> tuple[list[str], list[Artist]]:
    """Say what colours, marks and lines are."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    series = keys(figure.frame, figure.series)
    placed = keys(figure.frame, "placement") if "placement" in figure.frame.columns else []
    seen = {*placed, *series}
    labels = [name for name in look.placements if name in seen]
    handles: list[Artist] = [Patch(color=look.placements[name], lw=0) for name in labels]
    if placed:
        labels.append("active")
        handles.append(Line2D([], [], ls="", marker="o", ms=4, mew=0, color=MUTED))
    if any(name in look.placements for name in series):
        labels.append("estimated")
        handles.append(Line2D([], [], color=MUTED, lw=1.1))
    others = {name.split(" ", 1)[1] for name in series if _base(name, look) is not None}
    for other in sorted(others):
        labels.append(other)
        handles.append(Line2D([], [], color=MUTED, lw=0.9, ls=DASHES))
    levels = [place.panel.line_label for place in places if place.panel.line_at is not None]
    if levels:
        labels.append(", ".join(dict.fromkeys(filter(None, levels))) or "level")
        handles.append(Line2D([], [], color=INK, lw=0.9, ls=(0, (4, 2))))
    return labels, handles
