"""Timelines of runs: metrics by window, placements, moves and disturbances."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dwell.model.objective import AIM
from dwell.record import shown_reason
from dwell.record.moves import UNDECIDED
from dwell.report.charts import (
    coloured,
    disc,
    is_wide,
    latency_limit,
    layer,
    limit_rule,
    name_of,
    names,
    number_of,
    quantity,
)
from dwell.report.figure import Draw, Figure, Spec
from dwell.report.palette import BAD, INK, MUTED, SHADE, Palette
from dwell.study.metric import METRICS

if TYPE_CHECKING:
    import polars as pl
    from numpy.typing import NDArray

    from dwell.model import Problem
    from dwell.model.disturbed import Disturbed
    from dwell.record import FleetRun
    from dwell.report.run_header import Tracking

#: Largest number of windows with one mark each; marks in longer runs, each of several windows.
MOST_MARKS, MOST_BINS = 600, 120
#: Quantiles in a mark of several windows, by the ends of the names of its columns.
QUANTILES = {"median": 0.5, "min": 0.0, "q1": 0.25, "q3": 0.75, "max": 1.0}
A_WINDOW = "A mark is a window, in the colour of the placement that was active. "
A_BIN = (
    "A mark is several windows, as many as the axis says: a point at their median, a bar between "
    "their quartiles, a line between their extremes, in the colour of the placement that most of "
    "them had; of U, a line and bands. "
)
#: Distance of an outlier above the upper quartile, in distances between the quartiles.
FAR = 1.5
PANEL_PX, USE_PX = 86, 56
#: Height of the row of a cell, and largest height of all rows, pixels.
ROW_PX, ROWS_PX = 17, 640
DASHES: tuple[list[int], ...] = ([], [6, 3], [2, 2], [6, 2, 2, 2])
#: Scales that panels do not share.
OWN = ("color", "strokeDash")
RATE, L95 = METRICS["violation_rate"], METRICS["l95_ms"].called("L95 seen")
WARMUP, UNPROVEN = "warm-up", "clocks unproven"
AT = quantity("time", "at (s)", format=".1f")
#: Layer of every panel: shades for warm-up, unproven clocks and disturbances.
SHADES = layer(
    "rect",
    {
        "x": "begin",
        "x2": "end",
        "opacity": {"condition": {"test": f"datum.what === '{WARMUP}'", "value": 0.5}, "value": 1},
    },
    rows="spans",
    color=SHADE,
)


#: Layer of a mark at the top for every window with a lost L95.
LOST = layer(
    "point",
    {"y": {"value": 4}, "tooltip": [quantity("window", "window, L95 lost: from"), AT]},
    rows="windows",
    where=["datum.lost"],
    shape="triangle-up",
    filled=True,
    size=30,
    color=BAD,
)


def begins_by_number(windows: pl.DataFrame, period_ms: float) -> NDArray[np.float64]:
    """Return the beginning of every window in seconds, from the number of its first cycle."""
    begins: NDArray[np.float64] = windows["first_cycle"].to_numpy() * (period_ms / 1e3)
    return begins


def run_timeline(
    windows: pl.DataFrame,
    decisions: pl.DataFrame,
    begin_s: NDArray[np.float64],
    problem: Problem,
    *,
    slug: str,
    disturbed: Iterable[Disturbed] = (),
    tracking: Tracking | None = None,
    links: Mapping[int, str] | None = None,
    title: str = "",
    caption: str = "",
) -> Figure:
    """Draw violation rate, L95, J, utilisation and, if it is known, the tracking error.

    J of the active placement is measured; J of the others is the policy's estimate. `begin_s` has
    the beginning of each window. The figure cuts disturbances at the ends of the run. `links` maps
    numbers of windows to targets of links. The caption begins with a sentence on the marks; with
    an empty `caption` only marks of several windows have that sentence.
    """
    import polars as pl

    length_s = float(np.median(np.diff(begin_s))) if len(begin_s) > 1 else 1.0
    end_s = float(begin_s[-1]) + length_s
    limit, resources = latency_limit(problem), resources_in(windows, problem)
    placements = Palette.of(problem.candidates).placements
    each = 1 if windows.height <= MOST_MARKS else math.ceil(windows.height / MOST_BINS)
    frame = _seen(windows, begin_s + length_s / 2, problem.censor_ms, links or {})
    if tracking is not None:
        errors = [tracking.rms(begin, begin + length_s)[0] for begin in begin_s.tolist()]
        frame = frame.with_columns(error=pl.Series(errors, dtype=pl.Float64))
    timed = _timed(windows, decisions, begin_s, length_s / problem.window_cycles)
    frames = {
        "windows": _binned(frame, each),
        "estimates": _estimates(timed, [*placements], each),
        "moves": _moves(timed),
        "spans": _spans(windows, disturbed, begin_s, length_s, end_s),
        "nodes": _used(windows, begin_s + length_s / 2, resources, each),
    }
    limits = [limit.value] if math.isfinite(limit.value) else []
    wide = is_wide([*frame["l95"].drop_nulls().drop_nans(), *limits])
    aim, due = _aim(AIM), limit_rule("y", *limit)
    used = set(frame["placement"])
    colours = {name: colour for name, colour in placements.items() if name in used}
    rates = _marks("v_d", RATE.heading, colours, each, _range_of(frame["v_d"], 0.0, 100 * AIM))
    tail_ms = _range_of(frame["l95"], *limits)
    tails = _marks("l95", L95.heading, colours, each, tail_ms, log=wide)
    costs = _range_of(pl.concat([frame["j"], frames["estimates"]["j"]]))
    priced = [_others(placements, costs), *_marks("j", "J", placements, each, costs)]
    panels: list[tuple[float, list[Spec]]] = [
        (PANEL_PX, [*aim, *rates]),
        (PANEL_PX, [*due, *tails, LOST]),
        (PANEL_PX, priced),
        (USE_PX, _use(resources, each)),
    ]
    if tracking is not None:
        errors_mm = _range_of(frame["error"])
        panels.append((PANEL_PX, _marks("error", "tracking error (mm)", colours, each, errors_mm)))

    draw = _over_time(panels, end_s, each, frames["moves"].height)
    mark = A_BIN if each > 1 else A_WINDOW if caption else ""
    return Figure(slug, title, frames, draw, f"{mark}{caption}".strip())


def _range_of(values: pl.Series, *also: float) -> list[float]:
    """Return the ends of an axis for the finite values, and for `also`; some ends in any case."""
    known = values.drop_nulls().cast(float)
    found = [*known.filter(known.is_finite()), *also]
    low, high = (min(found), max(found)) if found else (0.0, 1.0)
    room = 0.04 * (high - low) or 0.04 * abs(high) or 1.0
    return [max(low - room, 0.0) if low >= 0 else low - room, high + room]


def _aim(share: float) -> list[Spec]:
    """Return the layer with the line of the aim for V_D."""
    return limit_rule("y", 100 * share, f"{100 * share:g} %")


def rows_px(cells: int) -> float:
    """Return the height in pixels of a panel with one row per cell."""
    return min(cells * ROW_PX, ROWS_PX)


def fleet_timeline(
    run: FleetRun,
    cells: Sequence[str],
    *,
    slug: str,
    colours: Mapping[str, str],
    disturbed: Iterable[Disturbed],
    caption: str,
) -> Figure:
    """Draw the placements of the cells of a fleet, their violation rates, and shared load.

    `cells` has the order of the rows, and `colours` the colours of all placements that were used.
    """
    import polars as pl

    problems = run.fleet.problems
    length_s = {name: one.window_ms / 1e3 for name, one in problems.items()}
    first, *_ = run.cells
    step_s = length_s[first]
    count = max(run.cells[name].windows.height for name in cells)
    each = 1 if count <= MOST_MARKS else math.ceil(count / MOST_BINS)
    placed, rates, moves = [], [], []
    for name in cells:
        windows = run.cells[name].windows
        begin_s = begins_by_number(windows, problems[name].pipeline.period_ms)
        frame = pl.DataFrame(
            {
                "cell": [name] * windows.height,
                "placement": windows["placement"].cast(pl.String),
                "begin": begin_s,
                "end": np.append(begin_s[1:], begin_s[-1:] + length_s[name]),
                "v_d": windows["violation_rate"] * 100,
            }
        )
        placed.append(_stays(frame))
        # A window after a move begins a little later than a multiple of the step.
        bins = ((pl.col("begin") / step_s).round() // each).alias("bin")
        rates.append(frame.group_by(bins).agg(pl.col("cell").first(), pl.col("v_d").mean()))
        cycle_s = problems[name].pipeline.period_ms / 1e3
        moved = _moves(_timed(windows, run.cells[name].decisions, begin_s, cycle_s))
        moves.append(moved.with_columns(move=pl.format("{}: {}", pl.lit(name), "move")))
    resources = [name[2:] for name in run.load.columns if name.startswith("u_")]
    load_s = (run.load["start_ns"] / 1e9 + step_s / 2).to_numpy()
    frames = {
        "placed": pl.concat(placed),
        # Until the first cell ends.
        "rates": _spread(pl.concat(rates), each * step_s).filter(
            pl.col("time") < min(stay["end"][-1] for stay in placed)
        ),
        "nodes": _used(run.load, load_s, resources, each),
        "moves": pl.concat(moves),
    }
    end_s = float(str(frames["placed"]["end"].max()))
    windows = run.cells[first].windows
    begin_s = begins_by_number(windows, problems[first].pipeline.period_ms)
    frames["spans"] = _spans(windows, disturbed, begin_s, step_s, end_s)
    panels: list[tuple[float, list[Spec]]] = [
        (rows_px(len(cells)), [_placed(cells, colours)]),
        (PANEL_PX, [*_aim(run.fleet.aim), *_rates()]),
    ]
    if resources:
        panels.append((USE_PX, _use(resources, each)))
    draw = _over_time(panels, end_s, each, frames["moves"].height)
    return Figure(slug, "", frames, draw, caption)


# -------------------------------------------------------------------------------------- data


def _seen(
    windows: pl.DataFrame,
    middle_s: NDArray[np.float64],
    censor_ms: float,
    links: Mapping[int, str],
) -> pl.DataFrame:
    """Return the metrics of windows, with one row per window; a lost L95 has no value."""
    import polars as pl

    frame = pl.DataFrame(
        {
            "window": windows["window"],
            "time": middle_s,
            "placement": windows["placement"].cast(pl.String),
            "v_d": windows["violation_rate"] * 100,
            "l95": windows["seen_l95_ms"],
            "lost": windows["seen_l95_ms"] >= censor_ms,
            "j": windows["cost"],
            "link": [links.get(number) for number in windows["window"].to_list()],
        },
        strict=False,
    )
    known = pl.when(pl.col("lost").not_()).then(pl.col("l95"))
    return frame.with_columns(link=pl.col("link").cast(pl.String), l95=known)


def _binned(frame: pl.DataFrame, each: int, by: Sequence[str] = ()) -> pl.DataFrame:
    """Return one row per mark: a window, or `each` windows with the quantiles of every measure.

    `frame` has one row per window and value of `by`.
    """
    import polars as pl

    if each == 1:
        return frame
    numbers = [name for name, kind in frame.schema.items() if kind.is_float() and name != "time"]
    firsts = [pl.col("window").first(), pl.len().alias("windows"), pl.col("time").mean()]
    if "lost" in frame.columns:
        firsts.append(pl.col("lost").any())
    if "placement" in frame.columns and "placement" not in by:
        firsts.append(pl.col("placement").mode(maintain_order=True).first())
    if "link" in frame.columns:
        firsts.append(pl.col("link").drop_nulls().first())
    quantiles = [
        pl.col(name).quantile(share, "linear").alias(f"{name}_{end}")
        for name in numbers
        for end, share in QUANTILES.items()
    ]
    bins = frame.with_columns(bin=(pl.col("window").rank("dense") - 1) // each)
    return bins.group_by("bin", *by, maintain_order=True).agg(*firsts, *quantiles).drop("bin")


def _stays(frame: pl.DataFrame) -> pl.DataFrame:
    """Return the stays of a cell at its placements from a frame with one row per window."""
    import polars as pl

    stays = frame.group_by(pl.col("placement").rle_id().alias("stay"), maintain_order=True)
    first = pl.col("cell", "placement", "begin").first()
    return stays.agg(first, pl.col("end").last(), pl.col("v_d").mean()).drop("stay")


def _spread(rates: pl.DataFrame, step_s: float) -> pl.DataFrame:
    """Return mean, quartiles and largest V_D of cells, from one row per cell and stretch of time.

    `outlier` has the name of the worst cell if it is far above the quartiles: by more than 1.5
    times their distance.
    """
    import polars as pl

    rate = pl.col("v_d")
    spread = {
        "q1": rate.quantile(0.25, "linear"),
        "mean": rate.mean(),
        "median": rate.median(),
        "q3": rate.quantile(0.75, "linear"),
        "max": rate.max(),
    }
    by_bin = rates.sort("v_d", descending=True).group_by("bin", maintain_order=True)
    found = by_bin.agg(worst=pl.col("cell").first(), **spread)
    far = pl.col("max") > pl.col("q3") + FAR * (pl.col("q3") - pl.col("q1"))
    return found.with_columns(
        time=(pl.col("bin") + 0.5) * step_s,
        outlier=pl.when(far & (pl.col("max") > pl.col("q3"))).then(pl.col("worst")),
    ).sort("bin")


def resources_in(windows: pl.DataFrame, problem: Problem) -> tuple[str, ...]:
    """Return the names of all nodes and of the accelerators with a measured utilisation."""
    return tuple(
        name
        for name, one in problem.fabric.resources.items()
        if not one.kind or windows[f"u_{name}"].null_count() < windows.height
    )


def _used(
    windows: pl.DataFrame, middle_s: NDArray[np.float64], resources: Sequence[str], each: int
) -> pl.DataFrame:
    """Return the utilisation in percent, with one row per resource and mark."""
    import polars as pl

    frame = pl.DataFrame(
        {
            "window": windows["window"],
            "time": middle_s,
            **{name: windows[f"u_{name}"].cast(pl.Float64) * 100 for name in resources},
        }
    )
    long = frame.unpivot(
        list(resources), index=["time", "window"], variable_name="node", value_name="used"
    )
    return _binned(long, each, ["node"])


def _estimates(timed: pl.DataFrame, candidates: Sequence[str], each: int) -> pl.DataFrame:
    """Return the estimates of J of inactive candidates; the median for several windows."""
    import polars as pl

    priced = timed.filter(~pl.col("reason").cast(pl.String).is_in(UNDECIDED))
    parts = [
        priced.select(
            "time",
            pl.lit(name).alias("placement"),
            pl.when(pl.col("incumbent").cast(pl.String) != name)
            .then(pl.col(f"j_{name}"))
            .alias("j"),
        )
        for name in candidates
    ]
    found = pl.concat(parts)
    if each == 1:
        return found
    bins = found.with_columns(bin=(pl.col("time").rank("dense") - 1) // each)
    means = bins.group_by("bin", "placement", maintain_order=True)
    return means.agg(pl.col("time").mean(), pl.col("j").median()).select(found.columns)


def _timed(
    windows: pl.DataFrame, decisions: pl.DataFrame, begin_s: NDArray[np.float64], cycle_s: float
) -> pl.DataFrame:
    """Return the decisions with the `time` (seconds) of the end of the last evaluated cycle."""
    import polars as pl

    columns = {"window": windows["window"], "first": windows["first_cycle"], "begin": begin_s}
    after = (pl.col("last_cycle") + 1 - pl.col("first")) * cycle_s
    joined = decisions.join(pl.DataFrame(columns), on="window", maintain_order="left")
    return joined.with_columns(time=pl.col("begin") + after)


def _moves(timed: pl.DataFrame) -> pl.DataFrame:
    """Return the times and reasons of the moves among decisions with times."""
    import polars as pl

    return timed.filter("migrated").select(
        "time",
        pl.format("{} → {}", "incumbent", "placement").alias("move"),
        pl.col("reason").cast(pl.String).map_elements(shown_reason, return_dtype=pl.String),
    )


def _spans(
    windows: pl.DataFrame,
    disturbed: Iterable[Disturbed],
    begin_s: NDArray[np.float64],
    length_s: float,
    end_s: float,
) -> pl.DataFrame:
    """Return the times of warm-up, unproven clocks and disturbances, cut at the run's ends."""
    import polars as pl

    rows = []
    warm = windows["warmup"].to_numpy()
    if warm.any():
        rows.append((WARMUP, 0.0, float(begin_s[warm][-1]) + length_s))
    if "unproven" in windows.columns:
        unproven = windows["unproven"].fill_null(value=False).to_numpy()
        edges = np.flatnonzero(np.diff(np.concatenate(([False], unproven, [False])).astype(int)))
        ends = np.append(begin_s, end_s)
        rows += [(UNPROVEN, ends[low], ends[high]) for low, high in edges.reshape(-1, 2)]
    for item in disturbed:
        low, high = max(item.begin_s, 0.0), min(item.end_s, end_s)
        if low < high:
            rows.append((item.what, low, high))
    schema = {"what": pl.String, "begin": pl.Float64, "end": pl.Float64}
    return pl.DataFrame(rows, schema=schema, orient="row")


