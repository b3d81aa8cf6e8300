"""Figures of a validation: predicted over measured, distributions, and where the time goes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.report.formatting import shown_contender, shown_scenario
from dwell.report.palette import INK, MUTED, PAPER, PARTS, RULE, Palette
from dwell.report.panels import folded
from dwell.report.scales import is_wide, set_log_ticks
from dwell.report.svg import inline, new_figure
from dwell.study.intervals import Interval
from dwell.study.judged_prediction import Judged
from dwell.study.validation import L95_ALLOWED, POINTS_ALLOWED, USE_ALLOWED, Group, Validation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["distributions", "predicted_over_measured", "time_split"]

Floats: TypeAlias = NDArray[np.float64]

DASHED = (0, (4, 2))
# Of scenarios, in the order of the cell.
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
# An axis of latencies ends after so many deadlines.
DEADLINES = 3.0
COLUMNS = 4
POINTS = 300


def predicted_over_measured(validation: Validation, palette: Palette) -> str:
    """L95, V_D and U of every group: predicted over measured, with what is allowed as a band."""
    from matplotlib.lines import Line2D

    groups = validation.groups
    scenarios = list(dict.fromkeys(group.scenario for group in groups))
    policies = list(dict.fromkeys(group.policy for group in groups))
    marks = {name: MARKERS[i % len(MARKERS)] for i, name in enumerate(scenarios)}
    with new_figure(4.3) as figure:
        l95, rate, use = figure.subplots(1, 3)
        _l95(l95, groups, marks, palette)
        _shares(
            rate,
            [(group, [group.figures["violation_rate"]]) for group in groups],
            POINTS_ALLOWED,
            marks,
            palette,
        )
        _shares(
            use,
            [(group, list(group.uses.values())) for group in groups],
            USE_ALLOWED,
            marks,
            palette,
        )
        l95.set_title(f"L95 (ms{', logarithmic' if l95.get_xscale() == 'log' else ''})")
        rate.set_title("V_D (%)")
        use.set_title("U of each node (%)")
        figure.supxlabel("measured", size=9, color=MUTED)
        figure.supylabel("predicted", size=9, color=MUTED)
        handles = [
            Line2D(
                [],
                [],
                ls="",
                marker="o",
                mfc=_colour(palette, name),
                mec="none",
                label=shown_contender(name),
            )
            for name in policies
        ]
        handles += [
            Line2D([], [], ls="", marker=mark, mfc="none", mec=INK, label=shown_scenario(name))
            for name, mark in marks.items()
        ]
        handles.append(
            Line2D([], [], ls="", marker="_", mec=MUTED, label="sum of means (L95, V_D)")
        )
        figure.legend(handles=handles, loc="outside upper left", ncols=COLUMNS)
        return inline(figure, "over", "Predicted over measured: L95, V_D and utilisation")


def _colour(palette: Palette, policy: str) -> str:
    return palette.policies[policy].colour


def _l95(ax: Axes, groups: Sequence[Group], marks: Mapping[str, str], palette: Palette) -> None:
    shown = [one for one in groups if math.isfinite(one.figures["l95_ms"].measured.value)]
    values = [
        value
        for one in shown
        for value in (
            one.figures["l95_ms"].measured.value,
            one.figures["l95_ms"].predicted.value,
            one.figures["l95_ms"].baseline,
        )
        if math.isfinite(value) and value > 0
    ]
    if not values:
        ax.text(
            0.5,
            0.5,
            "more than 5 % lost\nin every group",
            ha="center",
            color=MUTED,
            transform=ax.transAxes,
        )
        return
    log = is_wide(values)
    low, high = (min(values) / 1.25, max(values) * 1.25) if log else (0.0, max(values) * 1.1)
    ends = np.array([low, high])
    ax.fill_between(
        ends, ends * (1 - L95_ALLOWED), ends * (1 + L95_ALLOWED), color=RULE, lw=0, zorder=0.5
    )
    ax.plot(ends, ends, color=MUTED, lw=0.8, ls=DASHED, zorder=1)
    for one in shown:
        figure = one.figures["l95_ms"]
        ax.plot([figure.measured.value], [figure.baseline], "_", color=MUTED, ms=7, mew=1.2)
        if math.isfinite(figure.predicted.value):
            _mark(
                ax,
                figure.measured,
                figure.predicted,
                1.0,
                marks[one.scenario],
                _colour(palette, one.policy),
            )
    if log:
        ax.set_xscale("log")
        ax.set_yscale("log")
        set_log_ticks(ax.xaxis, low, high)
        set_log_ticks(ax.yaxis, low, high)
    _square(ax, low, high)


def _shares(
    ax: Axes,
    found: Sequence[tuple[Group, Sequence[Judged]]],
    allowed: float,
    marks: Mapping[str, str],
    palette: Palette,
) -> None:
    ends = np.array([-5.0, 105.0])
    ax.fill_between(ends, ends - 100 * allowed, ends + 100 * allowed, color=RULE, lw=0, zorder=0.5)
    ax.plot(ends, ends, color=MUTED, lw=0.8, ls=DASHED, zorder=1)
    for group, figures in found:
        for one in figures:
            if math.isfinite(one.baseline):
                ax.plot(
                    [100 * one.measured.value],
                    [100 * one.baseline],
                    "_",
                    color=MUTED,
                    ms=7,
                    mew=1.2,
                )
            _mark(
                ax,
                one.measured,
                one.predicted,
                100.0,
                marks[group.scenario],
                _colour(palette, group.policy),
            )
    ax.set_xticks([0, 25, 50, 75, 100])
    ax.set_yticks([0, 25, 50, 75, 100])
    _square(ax, -5.0, 105.0)


def _mark(
    ax: Axes, measured: Interval, predicted: Interval, factor: float, marker: str, colour: str
) -> None:
    """Draw a mark with the interval of what was measured."""
    y = factor * predicted.value
    if measured.known and math.isfinite(measured.high):
        ax.plot([factor * measured.low, factor * measured.high], [y, y], color=colour, lw=1.0)
    ax.plot(
        [factor * measured.value], [y], marker, mfc=colour, mec=PAPER, mew=0.5, ms=6.5, zorder=3
    )


def _square(ax: Axes, low: float, high: float) -> None:
    ax.set_xlim(low, high)
    ax.set_ylim(low, high)
    ax.set_box_aspect(1)


def distributions(validation: Validation, palette: Palette) -> str:
    """Empirical distribution of the measured and of the predicted latencies, a panel a group."""
    from matplotlib.lines import Line2D

    groups = validation.groups
    deadline_ms = validation.problem.pipeline.deadline_ms
    columns = min(COLUMNS, max(2, len(groups)))
    rows = math.ceil(len(groups) / columns)
    with new_figure(1.95 * rows + 0.75) as figure:
        grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for ax, group in zip(grid.flat, groups, strict=False):
            colour = _colour(palette, group.policy)
            end = _end(group, deadline_ms)
            ax.axvspan(
                deadline_ms * (1 - L95_ALLOWED),
                deadline_ms * (1 + L95_ALLOWED),
                color=RULE,
                lw=0,
                zorder=0.5,
            )
            ax.axvline(deadline_ms, color=MUTED, lw=0.9, ls=DASHED, zorder=1)
            ax.plot(
                *_curve(group.measured.latency_ms, end),
                color=colour,
                lw=2.6,
                alpha=0.45,
                solid_capstyle="butt",
            )
            ax.plot(*_curve(group.predicted.latency_ms, end), color=INK, lw=1.0)
            ax.set_xlim(_begin(group), end)
            ax.set_ylim(0, 102)
            ax.set_yticks([0, 50, 95])
            title = f"{shown_scenario(group.scenario)}, {shown_contender(group.policy)}"
            ax.set_title(folded(title, 30), fontsize=8.5)
        for ax in list(grid.flat)[len(groups) :]:
            ax.set_axis_off()
        figure.supxlabel(
            "latency (ms); dashed: deadline, shaded: 10 % about it", size=9, color=MUTED
        )
        figure.supylabel("cycles that took no longer (%)", size=9, color=MUTED)
        handles = [
            Line2D(
                [], [], color=MUTED, lw=2.6, alpha=0.45, label="measured (in the policy's colour)"
            ),
            Line2D([], [], color=INK, lw=1.0, label="predicted"),
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=2)
        return inline(figure, "distributions", "Distributions of measured and predicted latencies")


def _begin(group: Group) -> float:
    least = min(float(group.measured.latency_ms[0]), float(group.predicted.latency_ms[0]))
    return 0.92 * least if math.isfinite(least) else 0.0


def _end(group: Group, deadline_ms: float) -> float:
    """Where an axis ends: behind nearly all latencies, and behind the deadline."""
    last = [
        float(np.quantile(values[np.isfinite(values)], 0.998))
        for values in (group.measured.latency_ms, group.predicted.latency_ms)
        if np.isfinite(values).any()
    ]
    return min(max([1.2 * deadline_ms, *last]), DEADLINES * deadline_ms)


def _curve(ascending_ms: Floats, end: float) -> tuple[Floats, Floats]:
    """Points of a distribution; it ends below 100 % where cycles were lost."""
    inside = int(np.searchsorted(ascending_ms, end, side="right"))
    if not inside:
        return np.array([end]), np.array([0.0])
    picked = np.unique(np.rint(np.linspace(0, inside - 1, POINTS)).astype(np.int64))
    share = 100 * (picked + 1) / len(ascending_ms)
    return np.append(ascending_ms[picked], end), np.append(share, share[-1])


def time_split(validation: Validation) -> str:
    """Where the time of finished cycles goes: measured above, predicted below, a pair a group."""
    from matplotlib.patches import Patch

    groups = validation.groups
    deadline_ms = validation.problem.pipeline.deadline_ms
    with new_figure(0.42 * len(groups) + 0.9) as figure:
        ax = figure.subplots()
        longest = deadline_ms
        for row, group in enumerate(groups):
            pair = ((group.measured, row - 0.12, 0.42), (group.predicted, row + 0.22, 0.2))
            for sample, at, height in pair:
                left = 0.0
                for part, colour in PARTS.items():
                    width = sample.parts_ms[part]
                    if math.isfinite(width):
                        ax.barh(at, width, left=left, height=height, color=colour, ec=PAPER, lw=0.5)
                        left += width
                longest = max(longest, left)
        ax.axvline(deadline_ms, color=INK, lw=0.9, ls=DASHED, zorder=1)
        ax.set_xlim(0, 1.04 * longest)
        ax.set_ylim(len(groups) - 0.5, -0.5)
        names = [f"{shown_scenario(one.scenario)}, {shown_contender(one.policy)}" for one in groups]
        ax.set_yticks(range(len(groups)), names)
        ax.tick_params(axis="y", length=0, labelcolor=INK)
        ax.spines["left"].set_visible(False)
        ax.grid(axis="y", visible=False)
        ax.set_xlabel(
            "mean latency of finished cycles (ms): thick measured, thin predicted; dashed: deadline"
        )
        parts = zip(("computing", "waiting", "network"), PARTS.values(), strict=True)
        handles = [Patch(color=colour, label=text) for text, colour in parts]
        figure.legend(handles=handles, loc="outside upper left", ncols=3)
        return inline(figure, "parts", "Mean latency by part, measured and predicted")
