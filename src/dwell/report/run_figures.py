"""Figures of a single run, by placement: latencies, where the time goes, how busy the nodes are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dwell.report.drawing import draw
from dwell.report.palette import INK, MUTED, PAPER, PARTS
from dwell.report.style import PageStyle
from dwell.report.svg import inline, new_figure
from dwell.study.chapter import Figure
from dwell.study.summary import latency_ms

if TYPE_CHECKING:
    import polars as pl

__all__ = ["latencies_by_placement", "node_use_in_time", "split_by_placement"]

LINES = ("solid", (0, (5, 2)), (0, (1.2, 1.6)), (0, (5, 1.5, 1.2, 1.5)))
DASHED = (0, (4, 2))


def latencies_by_placement(cycles: pl.DataFrame, look: PageStyle, deadline_ms: float) -> str:
    """Share of the cycles that took longer than a latency, a line for each placement."""
    import polars as pl

    frames = []
    for name in look.placements:
        final_ms = np.sort(latency_ms(cycles.filter(cycles["placement"].cast(str) == name)))
        finite = final_ms[np.isfinite(final_ms)]
        keep = _thinned(len(finite))
        share = (keep + 1) / max(len(final_ms), 1)
        lines = pl.DataFrame({"x": finite[keep], "y": share})
        frames.append(lines.select(pl.lit(name).alias("placement"), pl.all()))
    figure = Figure(
        slug="latencies",
        title="Distribution of latency by placement",
        kind="ecdf",
        frame=pl.concat(frames),
        x="x",
        y="y",
        series="placement",
        x_label="latency (ms)",
        line_at=deadline_ms,
        line_label="deadline",
    )
    return inline(draw(figure, look), figure.slug, figure.title)


def split_by_placement(
    cycles: pl.DataFrame, placements: Mapping[str, str], deadline_ms: float
) -> str:
    """Where the time of finished cycles goes, a bar for each placement."""
    from matplotlib.patches import Patch

    used = [name for name in placements if (cycles["placement"].cast(str) == name).any()]
    with new_figure(0.3 * len(used) + 0.9) as figure:
        ax = figure.subplots()
        longest = deadline_ms
        for row, name in enumerate(used):
            mine = cycles.filter(cycles["placement"].cast(str) == name)
            left = 0.0
            for part, colour in PARTS.items():
                mean = mine[f"{part}_ns"].cast(float).mean()
                if isinstance(mean, float):
                    width = mean / 1e6
                    ax.barh(row, width, left=left, color=colour, height=0.6, ec=PAPER, lw=0.6)
                    left += width
            longest = max(longest, left)
        ax.axvline(deadline_ms, color=INK, lw=0.9, ls=DASHED, zorder=1)
        ax.set_xlim(0, 1.04 * longest)
        ax.set_ylim(len(used) - 0.5, -0.5)
        ax.set_yticks(range(len(used)), used)
        ax.tick_params(axis="y", length=0, labelcolor=INK)
        ax.spines["left"].set_visible(False)
        ax.grid(axis="y", visible=False)
        ax.set_xlabel("mean latency of finished cycles (ms); dashed: deadline")
        names = zip(("computing", "waiting", "network"), PARTS.values(), strict=True)
        handles = [Patch(color=colour, label=text) for text, colour in names]
        figure.legend(handles=handles, loc="outside upper left", ncols=3)
        return inline(figure, "split", "Mean latency by placement and part")


def node_use_in_time(
    windows: pl.DataFrame, nodes: Sequence[str], begin_s: NDArray[np.float64]
) -> str:
    """Utilisation of every node, window by window; `begin_s` says when each began."""
    with new_figure(2.0) as figure:
        ax = figure.subplots()
        for i, node in enumerate(nodes):
            used = windows[f"u_{node}"].cast(float).fill_null(math.nan).to_numpy() * 100
            shade = INK if i % 2 == 0 else MUTED
            ax.plot(begin_s, used, color=shade, ls=LINES[i % len(LINES)], lw=1.1, label=node)
        ax.set_ylim(0, 104)
        ax.set_yticks([0, 50, 100])
        ax.set_xlim(0, float(begin_s[-1]) or 1.0)
        ax.set_xlabel("time (s)")
        ax.set_ylabel("utilisation (%)")
        figure.legend(loc="outside upper left", ncols=len(nodes))
        return inline(figure, "nodes", "Utilisation of the nodes over time")


def _thinned(count: int, points: int = 500) -> NDArray[np.int64]:
    """Return which of `count` sorted values to draw: the nearer to the tail, the more of them."""
    if not count:
        return np.zeros(0, np.int64)
    from_end = np.unique(np.rint(np.geomspace(1, count, min(count, points))).astype(np.int64))
    return (count - from_end)[::-1]