# ---------------------------------------------------------------------------------- drawings


def _over_time(
    panels: Sequence[tuple[float, list[Spec]]], end_s: float, each: int, moves: int
) -> Draw:
    """Draw panels below each other on one axis of time, with disturbances and moves.

    A panel is its height in pixels and its layers; `each` is the number of windows per mark.
    """
    time: Spec = {"type": "quantitative", "scale": {"domain": [0, end_s], "nice": False}}
    # Figures for a paper have no caption, so the axis explains the marks.
    across = "time (s)"
    if each > 1:
        across += f"; a mark: median, quartiles, extremes of {each} windows"
    axes = [*[None] * (len(panels) - 1), {"title": across, "grid": False, "tickCount": 10}]

    def draw(width: float) -> Spec:
        drawn = [
            {
                "width": width - 90,
                "height": height,
                "encoding": {"x": {"field": "time", **time, "axis": axis}},
                "layer": [SHADES, *layers, _migrations(moves)],
            }
            for (height, layers), axis in zip(panels, axes, strict=True)
        ]
        return {
            "vconcat": [_named_spans(width - 90, time), *drawn],
            "spacing": 8,
            "resolve": {"scale": {"x": "shared", **dict.fromkeys(OWN, "independent")}},
        }

    return draw


def _named_spans(width: float, time: Spec) -> Spec:
    """Return a panel with one row per kind of span: warm-up, unproven clocks, disturbances."""
    encoding = {
        "x": {"field": "begin", **time, "axis": None},
        "x2": "end",
        "y": name_of("what", sort=None, axis={"domain": False, "ticks": False}),
        "tooltip": [
            *names("what"),
            quantity("begin", "from (s)", format=".1f"),
            quantity("end", "to (s)", format=".1f"),
        ],
    }
    bars = layer("bar", encoding, rows="spans", height=4, color=MUTED, cornerRadius=2)
    return {"width": width, "height": {"step": 15}, **bars}


