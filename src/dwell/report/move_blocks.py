"""Figure and table of predicted moves: estimates, and the measurements that followed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dwell.display import Measure
from dwell.report.charts import NO_LIMIT, Limit, coloured, disc, layer, names, quantity, square
from dwell.report.figure import Figure, Spec
from dwell.report.palette import MUTED, Palette
from dwell.report.table import MOST_ROWS, WITHOUT_WARMUP, Columns, Row, Table, Text
from dwell.study.metric import METRICS

if TYPE_CHECKING:
    import polars as pl

#: Predicted metrics, each with the column of its standard error.
PREDICTED = {METRICS["l95_ms"]: "l95_error_ms", METRICS["violation_rate"]: "violation_error"}
#: Width left for axes and legend next to the two panels, and largest side of a panel, pixels.
BESIDE_PX, SIDE_PX = 230, 300
#: Share of the range that is free at each end of an axis.
MARGIN = 0.06


def move_blocks(
    moves: pl.DataFrame,
    palette: Palette,
    limit: Limit,
    about: Sequence[Text] = (),
    group: Text | None = None,
) -> list[Figure | Table]:
    """Return a figure and a table of predicted moves, or an empty list without moves.

    `moves` is a frame of `dwell.study.predicted_moves.predicted_moves` with the columns of
    `about`, the first columns of the table. The table has a heading for each value of `group`.
    """
    if moves.is_empty():
        return []
    return [_figure(moves, palette, limit), _table(moves, palette, about, group)]


def _figure(moves: pl.DataFrame, palette: Palette, limit: Limit) -> Figure:
    import polars as pl

    frame = moves.with_columns(
        pl.col(f"{when}_{name}") * metric.factor
        for metric, error in PREDICTED.items()
        for when in ("predicted", "seen")
        for name in (metric.column, error)
    )
    used = set(frame["to"])
    colours = {name: colour for name, colour in palette.placements.items() if name in used}
    limits = (limit, NO_LIMIT)
    return Figure(
        "predicted",
        "Predicted over seen, by the placement moved to",
        {"rows": frame},
        lambda width: {
            "hconcat": [
                _scatter(frame, metric.column, error, metric.heading, limit, colours, width)
                for (metric, error), limit in zip(PREDICTED.items(), limits, strict=True)
            ],
        },
        "A mark is a move: up, the estimate of the placement at the close at which it was chosen; "
        "across, the mean of what its windows showed at their closes until the next move, without "
        "the first where there are others. Bars: a standard error to each side. Each axis has its "
        "own range. Line: seen as predicted."
        f"{f' Dashed: {limit.name}.' if math.isfinite(limit.value) else ''}",
    )


def _scatter(
    frame: pl.DataFrame,
    column: str,
    error: str,
    title: str,
    limit: Limit,
    colours: dict[str, str],
    width: float,
) -> Spec:
    side = min((width - BESIDE_PX) / 2, SIDE_PX)
    ends_of = {when: _range(frame, when, column, error) for when in ("seen", "predicted")}
    scales = {when: {"domain": [*of], "nice": False, "zero": False} for when, of in ends_of.items()}
    across, up = (
        quantity(f"{when}_{column}", f"{title}, {when}", scale=scale, axis={"tickCount": 5})
        for when, scale in scales.items()
    )
    about = names(*(name for name in ("scenario", "policy", "run") if name in frame.columns))
    about += [quantity("window", "after window"), *names("from", "to")]
    for when in ("predicted", "seen"):
        about += [
            quantity(f"{when}_{column}", f"{when}, {title}"),
            quantity(f"{when}_{error}", "standard error"),
        ]
    ends = [
        {"calculate": f"datum.{when}_{column} {sign} datum.{when}_{error}", "as": f"{when}_{end}"}
        for when in ("predicted", "seen")
        for end, sign in (("low", "-"), ("high", "+"))
    ]
    bars = [
        layer(
            "rule",
            {axis: f"{when}_low", f"{axis}2": f"{when}_high"},
            where=[f"isValid(datum.{when}_{error})"],
            strokeWidth=1.3,
            opacity=0.6,
            clip=True,
        )
        for axis, when in (("x", "seen"), ("y", "predicted"))
    ]
    colour = coloured("to", colours, legend={"symbolOpacity": 1})
    moves = {
        "transform": [
            {"filter": f"isValid(datum.predicted_{column}) && isValid(datum.seen_{column})"},
            *ends,
        ],
        "encoding": {"color": colour},
        "layer": [*bars, disc({"tooltip": about}, 26, opacity=0.9)],
    }
    both = {"x": {**across, "field": "at"}, "y": {**up, "field": "at"}}
    # The part of the line of equality that both ranges have.
    low = max(begin for begin, _ in ends_of.values())
    high = min(end for _, end in ends_of.values())
    diagonal = {
        "data": {"values": [{"at": low}, {"at": high}] if low < high else []},
        **layer("line", both, color=MUTED, strokeWidth=1),
    }
    limits = [limit if low <= limit.value <= high else NO_LIMIT for low, high in ends_of.values()]
    return square(side, across, up, limits, diagonal, moves)


def _range(frame: pl.DataFrame, when: str, column: str, error: str) -> tuple[float, float]:
    """Return the ends of an axis: the range of values and error bars, with a margin."""
    ends = [
        value + sign * (off or 0.0)
        for value, off in frame.select(f"{when}_{column}", f"{when}_{error}").rows()
        if value is not None
        for sign in (-1, 1)
    ]
    known = [end for end in ends if math.isfinite(end)] or [0.0]
    low, high = min(known), max(known)
    room = MARGIN * (high - low) or 1.0
    return max(low - room, 0.0), high + room


def _table(
    moves: pl.DataFrame, palette: Palette, about: Sequence[Text], group: Text | None
) -> Table:
    rows: list[Row] = []
    for move in moves.head(MOST_ROWS).iter_rows(named=True):
        row = dict(move)
        for metric, error in PREDICTED.items():
            column = metric.column
            for when in ("predicted", "seen"):
                value, off = move[f"{when}_{column}"], move[f"{when}_{error}"]
                if value is not None and off is not None:
                    row[f"{when}_{column}_low"] = value - off
                    row[f"{when}_{column}_high"] = value + off
        rows.append(row)
    columns: Columns = [
        *about,
        Text("window", "after window"),
        Text("from", "from", "placement"),
        Text("to", "to", "placement"),
        *(
            metric.called(f"{metric.name} {when}", f"{when}_{metric.column}")
            for metric in PREDICTED
            for when in ("predicted", "seen")
        ),
        Measure("windows", "windows seen"),
    ]
    return Table(
        "predicted-moves",
        f"Moves ({len(rows)} of {moves.height})",
        columns,
        rows,
        group,
        "±: standard error, where it is known; of what was seen, between windows. "
        f"{WITHOUT_WARMUP}",
        palette,
    )
