"""Panels: how a figure is parted, its axes of values, the levels marked on them, its legend."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.report.palette import INK
from dwell.report.scales import set_log_ticks
from dwell.report.style import PageStyle, key
from dwell.report.svg import WIDTH
from dwell.report.units import factor, labelled
from dwell.study.chapter import Figure, Panel

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Canvas

__all__ = [
    "Grid",
    "Place",
    "Scale",
    "entries",
    "floats",
    "folded",
    "keys",
    "label_of",
    "legend",
    "legend_lines",
    "mark_level",
    "only",
    "parted",
    "scale_of",
    "spread",
]

Floats: TypeAlias = NDArray[np.float64]
Share: TypeAlias = Literal["none", "all", "row", "col"]

LEVEL = (0, (4, 2))
# A letter of 9 points is so wide in inches, in the mean, and a handle of the legend.
LETTER = 0.082
HANDLE = 0.52
# Beyond the largest value an axis follows intervals by so much of what the values span.
BEYOND = 0.6
# An axis begins at 0 where the least value is below so much of the largest.
NEAR_ZERO = 0.25
# An axis is logarithmic where the largest is so many times the middle one; and it is no deeper.
SQUEEZED = 8.0
DEEPEST = 3000.0


def keys(frame: pl.DataFrame, column: str) -> list[str]:
    """Return what a column holds, each once: numbers ascending, names as they come."""
    values = frame[column].drop_nulls().unique(maintain_order=True)
    return [key(value) for value in (values.sort() if values.dtype.is_numeric() else values)]


def only(frame: pl.DataFrame, column: str | None, name: str) -> pl.DataFrame:
    """Return the rows that hold a value in a column; all where there is no such column."""
    if column is None:
        return frame
    return frame.filter([value is not None and key(value) == name for value in frame[column]])


def floats(frame: pl.DataFrame, column: str) -> Floats:
    """Return a column as numbers; NaN where there are none, or no such column."""
    if column not in frame.columns:
        return np.full(frame.height, math.nan)
    values: Floats = frame[column].cast(float, strict=False).fill_null(math.nan).to_numpy()
    return values


class Place(NamedTuple):
    """One panel of a figure.

    Parameters
    ----------
    title : str
        Over it; empty where the figure is not parted.
    frame : DataFrame
        What it shows.
    panel : Panel
        How it shows that.
    own : bool
        Whether it has a measure of its own.
    """

    title: str
    frame: pl.DataFrame
    panel: Panel
    own: bool


@dataclass(frozen=True, slots=True)
class Grid:
    """The panels of a figure, row by row; None where a row has no more.

    Parameters
    ----------
    rows : list of list of Place or None
    sides : list of str
        What a row is called, at its right; empty where the figure is not parted twice.
    turned : bool
        Whether the rows are the facets.
    apart : bool
        Whether each panel has an axis of its own for the same measure.
    """

    rows: list[list[Place | None]]
    sides: list[str]
    turned: bool = False
    apart: bool = False

    @property
    def places(self) -> list[Place]:
        """All panels."""
        return [place for row in self.rows for place in row if place is not None]

    @property
    def columns(self) -> int:
        """How many panels stand side by side."""
        return len(self.rows[0])

    @property
    def own(self) -> bool:
        """Whether any panel has a measure of its own."""
        return any(place.own for place in self.places)

    def draw(
        self,
        canvas: Canvas,
        draw: Callable[[Axes, Place], None],
        *,
        values: Literal["x", "y", "none"],
    ) -> None:
        """Draw every panel.

        Parameters
        ----------
        canvas : matplotlib figure
        draw : callable
            Draws one.
        values : {"x", "y", "none"}
            The axis that belongs to a panel alone where it has a measure of its own.
        """
        share: dict[str, Share] = {"x": "all", "y": "all"}
        if (self.own or self.apart) and values != "none":
            share[values] = "none" if not self.sides else "row" if self.turned else "col"
        axes = canvas.subplots(
            len(self.rows), self.columns, squeeze=False, sharex=share["x"], sharey=share["y"]
        )
        for row, line in enumerate(self.rows):
            for column, place in enumerate(line):
                ax = axes[row, column]
                if place is None:
                    ax.set_axis_off()
                    continue
                draw(ax, place)
                if place.title and not (self.sides and row):
                    ax.set_title(folded(place.title, self.letters))
                # Where the last row is shorter, the axis above the gap needs its numbers.
                below = row + 1 < len(self.rows) and self.rows[row + 1][column] is not None
                repeated = below and share["x"] in ("all", "col")
                ax.tick_params(labelbottom=not repeated)
                if repeated:
                    ax.set_xlabel("")
                if column and share["y"] in ("all", "row"):
                    ax.set_ylabel("")
            if self.sides:
                self._side(axes[row, -1], self.sides[row])

    @property
    def letters(self) -> int:
        """How many letters a title has room for."""
        return max(8, int((WIDTH - 1.6) / self.columns / LETTER))

    def _side(self, ax: Axes, text: str) -> None:
        shown = folded(text, 18)
        ax.annotate(
            shown,
            (1, 0.5),
            (7, 0),
            xycoords="axes fraction",
            textcoords="offset points",
            rotation=270,
            ha="left",
            va="center",
            weight="bold",
        )


def entries(figure: Figure, look: PageStyle, names: Sequence[str]) -> list[str]:
    """Return what series are called in a legend; a bare number says what it is of."""
    numbers = figure.frame[figure.series].dtype.is_numeric()
    what = f"{figure.series.replace('_', ' ')} " if numbers else ""
    return [f"{what}{look.shown(name)}" for name in names]


def parted(figure: Figure, look: PageStyle, most: int) -> Grid:
    """Part a figure into its panels.

    Parameters
    ----------
    figure : Figure
    look : PageStyle
    most : int
        Panels side by side.
    """
    shared = Panel(figure.y_label, figure.y_unit, figure.line_at, figure.line_label, figure.log_y)

    def place(facet: str | None, frame: pl.DataFrame) -> Place:
        if facet is None:
            return Place("", frame, shared, own=False)
        own = figure.panels.get(facet)
        return Place(look.titled(facet), frame, own or shared, own=own is not None)

    if figure.facet is None:
        return Grid([[place(None, figure.frame)]], [])
    facets = keys(figure.frame, figure.facet)
    if figure.facet_row is None:
        columns = _columns(len(facets), most)
        found: list[Place | None] = [
            place(name, only(figure.frame, figure.facet, name)) for name in facets
        ]
        found += [None] * (-len(found) % columns)
        return Grid([found[i : i + columns] for i in range(0, len(found), columns)], [])
    sides = keys(figure.frame, figure.facet_row)
    rows: list[list[Place | None]] = []
    for side in sides:
        mine = only(figure.frame, figure.facet_row, side)
        rows.append([place(name, only(mine, figure.facet, name)) for name in facets])
    if len(facets) > most >= len(sides):
        turned = [[row[i] for row in rows] for i in range(len(facets))]
        named = [
            [_titled(one, look.titled(side)) for one, side in zip(row, sides, strict=True)]
            for row in turned
        ]
        return Grid(named, [look.titled(name) for name in facets], turned=True)
    return Grid(rows, [look.titled(name) for name in sides])


def _titled(place: Place | None, title: str) -> Place | None:
    return None if place is None else place._replace(title=title)


def _columns(count: int, most: int) -> int:
    """Return how many panels stand side by side: as many in each row, if that is possible."""
    rows = math.ceil(count / most)
    return math.ceil(count / rows) if rows else 1


# -------------------------------------------------------------------------------------- scales


@dataclass(frozen=True, slots=True)
class Scale:
    """An axis of values.

    Parameters
    ----------
    low, high : float
        Its ends, in the numbers that are shown.
    floor : float
        Where what cannot be shown on a logarithmic axis stands; NaN on a linear one.
    factor : float
        From the column's numbers to those that are shown.
    open : bool
        Whether anything is less than a logarithmic axis shows.
    """

    low: float
    high: float
    floor: float
    factor: float
    open: bool = False

    @property
    def log(self) -> bool:
        """Whether it is logarithmic."""
        return not math.isnan(self.floor)

    def place(self, values: Floats) -> Floats:
        """Return where numbers of the column stand; at the ends, what lies beyond them."""
        shown = values * self.factor
        if self.log:
            shown = np.where(shown < self.floor, self.floor, shown)
        return np.clip(shown, self.low, self.high)

    def hidden(self, values: Floats) -> NDArray[np.bool_]:
        """Tell which numbers stand in a place that is not theirs."""
        shown = values * self.factor
        low = self.floor if self.log else self.low
        beyond: NDArray[np.bool_] = (shown < low * (1 - 1e-9) if low > 0 else shown < low) | (
            shown > self.high
        )
        return beyond

    def apply(self, ax: Axes, *, upright: bool, ticks: int = 4) -> None:
        """Give the axis of a panel this scale.

        Parameters
        ----------
        ax : Axes
        upright : bool
            Whether it is the vertical axis.
        ticks : int
            How many numbers there is room for.
        """
        from matplotlib.ticker import FuncFormatter, MaxNLocator

        axis: Axis = ax.yaxis if upright else ax.xaxis
        if self.log:
            (ax.set_yscale if upright else ax.set_xscale)("log")
            set_log_ticks(axis, self.floor, self.high)
        else:
            axis.set_major_locator(MaxNLocator(ticks))
            axis.set_major_formatter(FuncFormatter(_plain))
        (ax.set_ylim if upright else ax.set_xlim)(self.low, self.high)


def scale_of(
    places: Iterable[Place], columns: Sequence[str], *, zero: bool = False, linear: bool = False
) -> Scale:
    """Return the axis that holds the values of panels, their intervals and their levels.

    Parameters
    ----------
    places : iterable of Place
        At least one; what holds for the first holds for all.
    columns : sequence of str
        Of the values, and of the ends of their intervals.
    zero : bool
        Whether 0 belongs to it.
    linear : bool
        Whether it is linear whatever the numbers are, unless the panel asks for something else.
    """
    places = list(places)
    panel = places[0].panel
    times = factor(panel.y_unit)
    value, *ends = columns
    numbers = [floats(place.frame, value) for place in places]
    levels = [place.panel.line_at for place in places if place.panel.line_at is not None]
    shown = _finite([*numbers, np.array(levels, float)]) * times
    limits = _finite([floats(place.frame, end) for place in places for end in ends]) * times
    positive = bool((shown > 0).any())
    if (panel.log_y and positive) or (not linear and _is_squeezed(panel, shown)):
        return _log_scale(shown[shown > 0], limits, _finite(numbers) * times, times)
    return _linear_scale(shown, limits, times, zero=zero or panel.y_unit == "percent")


def spread(
    grid: Grid, columns: Sequence[str], *, zero: bool = False, linear: bool = False
) -> dict[int, Scale]:
    """Return the axis of every panel, by its identity: one for those that show the same.

    Panels with a measure of their own share it with those of the same facet.
    """
    places = grid.places
    found = {}
    for place in places:
        alike = [one for one in places if one.panel is place.panel]
        found[id(place)] = scale_of(alike, columns, zero=zero, linear=linear)
    return found


def _finite(parts: Sequence[Floats]) -> Floats:
    joined = np.concatenate([*parts, np.zeros(0)])
    # Numbers so small that arithmetic on them loses digits are as good as none.
    found: Floats = np.where(np.abs(joined) < sys.float_info.min * 1e8, 0.0, joined)
    return found[np.isfinite(found)]


def _is_squeezed(panel: Panel, shown: Floats) -> bool:
    """Whether a linear axis would hide what matters: amounts that span two powers of ten."""
    if panel.y_unit not in ("percent", "cost", "ms") or not (shown > 0).any():
        return False
    high = float(shown.max())
    middle = float(np.median(shown[shown > 0]))
    return high > SQUEEZED * middle and shown.min() > -middle


def _log_scale(shown: Floats, limits: Floats, numbers: Floats, times: float) -> Scale:
    """Return a logarithmic axis; what is very much smaller than the rest stands at its end."""
    high = float(shown.max())
    low = max(float(shown.min()), high / DEEPEST)
    limits = limits[(limits > low / 3) & (limits < high * 2)]
    low, high = min([low, *limits]), max([high, *limits])
    # Room below the smallest value, where what is less stands as an open mark.
    floor = low / 2.2 if (numbers < low).any() else low / 1.15
    margin = (high / floor) ** 0.04
    less = bool((numbers < floor).any())
    return Scale(floor / margin, high * margin * 1.05, floor, times, less)


def _linear_scale(shown: Floats, limits: Floats, times: float, *, zero: bool) -> Scale:
    if not len(shown):
        return Scale(0.0, 1.0, math.nan, times)
    low, high = float(shown.min()), float(shown.max())
    span = high - low or abs(high) or 1.0
    least = min([low, *limits[limits >= low - BEYOND * span]])
    most = max([high, *limits[limits <= high + BEYOND * span]])
    if (limits > most).any():
        most = high + BEYOND * span
    if (limits < least).any():
        least = low - BEYOND * span
    if zero or (shown.min() >= 0 and least < NEAR_ZERO * most):
        least, most = min(least, 0.0) if shown.min() < 0 else 0.0, max(most, 0.0)
    span = most - least or 1.0
    # A mark at 0 stands clear of the axis.
    low = least - 0.045 * span
    return Scale(low, most + 0.045 * span, math.nan, times)


def _plain(value: float, _: object) -> str:
    """Write the number of a tick."""
    return f"{value:g}".replace("-", "−")


# -------------------------------------------------------------------------- levels and legends


def mark_level(ax: Axes, panel: Panel, scale: Scale, *, upright: bool) -> None:
    """Draw the level of a panel, behind the data; `upright` as the axis of values is."""
    if panel.line_at is None:
        return
    at = panel.line_at * scale.factor
    if scale.low <= at <= scale.high:
        (ax.axhline if upright else ax.axvline)(at, color=INK, lw=0.9, ls=LEVEL, zorder=1)


def label_of(panel: Panel, scale: Scale) -> str:
    """Return what an axis shows, whether it is logarithmic, and what is marked on it."""
    text = labelled(panel.y_label, panel.y_unit)
    if scale.log:
        text += f", logarithmic{', open marks: less' if scale.open else ''}"
    if panel.line_at is None or not panel.line_label:
        return text
    return f"{text}; dashed: {panel.line_label}" if text else f"dashed: {panel.line_label}"


def legend(canvas: Canvas, handles: Sequence[Artist], labels: Sequence[str]) -> None:
    """Put a legend over a figure, where there is something to tell apart; it is read by lines."""
    if not handles:
        return
    columns = _legend_columns(labels)
    # Entries fill the columns one after another.
    order = [i for column in range(columns) for i in range(column, len(labels), columns)]
    canvas.legend(
        handles=[handles[i] for i in order],
        labels=[labels[i] for i in order],
        loc="outside upper left",
        ncols=columns,
    )


def legend_lines(labels: Sequence[str]) -> int:
    """Return how many lines a legend takes."""
    return math.ceil(len(labels) / _legend_columns(labels)) if labels else 0


def _legend_columns(labels: Sequence[str]) -> int:
    """Return how many entries of a legend stand side by side, in lines of about equal length."""
    for columns in range(len(labels), 1, -1):
        groups = [labels[i::columns] for i in range(columns)]
        # A column is as wide as its longest entry.
        if sum(HANDLE + LETTER * max(map(len, group)) for group in groups) <= WIDTH:
            return math.ceil(len(labels) / math.ceil(len(labels) / columns))
    return 1


def folded(text: str, width: int) -> str:
    """Break a text that is too long for a line into lines; a word that is too long, anywhere."""
    import textwrap

    if len(text) <= width:
        return text
    lines = textwrap.wrap(text, width)
    # Lines of about equal length.
    even = textwrap.wrap(text, max(width // 2, math.ceil(len(text) / len(lines)) + 2))
    return "\n".join(even if len(even) == len(lines) else lines)