def _migrations(count: int) -> Spec:
    """Return vertical lines at migrations, fainter for many migrations."""
    encoding = {
        "color": {"condition": {"test": "datum.reason === 'guard'", "value": BAD}, "value": INK},
        "opacity": {"value": min(0.35, 35 / max(count, 1))},
        "tooltip": [name_of("move", title="moved"), *names("reason"), AT],
    }
    return layer("rule", encoding, rows="moves", strokeWidth=0.7)


def _marks(
    field: str,
    title: str,
    colours: Mapping[str, str],
    each: int,
    ends: Sequence[float],
    *,
    log: bool = False,
) -> list[Spec]:
    """Return the marks of a panel, one per `each` windows; `ends` are the ends of its y axis."""
    scale: Spec = {"domain": [*ends], "nice": False, "zero": False}
    if log:
        scale |= {"type": "log", "domain": [max(ends[0], ends[1] * 1e-4), ends[1]]}
    legend = {"symbolSize": 60, "symbolOpacity": 0.9} if field == "v_d" else None
    shown = field if each == 1 else f"{field}_median"
    colour = coloured("placement", colours, legend=legend)
    about = [quantity("window", "window"), AT, *names("placement")]
    if each == 1:
        about.append(quantity(field, title))
    else:
        about.append(quantity("windows", "windows"))
        about += [quantity(f"{field}_{end}", f"{title}, {end}") for end in QUANTILES]
    point = {
        "y": quantity(shown, title, scale=scale, axis={"tickCount": 4}),
        "color": colour,
        # An empty link would leave the page.
        "href": {"condition": {"test": "datum.link !== null", "field": "link"}},
        "tooltip": about,
    }
    # Points of bins are small: figures for a paper are narrow.
    size = 18 if each == 1 else 8
    marks = [disc(point, size, rows="windows", opacity=0.9)]
    if each == 1:
        return marks
    bars = [
        layer(
            "rule",
            {
                "y": quantity(f"{field}_{low}", title, scale=scale, axis={"tickCount": 4}),
                "y2": f"{field}_{high}",
                "color": colour,
            },
            rows="windows",
            strokeWidth=wide,
            opacity=opacity,
        )
        for low, high, wide, opacity in (("min", "max", 0.6, 0.5), ("q1", "q3", 2.4, 0.5))
    ]
    return [*bars, *marks]


