"""Drawing: a chapter's figure, which is data and meaning, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dwell.report.curves import draw_distributions, draw_lines
from dwell.report.named_rows import draw_bars, draw_intervals
from dwell.report.palette import MUTED
from dwell.report.panels import floats
from dwell.report.style import PageStyle
from dwell.report.svg import new_figure
from dwell.report.window_timeline import draw_timeline
from dwell.report.winner_map import draw_map
from dwell.study.chapter import Figure

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from matplotlib.figure import Figure as Canvas

    from dwell.study.chapter import FigureKind

__all__ = ["draw"]

KINDS: Mapping[FigureKind, Callable[[Figure, PageStyle], Canvas]] = {
    "intervals": draw_intervals,
    "lines": draw_lines,
    "bars": draw_bars,
    "map": draw_map,
    "ecdf": draw_distributions,
    "timeline": draw_timeline,
}


def draw(figure: Figure, look: PageStyle) -> Canvas:
    """Draw a figure; where it holds no number, that is what it says.

    Parameters
    ----------
    figure : Figure
    look : PageStyle
        Of the whole page.
    """
    if _is_empty(figure):
        with new_figure(0.6) as canvas:
            text = "Nothing to show: no run gave a number for this figure."
            canvas.text(0.01, 0.5, text, color=MUTED, va="center")
        return canvas
    return KINDS[figure.kind](figure, look)


def _is_empty(figure: Figure) -> bool:
    if figure.kind == "map":
        return figure.frame[figure.series].drop_nulls().is_empty()
    return figure.frame.is_empty() or bool(np.isnan(floats(figure.frame, figure.y)).all())
