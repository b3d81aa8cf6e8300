"""Maps: which placement wins at each point of a grid, and by how much."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from dwell.report.palette import INK, MUTED, PAPER
from dwell.report.panels import Place, floats, keys, legend, legend_lines, parted
from dwell.report.style import PageStyle, key
from dwell.report.svg import WIDTH, new_figure
from dwell.report.units import labelled, write
from dwell.study.chapter import Figure

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

__all__ = ["draw_map"]

MOST_PANELS = 3
CELL_INCHES = 0.42
# With three rows of panels or more.
LOW_CELL_INCHES = 0.27
# Opacity of a cell whose winner wins by nothing, and of one that wins by the most: letters in the
# colour of the text can be read on both, in a light and in a dark page.
FAINT, STRONG = 0.14, 0.72
# Of a cell whose colour is that of a value.
PLAIN = 0.5
# Share of the points whose winners are not shown to win by more than others.
MOST = 0.9
HATCH = "///"
LETTER_INCHES = 0.07


def draw_map(figure: Figure, look: PageStyle) -> Canvas:
    """Draw a cell for every point, in its winner's colour and with its name.

    The more it wins by, the stronger the colour. Points are equally spaced, whatever their values.
    """
    grid = parted(figure, look, MOST_PANELS)
    columns, rows = keys(figure.frame, figure.x), keys(figure.frame, figure.y)
    seen = keys(figure.frame, figure.series)
    winners = [name for name in look.placements if name in seen]
    winners += sorted(name for name in seen if name not in look.placements)
    colours = {name: style.colour for name, style in look.styles(winners).items()}
    margin = floats(figure.frame, "margin")
    margin = np.sort(margin[np.isfinite(margin)])
    named = all(name in look.placements for name in seen)
    # Values have no margins, and one point that is far from all others hides none.
    largest = float(margin[int(MOST * (len(margin) - 1))]) if named and len(margin) else 0.0
    strong = STRONG if named else PLAIN
    width = (WIDTH - 0.9) / grid.columns - 0.35
    side = min(width / max(len(columns), 1), CELL_INCHES * 1.6)
    tall = min(side, CELL_INCHES if len(grid.rows) < 3 else LOW_CELL_INCHES)
    room = int(side * 0.9 / LETTER_INCHES)
    labels, handles = _legend(figure, look, colours, largest, strong)
    height = len(grid.rows) * (len(rows) * tall + 0.62) + 0.35 + 0.22 * legend_lines(labels)
    names = _fitting(winners, room)
    with new_figure(height) as canvas:

        def draw(ax: Axes, place: Place) -> None:
            for row in place.frame.iter_rows(named=True):
                if row[figure.x] is None or row[figure.y] is None or row[figure.series] is None:
                    continue
                at = columns.index(key(row[figure.x])), rows.index(key(row[figure.y]))
                _cell(
                    ax,
                    at,
                    colours[key(row[figure.series])],
                    names[key(row[figure.series])],
                    opacity=FAINT + _share(row.get("margin"), largest) * (strong - FAINT),
                    marked=bool(row.get("marked")),
                )
            ax.set_xlim(-0.5, len(columns) - 0.5)
            ax.set_ylim(-0.5, len(rows) - 0.5)
            every = max(1, math.ceil(len(columns) * max(map(len, columns)) * 0.08 / width))
            ax.set_xticks(range(0, len(columns), every), columns[::every])
            ax.set_yticks(range(len(rows)), rows)
            ax.tick_params(length=0)
            ax.grid(visible=False)
            ax.spines[["left", "bottom"]].set_visible(False)

        grid.draw(canvas, draw, values="none")
        canvas.supxlabel(figure.x_label or figure.x, size=9, color=MUTED)
        canvas.supylabel(figure.y_label or figure.y, size=9, color=MUTED)
        legend(canvas, handles, labels)
    return canvas


def _share(margin: float | None, largest: float) -> float:
    """Return how much a winner wins by, as a share of the most; 1 where nobody says."""
    if margin is None or math.isnan(margin) or not largest:
        return 1.0
    return min(max(margin / largest, 0.0), 1.0)


def _cell(
    ax: Axes,
    at: tuple[int, int],
    colour: str,
    text: str,
    *,
    opacity: float,
    marked: bool,
) -> None:
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Rectangle

    x, y = at
    ax.add_patch(
        Rectangle(
            (x - 0.5, y - 0.5),
            1,
            1,
            facecolor=to_rgba(colour, opacity),
            edgecolor=PAPER,
            linewidth=1.2,
        )
    )
    if marked:
        ax.add_patch(
            Rectangle(
                (x - 0.5, y - 0.5),
                1,
                1,
                facecolor="none",
                edgecolor=to_rgba(INK, 0.45),
                linewidth=0,
                hatch=HATCH,
            )
        )
    if text:
        ax.text(x, y, text, ha="center", va="center", size=8, color=INK)


def _fitting(names: list[str], room: int) -> dict[str, str]:
    """Return what is written in a cell: the names, or as much of them as tells them apart."""
    for length in (max(map(len, names), default=0), *range(min(room, 6), 0, -1)):
        short = {name: name[:length] for name in names}
        if length <= room and len(set(short.values())) == len(names):
            return short
    return dict.fromkeys(names, "")


def _legend(
    figure: Figure, look: PageStyle, colours: dict[str, str], largest: float, strong: float
) -> tuple[list[str], list[Artist]]:
    from matplotlib.patches import Patch

    labels = [look.shown(name) for name in colours]
    handles: list[Artist] = [
        Patch(facecolor=colour, alpha=strong, lw=0) for colour in colours.values()
    ]
    if largest:
        # Between shares there are points, not percent.
        unit = "change" if figure.y_unit == "percent" else figure.y_unit
        most = labelled(write(largest, unit).removeprefix("+"), unit)
        labels += ["wins by nothing", f"by {most.replace('(', '').replace(')', '')} or more"]
        handles += [Patch(facecolor=MUTED, alpha=alpha, lw=0) for alpha in (FAINT, STRONG)]
    if "marked" in figure.frame.columns and figure.frame["marked"].any():
        labels.append(figure.line_label or "see the note")
        handles.append(Patch(facecolor="none", edgecolor=MUTED, lw=0.4, hatch=HATCH))
    return labels, handles