def _placed(cells: Sequence[str], colours: Mapping[str, str]) -> Spec:
    """Return the layer of the stays of cells at their placements, one row per cell."""
    encoding = {
        "x": "begin",
        "x2": "end",
        "y": name_of("cell", sort=list(cells), axis={"labelOverlap": True}),
        "color": coloured("placement", colours, legend={"symbolType": "square"}),
        "tooltip": [
            *names("cell", "placement"),
            quantity("begin", "from (s)", format=".1f"),
            quantity("end", "to (s)", format=".1f"),
            number_of("v_d", RATE),
        ],
    }
    return layer("rect", encoding, rows="placed", height={"band": 0.8})


def _rates() -> list[Spec]:
    """Return the layers of the median of V_D over cells, of its quartiles, and of outliers."""
    about = [AT, *names("worst")]
    about += [number_of(how, RATE.called(how)) for how in ("max", "q3", "median", "mean", "q1")]
    up = {"y": quantity("median", RATE.heading, axis={"tickCount": 4})}
    band = {"y": quantity("q1", RATE.heading), "y2": "q3"}
    outlier = {"y": quantity("max", RATE.heading), "tooltip": about}
    return [
        layer("area", band, rows="rates", color=MUTED, opacity=0.45),
        layer("line", up, rows="rates", color=INK, strokeWidth=1.1),
        layer("point", {**up, "tooltip": about}, rows="rates", filled=True, size=8, color=INK),
        layer("point", outlier, rows="rates", where=["isValid(datum.outlier)"], size=14, color=BAD),
    ]


