"""Figures of a comparison: small multiples, one panel a scenario, one row a policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, TypeAlias

from dwell.report.drawing import draw
from dwell.report.formatting import Measure, shown_contender, shown_scenario
from dwell.report.palette import INK, MUTED, PAPER, PARTS, Palette
from dwell.report.panels import folded
from dwell.report.scales import is_wide
from dwell.report.style import PageStyle
from dwell.report.svg import inline, new_figure
from dwell.report.timeline import run_timeline
from dwell.study import Comparison
from dwell.study.chapter import Figure, Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "distributions",
    "intervals",
    "latency_figure",
    "latency_split",
    "node_use",
    "placement_shares",
    "through_time",
]

Draw: TypeAlias = "Callable[[Axes, str], None]"

PANELS_A_ROW = 5
ROW_INCHES = 0.235
NODE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def intervals(
    comparison: Comparison,
    look: PageStyle,
    measure: Measure,
    unit: Unit,
    *,
    limit: float,
    name: str,
) -> str:
    """One column of every policy and scenario: mean over seeds, and its interval as a bar.

    Parameters
    ----------
    comparison : Comparison
    look : PageStyle
    measure : Measure
    unit : Unit
        Of the column.
    limit : float
        A line to be under, in the column's unit.
    name : str
        What the limit is called.
    """
    import polars as pl

    rows = [
        (scenario, policy, *comparison.interval(scenario, policy, measure.column))
        for scenario in comparison.scenarios
        for policy in comparison.policies
    ]
    columns = ["scenario", "policy", "y", "y_low", "y_high"]
    figure = Figure(
        slug=measure.column,
        title=f"{measure.name} by scenario and policy",
        kind="intervals",
        frame=pl.DataFrame(rows, schema=columns, orient="row"),
        x="policy",
        y="y",
        series="policy",
        facet="scenario",
        y_label=measure.name,
        y_unit=unit,
        line_at=limit,
        line_label=name,
        log_y=is_wide([value for value in (*(row[2] for row in rows), limit) if value > 0]),
    )
    return _drawn(comparison, look, figure)


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


def distributions(comparison: Comparison, look: PageStyle) -> str:
    """Share of the cycles that took longer than a latency: one less the empirical distribution."""
    return _drawn(comparison, look, latency_figure(comparison))


def latency_figure(comparison: Comparison) -> Figure:
    """Return the distributions of latency of all cycles, a panel a scenario."""
    return Figure(
        slug="latencies",
        title="Distribution of latency by scenario and policy",
        kind="ecdf",
        frame=comparison.latencies,
        x="latency_ms",
        y="share",
        series="policy",
        facet="scenario",
        x_label="latency (ms)",
        line_at=comparison.problem.pipeline.deadline_ms,
        line_label="deadline",
    )


def through_time(comparison: Comparison, look: PageStyle, scenario: str, policy: str) -> str:
    """One run, window by window."""
    example, problem = comparison.examples[scenario, policy], comparison.problem
    figure = run_timeline(
        example.windows,
        example.decisions,
        candidates=tuple(problem.candidates),
        period_ms=problem.pipeline.period_ms,
        deadline_ms=problem.pipeline.deadline_ms,
        slug=f"time-{scenario}",
    )
    return _drawn(comparison, look, figure)


def _drawn(comparison: Comparison, look: PageStyle, figure: Figure) -> str:
    return inline(draw(figure, look), f"{figure.slug}-{comparison.problem.name}", figure.title)


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
            ax.set_title(folded(shown_scenario(scenarios[i]), 22))
            ax.tick_params(axis="y", length=0)
            ax.spines["left"].set_visible(False)
        grid[0, 0].set_ylim(len(policies) - 0.4, -0.6)
        for ax in grid[:, 0]:
            ax.set_yticks(range(len(policies)), [shown_contender(name) for name in policies])
            ax.tick_params(axis="y", labelcolor=INK)
        figure.supxlabel(label, size=9, color=MUTED)
        if patches:
            figure.legend(handles=patches, loc="outside upper left", ncols=len(patches))
        return inline(figure, name, label)


def _line(ax: Axes, x: float) -> None:
    """Draw a limit, behind the data."""
    ax.axvline(x, color=INK, lw=0.9, ls=(0, (4, 2)), zorder=1)
