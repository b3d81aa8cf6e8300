"""Figures of a comparison: small multiples, one panel a scenario, one row a policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from dwell.report.palette import INK, MUTED, PAPER, PARTS, Palette
from dwell.report.scales import is_wide, set_log_ticks
from dwell.report.svg import inline, new_figure
from dwell.report.wording import Measure, shown_policy, shown_scenario
from dwell.study import AIM, Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["distributions", "intervals", "latency_split", "node_use", "placement_shares"]

Draw: TypeAlias = "Callable[[Axes, str], None]"

PANELS_A_ROW = 5
ROW_INCHES = 0.235
NODE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LATER_RANGE = (0.1, 120.0)


def intervals(
    comparison: Comparison,
    palette: Palette,
    measure: Measure,
    *,
    title: str,
    limit: float,
    limit_name: str,
) -> str:
    """One column of every policy and scenario: mean over seeds, and its interval as a bar.

    Parameters
    ----------
    comparison : Comparison
    palette : Palette
    measure : Measure
    title : str
        What the axis shows, with its unit.
    limit : float
        A line to be under, in the column's unit.
    limit_name : str
    """
    policies = comparison.policies
    found = {
        (scenario, policy): comparison.interval(scenario, policy, measure.column)
        for scenario in comparison.scenarios
        for policy in policies
    }
    shown = [over.value * measure.factor for over in found.values()]
    positive = [value for value in [*shown, limit * measure.factor] if 0 < value < math.inf]
    low, high = min(positive), max(positive)
    wide = is_wide(positive)
    # Room below the smallest value, where zeros stand as open marks.
    edge = low / 2.5 if wide else 0.0

    def draw(ax: Axes, scenario: str) -> None:
        for row, policy in enumerate(policies):
            style = palette.policies[policy]
            value, left, right = (end * measure.factor for end in found[scenario, policy])
            if not math.isfinite(value):
                continue
            if value <= edge:
                ax.plot([edge], [row], style.marker, mfc=PAPER, mec=style.colour, clip_on=False)
                continue
            if not math.isnan(left) and found[scenario, policy].value != 1.0:
                ends = [max(left, edge), min(right, high * 2)]
                ax.plot(ends, [row, row], "-", color=style.colour, lw=2.2, alpha=0.45)
            ax.plot([value], [row], style.marker, color=style.colour)
        _line(ax, limit * measure.factor)
        if wide:
            ax.set_xscale("log")
            ax.set_xlim(edge / 1.3, high * 1.5)
            set_log_ticks(ax.xaxis, edge * 1.2, high * 1.5)
        else:
            ax.set_xlim(-0.05 * high, high * 1.08)
        ax.grid(axis="y", visible=False)

    scale = ", logarithmic" if wide else ""
    label = f"{title}{scale}; dashed: {limit_name}"
    return _panels(comparison, policies, f"{measure.column}-{comparison.problem.name}", draw, label)


def placement_shares(comparison: Comparison, palette: Palette, policies: Sequence[str]) -> str:
    """Share of windows per placement of the policies that move, as stacked bars."""
    candidates = tuple(comparison.problem.candidates)

    def draw(ax: Axes, scenario: str) -> None:
        for row, policy in enumerate(policies):
            left = 0.0
            for name in candidates:
                share = comparison.interval(scenario, policy, f"share_{name}").value * 100
                colour = palette.placements[name]
                ax.barh(row, share, left=left, color=colour, height=0.66, ec=PAPER, lw=0.6)
                if share >= 16:
                    text = f"{share:.0f}"
                    middle = left + share / 2
                    ax.text(middle, row, text, color="#ffffff", ha="center", va="center", size=8.5)
                left += share
        ax.set_xlim(0, 100)
        ax.set_xticks([0, 50, 100])
        ax.grid(visible=False)

    legend = [(name, palette.placements[name]) for name in candidates]
    name = f"shares-{comparison.problem.name}"
    return _panels(comparison, policies, name, draw, "share of the windows (%)", legend=legend)


def latency_split(comparison: Comparison) -> str:
    """Where the time of a finished cycle goes along its critical path, as stacked bars."""
    import polars as pl

    deadline_ms = comparison.problem.pipeline.deadline_ms
    policies = comparison.policies
    sums = comparison.runs.select(total=sum(pl.col(f"{part}_ms") for part in PARTS))["total"]
    longest = max([deadline_ms, *(value for value in sums if math.isfinite(value))])

    def draw(ax: Axes, scenario: str) -> None:
        for row, policy in enumerate(policies):
            left = 0.0
            for part, colour in PARTS.items():
                width = comparison.interval(scenario, policy, f"{part}_ms").value
                if math.isfinite(width):
                    ax.barh(row, width, left=left, color=colour, height=0.66, ec=PAPER, lw=0.6)
                    left += width
        _line(ax, deadline_ms)
        ax.set_xlim(0, 1.04 * longest)
        ax.grid(axis="y", visible=False)

    legend = list(zip(("computing", "waiting", "network"), PARTS.values(), strict=True))
    name = f"split-{comparison.problem.name}"
    label = "mean latency of finished cycles (ms); dashed: deadline"
    return _panels(comparison, policies, name, draw, label, legend=legend)


def node_use(comparison: Comparison) -> str:
    """Mean utilisation of every node, a mark each."""
    nodes = tuple(comparison.problem.fabric.nodes)
    cap = comparison.problem.objective.caps.utilisation
    policies = comparison.policies
    shades = (INK, MUTED)

    def draw(ax: Axes, scenario: str) -> None:
        for row, policy in enumerate(policies):
            for i, node in enumerate(nodes):
                used = comparison.interval(scenario, policy, f"node_{node}").value * 100
                marker, shade = NODE_MARKERS[i % len(NODE_MARKERS)], shades[i % 2]
                face = PAPER if i % 2 else shade
                ax.plot([used], [row], marker, mfc=face, mec=shade, ms=5.5, clip_on=False)
        if math.isfinite(cap):
            _line(ax, cap * 100)
        ax.set_xlim(-5, 105)
        ax.set_xticks([0, 50, 100])

    from matplotlib.lines import Line2D

    handles = [
        Line2D(
            [],
            [],
            ls="",
            marker=NODE_MARKERS[i % len(NODE_MARKERS)],
            mfc=PAPER if i % 2 else shades[i % 2],
            mec=shades[i % 2],
            label=node,
        )
        for i, node in enumerate(nodes)
    ]
    name = f"nodes-{comparison.problem.name}"
    label = "utilisation of the node (%)" + ("; dashed: cap" if math.isfinite(cap) else "")
    return _panels(comparison, policies, name, draw, label, handles=handles)


def distributions(comparison: Comparison, palette: Palette) -> str:
    """Share of the cycles that took longer than a latency: one less the empirical distribution."""
    import polars as pl
    from matplotlib.lines import Line2D

    deadline_ms = comparison.problem.pipeline.deadline_ms
    scenarios = comparison.scenarios
    columns = len(scenarios) if len(scenarios) <= 4 else 3
    rows = math.ceil(len(scenarios) / columns)
    with new_figure(2.15 * rows + 0.5) as figure:
        axes = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
        for i, ax in enumerate(axes):
            if i >= len(scenarios):
                ax.set_axis_off()
                continue
            for policy in comparison.policies:
                style = palette.policies[policy]
                line = comparison.latencies.filter(
                    (pl.col("scenario") == scenarios[i]) & (pl.col("policy") == policy)
                )
                later = 100 * (1 - line["share"].to_numpy())
                # Zero has no place on a logarithmic axis.
                later[later <= 0] = np.nan
                ax.plot(
                    line["latency_ms"].to_numpy(),
                    later,
                    color=style.colour,
                    ls=style.dashes,
                    lw=style.width,
                )
            _line(ax, deadline_ms)
            ax.axhline(100 * AIM, color=MUTED, lw=0.8, ls=(0, (1, 2)))
            ax.set_title(shown_scenario(scenarios[i]))
            ax.set_yscale("log")
            ax.set_ylim(*LATER_RANGE)
            set_log_ticks(ax.yaxis, *LATER_RANGE)
            ax.set_xlim(0, 3 * deadline_ms)
        figure.supxlabel("latency (ms); dashed: deadline", size=9, color=MUTED)
        figure.supylabel("cycles that took longer (%)", size=9, color=MUTED)
        handles = [
            Line2D(
                [],
                [],
                color=palette.policies[policy].colour,
                ls=palette.policies[policy].dashes,
                lw=palette.policies[policy].width,
                label=shown_policy(policy),
            )
            for policy in comparison.policies
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=len(handles))
        name = f"latencies-{comparison.problem.name}"
        return inline(figure, name, "Distribution of latency by scenario and policy")


def _panels(
    comparison: Comparison,
    policies: Sequence[str],
    name: str,
    draw: Draw,
    label: str,
    *,
    legend: Sequence[tuple[str, str]] = (),
    handles: Sequence[object] = (),
) -> str:
    """Draw one panel a scenario, side by side, the policies named at the left."""
    from matplotlib.patches import Patch

    scenarios = comparison.scenarios
    columns = min(PANELS_A_ROW, len(scenarios))
    rows = math.ceil(len(scenarios) / columns)
    patches = handles or [Patch(color=colour, label=text) for text, colour in legend]
    height = rows * (len(policies) * ROW_INCHES + 0.45) + 0.3 + (0.3 if patches else 0)
    with new_figure(height) as figure:
        grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
        for i, ax in enumerate(grid.flat):
            if i >= len(scenarios):
                ax.set_axis_off()
                continue
            draw(ax, scenarios[i])
            ax.set_title(_folded(shown_scenario(scenarios[i])))
            ax.tick_params(axis="y", length=0)
            ax.spines["left"].set_visible(False)
        grid[0, 0].set_ylim(len(policies) - 0.4, -0.6)
        for ax in grid[:, 0]:
            ax.set_yticks(range(len(policies)), [shown_policy(name) for name in policies])
            ax.tick_params(axis="y", labelcolor=INK)
        figure.supxlabel(label, size=9, color=MUTED)
        if patches:
            figure.legend(handles=patches, loc="outside upper left", ncols=len(patches))
        return inline(figure, name, label)


def _line(ax: Axes, x: float) -> None:
    """Draw a limit, behind the data."""
    ax.axvline(x, color=INK, lw=0.9, ls=(0, (4, 2)), zorder=1)


def _folded(text: str, width: int = 22) -> str:
    """Break a long name into two lines at the blank nearest to its middle."""
    if len(text) <= width or " " not in text:
        return text
    blanks = [i for i, letter in enumerate(text) if letter == " "]
    middle = min(blanks, key=lambda i: abs(i - len(text) / 2))
    return f"{text[:middle]}\n{text[middle + 1 :]}"