def _others(colours: Mapping[str, str], ends: Sequence[float]) -> Spec:
    scale = {"domain": [*ends], "nice": False, "zero": False}
    encoding = {
        "y": quantity("j", "J", scale=scale, axis={"tickCount": 4}),
        "color": coloured("placement", colours, legend=None),
    }
    return layer("line", encoding, rows="estimates", strokeWidth=1, opacity=0.75)


def _use(resources: Sequence[str], each: int) -> list[Spec]:
    """Return one line per resource, with bands of quartiles and extremes for several windows."""
    shades = {name: (INK, MUTED)[place % 2] for place, name in enumerate(resources)}
    dashes = [DASHES[place % len(DASHES)] for place in range(len(resources))]
    axis, scale = {"values": [0, 50, 100]}, {"domain": [0, 104]}

    def up(end: str) -> Spec:
        return quantity(f"used{end}", "U (%)", scale=scale, axis=axis)

    legend = {"symbolType": "stroke", "symbolOpacity": 1}
    colour = coloured("node", shades, **({} if each == 1 else {"legend": legend}))
    line = {
        "y": up("" if each == 1 else "_median"),
        "color": colour,
        "strokeDash": name_of("node", scale={"domain": list(resources), "range": dashes}),
    }
    lines = layer("line", line, rows="nodes", strokeWidth=1.1)
    if each == 1:
        return [lines]
    bands = [
        layer(
            "area",
            {"y": up(low), "y2": f"used{high}", "color": colour},
            rows="nodes",
            opacity=opacity,
        )
        for low, high, opacity in (("_min", "_max", 0.12), ("_q1", "_q3", 0.25))
    ]
    return [*bands, lines]
