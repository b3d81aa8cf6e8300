"""Charts of several pages, drawn from data frames with Vega-Lite.

Every chart names its limit (a deadline, the aim of 5 %), shows intervals if they are known, and
describes each mark under the pointer.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dwell.report.figure import Draw, Spec
from dwell.report.palette import INK, MUTED, PARTS, Style

if TYPE_CHECKING:
    import polars as pl

    from dwell.display import Measure
    from dwell.model import Problem

#: Names of the parts of a latency, and their colours by name.
PARTS_SHOWN = {"compute": "computing", "queue": "waiting", "network": "network"}
PART_COLOURS = {PARTS_SHOWN[part]: colour for part, colour in PARTS.items()}
#: Ratio of the largest to the smallest number above which an axis is logarithmic.
WIDE = 30.0
#: Least width of a panel; room for names of rows, for an axis of numbers, and between panels;
#: pixels.
PANEL_PX, NAMES_PX, AXIS_PX, GAP_PX = 170, 150, 60, 16
ROW_PX = 17
#: Largest number of values of a parameter for which grid lines are drawn.
MOST_LINES = 20
#: Width of a symbol of a legend with its margins, and of a letter.
SYMBOL_PX, LETTER_PX = 34, 6.2
#: Smallest share of cycles on the axis of a distribution.
LEAST_SHARE = 1e-4
#: Outline of bars, whose fills may have little contrast with the paper.
OUTLINE: dict[str, Any] = {"stroke": MUTED, "strokeWidth": 0.6}
#: Vega tests of a row: its policy is chosen by the reader; its interval is known.
CHOSEN = "indexof(policies, datum.policy) >= 0"
BOUNDED = "isValid(datum.low) && isValid(datum.high)"


class Limit(NamedTuple):
    """Value of a line on an axis, in the shown unit, and its name; no line if infinite."""

    value: float
    name: str


NO_LIMIT = Limit(math.inf, "")


def latency_limit(problem: Problem) -> Limit:
    """Return the limit of L95 in J: D, or `max_age_ms` of the chain in ``objective.latency``."""
    if (chain := problem.latency_chain) is not None:
        return Limit(chain.max_age_ms, "age limit")
    return Limit(problem.pipeline.deadline_ms, "deadline")


def quantity(field: str, title: str | None, **more: Any) -> Spec:
    """Return the encoding of a number; `more` are properties of Vega-Lite, such as ``scale``."""
    return {"field": field, "type": "quantitative", "title": title, **more}


def number_of(field: str, measure: Measure) -> Spec:
    """Return the encoding of a measure in a tooltip; `field` is in the shown unit."""
    more = {"format": f".{measure.decimals}f"} if measure.fixed else {}
    return quantity(field, measure.heading, **more)


def name_of(field: str, **more: Any) -> Spec:
    """Return the encoding of a name, without a title."""
    return {"field": field, "type": "nominal", "title": None, **more}


def names(*fields: str) -> list[Spec]:
    """Return the encodings of several names for a tooltip."""
    return [name_of(field, title=field) for field in fields]


def coloured(field: str, colours: Mapping[str, str], **more: Any) -> Spec:
    """Return the encoding of a name as a colour; `colours` maps names to colours."""
    return name_of(field, scale={"domain": list(colours), "range": list(colours.values())}, **more)


def layer(
    mark: str,
    encoding: Mapping[str, Any],
    *,
    rows: str = "",
    where: Sequence[str] = (),
    **style: Any,
) -> Spec:
    """Return a layer of a chart.

    `encoding` is the layer's own; a text in it names a field. `rows` names other data than the
    chart's, `where` lists tests of rows as Vega expressions, and `style` has properties of the
    mark.
    """
    fields = {
        channel: {"field": one} if isinstance(one, str) else one
        for channel, one in encoding.items()
    }
    drawn: Spec = {"mark": {"type": mark, **style}, "encoding": fields}
    if rows:
        drawn["data"] = {"name": rows}
    if where:
        drawn["transform"] = [{"filter": test} for test in where]
    return drawn


def disc(encoding: Mapping[str, Any], size: float, **more: Any) -> Spec:
    """Return a layer of filled points; `more` are further arguments of `layer`."""
    return layer("point", encoding, **{"filled": True, "size": size, "opacity": 1, **more})


def styled(styles: Mapping[str, Style], width: float = 0.0) -> dict[str, Spec]:
    """Return the encodings of colour, dashes and marker of named series.

    The names are values of the column ``policy``. `width` is the width of the legend in pixels; 0
    leaves the legend out.
    """
    each = SYMBOL_PX + LETTER_PX * max(map(len, styles), default=0)
    shown = {"columns": max(1, int(width / each)), "symbolSize": 60} if width else None
    channels = {
        "color": [one.colour for one in styles.values()],
        "shape": [one.marker for one in styles.values()],
        "strokeDash": [list(one.dashes) for one in styles.values()],
    }
    return {
        channel: name_of("policy", scale={"domain": list(styles), "range": values}, legend=shown)
        for channel, values in channels.items()
    }


def limit_rule(axis: str, limit: float, name: str, **style: Any) -> list[Spec]:
    """Return the layer with the line of a limit on an axis; no layer if it is infinite."""
    if not math.isfinite(limit):
        return []
    style = {"color": INK, "strokeDash": [4, 3], "strokeWidth": 1, "tooltip": name, **style}
    other, end = ("y", "height") if axis == "x" else ("x", "width")
    along = {other: {"value": 0}, f"{other}2": {"value": end}}
    # Separate data of one row: the chart's data would draw the line once per row.
    rule = layer("rule", {axis: {"datum": limit}, **along}, **style)
    return [{"data": {"values": [{}]}, **rule}]


def square(
    side: float,
    across: Spec,
    up: Spec,
    limits: Sequence[Limit],
    beneath: Spec,
    marks: Mapping[str, Any],
) -> Spec:
    """Return a square panel with the same quantity on both axes, and a limit for each.

    `beneath` is a layer below the marks, with its data; `marks` is a group of layers over the
    chart's rows, without the encodings of the two axes.
    """
    axes = zip(("x", "y"), limits, strict=True)
    rules = [rule for axis, limit in axes for rule in limit_rule(axis, *limit)]
    encoding = {"x": across, "y": up, **marks["encoding"]}
    group = {"data": {"name": "rows"}, **marks, "encoding": encoding}
    return {"width": side, "height": side, "layer": [beneath, *rules, group]}


def is_wide(values: Sequence[float]) -> bool:
    """Whether positive numbers differ by more than the factor `WIDE`: use a logarithmic axis."""
    known = [value for value in values if math.isfinite(value) and value > 0]
    return len(known) > 1 and max(known) / min(known) > WIDE


def thinned(count: int, points: int = 200) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the indices of `count` sorted values to draw, denser towards the end."""
    if not count:
        return np.zeros(0, np.int64)
    from_end = np.unique(np.rint(np.geomspace(1, count, min(count, points))).astype(np.int64))
    return (count - from_end)[::-1]


def intervals(
    frame: pl.DataFrame, measure: Measure, styles: Mapping[str, Style], limit: Limit = NO_LIMIT
) -> Draw:
    """Draw a measure of policies, one panel per scenario: means with intervals, and every seed.

    `frame` has the columns ``scenario``, ``policy``, ``mean``, ``low``, ``high``, ``seed`` and
    ``value``, in the shown unit of the measure. Each policy has one row with a mean, and one row
    with a value per seed. `styles` lists the policies in the order of the rows of the chart.
    """
    shown = [frame[name].drop_nulls().to_list() for name in ("value", "mean", "low")]
    scale: Spec = {"nice": True}
    # Utilisations have a linear axis: readers compare their differences, not their ratios.
    if is_wide([*shown[0], *shown[1]]) and not measure.column.startswith("u_"):
        # An interval may extend below the values of all runs.
        zero = min(itertools.chain(*shown)) <= 0
        scale = {"type": "symlog", "constant": 1} if zero else {"type": "log"}
    ticks = {"tickCount": 4, "labelOverlap": "greedy", "labelSeparation": 4}
    colours = styled(styles)
    shared = {
        "x": quantity("mean", measure.heading, scale=scale, axis=ticks),
        "y": name_of("policy", sort=list(styles)),
        "color": colours["color"],
    }
    about = names("policy", "scenario")
    seed = {
        "x": "value",
        "opacity": {"condition": {"test": "seed === datum.seed", "value": 1}, "value": 0.22},
        "tooltip": [*about, quantity("seed", "seed"), number_of("value", measure)],
    }
    mean = {"shape": colours["shape"], "tooltip": [*about, *_mean_and_ends(measure)]}
    marks = [
        layer("tick", seed, where=[CHOSEN, "isValid(datum.value)"], thickness=1.2, size=9),
        layer("rule", {"x": "low", "x2": "high"}, where=[CHOSEN, BOUNDED], strokeWidth=2),
        disc(mean, 55, where=[CHOSEN, "isValid(datum.mean)"]),
    ]
    layers = [*limit_rule("x", *limit), {"encoding": shared, "layer": marks}]
    return _panels(frame, list(styles), lambda _: layers, seeds=True)


def stacked(
    frame: pl.DataFrame,
    policies: Sequence[str],
    parts: Mapping[str, str],
    heading: str,
    limit: Limit = NO_LIMIT,
) -> Draw:
    """Draw stacked bars, one row per policy and one panel per scenario.

    `frame` has the columns ``scenario``, ``policy``, ``part`` and ``value``. `policies` has the
    order of the rows, and `parts` the colours in the order of the bars. `heading` is the heading
    of the axis, with its unit.
    """
    encoding = {
        "x": quantity("value", heading, stack="zero", axis={"tickCount": 4}),
        "y": name_of("policy", sort=list(policies)),
        "color": coloured("part", parts, legend={"symbolType": "square"}),
        "tooltip": [*names("policy", "part"), quantity("value", heading)],
    }
    bars = layer("bar", encoding, where=[CHOSEN], height={"band": 0.7}, **OUTLINE)
    bars = in_order(bars, parts)
    return _panels(frame, policies, lambda _: [bars, *limit_rule("x", *limit)])


def in_order(bars: Spec, parts: Mapping[str, str]) -> Spec:
    """Return a layer of bars with their parts stacked in the order of `parts`."""
    place = {"calculate": f"indexof({list(parts)!r}, datum.part)", "as": "place"}
    order = {"field": "place", "type": "quantitative"}
    return {
        **bars,
        "transform": [*bars.get("transform", ()), place],
        "encoding": {**bars["encoding"], "order": order},
    }


def distributions(frame: pl.DataFrame, styles: Mapping[str, Style], deadline_ms: float) -> Draw:
    """Draw the share of cycles that took longer than a latency, one panel per scenario.

    `frame` has the columns ``scenario``, ``policy``, ``latency_ms`` and ``longer``, a share; 0 is
    at the end of the axis.
    """
    up = quantity(
        "longer",
        "cycles that took longer",
        scale={"type": "log", "domain": [LEAST_SHARE, 1], "clamp": True},
        axis={"values": [1, 0.1, 0.01, 0.001, LEAST_SHARE], "format": "~%"},
    )
    # Without any finished cycle the axis has no values of its own.
    scale = {"domain": [0, 2 * deadline_ms]} if frame.is_empty() else {}
    across = quantity("latency_ms", "latency (ms)", scale=scale, axis={"tickCount": 5})
    rules = [
        *limit_rule("x", deadline_ms, "deadline"),
        *limit_rule("y", 0.05, "5 %", color=MUTED, strokeDash=[1, 3]),
    ]
    return _steps(frame, styles, across, up, rules, what="policy", tallest_px=180)


def cumulative(
    frame: pl.DataFrame,
    styles: Mapping[str, Style],
    headings: tuple[str, str],
    limit: Limit = NO_LIMIT,
) -> Draw:
    """Draw empirical distributions, one line per policy and one panel per scenario.

    `frame` has the columns ``scenario``, ``policy``, ``value`` and ``share``, the share at or
    below the value. `headings` are the headings of values and shares.
    """
    across = quantity("value", headings[0], axis={"tickCount": 4})
    up = quantity("share", headings[1], axis={"format": "~%", "tickCount": 4})
    rules = limit_rule("x", *limit)
    return _steps(frame, styles, across, up, rules, what="line", tallest_px=150)


def _steps(
    frame: pl.DataFrame,
    styles: Mapping[str, Style],
    across: Spec,
    up: Spec,
    rules: Sequence[Spec],
    *,
    what: str,
    tallest_px: int,
) -> Draw:
    """Draw distributions with a step at each value; `what` is the tooltip's title of a line."""
    about = [
        name_of("policy", title=what),
        quantity(across["field"], across["title"]),
        quantity(up["field"], up["field"], format=".3~%"),
    ]

    def layers(width: float) -> list[Spec]:
        look = styled(styles, width)
        line = {"x": across, "y": up, **_of(look, "color", "strokeDash"), "tooltip": about}
        style: Spec = {"interpolate": "step-after", "strokeWidth": 1.5, "clip": True}
        return [layer("line", line, where=[CHOSEN], **style), *rules]

    return _panels(frame, list(styles), layers, tallest_px)


def curves(
    frame: pl.DataFrame,
    measure: Measure,
    styles: Mapping[str, Style],
    heading: str,
    limit: Limit = NO_LIMIT,
    remark: str = "",
) -> Draw:
    """Draw a measure over a parameter, one line per policy and one panel per scenario.

    `frame` has the columns ``scenario``, ``policy``, ``at`` (values of the parameter, texts or
    numbers), ``mean``, ``low`` and ``high``, in the shown unit of the measure. With a column
    ``panel`` each pair of scenario and panel has a panel. `heading` is the heading of the
    parameter; `remark` is a title above the panels.
    """
    numeric = frame["at"].dtype.is_numeric()
    values = frame["at"].unique(maintain_order=True).to_list()
    at = {"field": "at", "type": "quantitative" if numeric else "ordinal", "title": heading}
    axis = {"values": values, "labelOverlap": True, "labelSeparation": 4, "labelAngle": 0}
    axis["grid"] = numeric and len(values) <= MOST_LINES
    across: Spec = {**at, "axis": axis, "sort": None}
    if numeric:
        # Evenly spaced values, such as numbers of robots, have a linear axis.
        wide = min(values) > 0 and is_wide(values) and np.ptp(np.diff(values)) > 0
        scale = "log" if wide else "linear"
        across |= {
            "scale": {"type": scale, "zero": False, "padding": 6},
            "axis": {**axis, "format": ".6~g"},
        }
    up = quantity("mean", measure.heading, axis={"tickCount": 5})
    about = [*names("policy"), at, *_mean_and_ends(measure)]

    def layers(width: float) -> list[Spec]:
        look = styled(styles, width)
        point = {**_of(look, "shape"), "tooltip": about}
        marks = [
            layer("rule", {"y": "low", "y2": "high"}, where=[CHOSEN, BOUNDED], strokeWidth=1.3),
            layer("line", _of(look, "strokeDash"), where=[CHOSEN], strokeWidth=1.3),
            disc(point, 40, where=[CHOSEN, "isValid(datum.mean)"]),
        ]
        shared = {"x": across, "y": up, **_of(look, "color")}
        return [*limit_rule("y", *limit), {"encoding": shared, "layer": marks}]

    return _panels(frame, list(styles), layers, 170, most=3, remark=remark)


def _mean_and_ends(measure: Measure) -> list[Spec]:
    ends = (measure.called(name) for name in ("from", "to"))
    return [number_of("mean", measure), *map(number_of, ("low", "high"), ends)]


def _of(look: Mapping[str, Spec], *channels: str) -> dict[str, Spec]:
    return {channel: look[channel] for channel in channels}


def _with_short_title(layers: Spec, width: float) -> Spec:
    """Return a layer, or a group, whose title of the axis of values has lines of a panel's width.

    Titles of neighbouring panels would overlap otherwise.
    """
    encoding = layers.get("encoding", {})
    title = encoding.get("x", {}).get("title")
    if not isinstance(title, str):
        return layers
    lines = textwrap.wrap(title, max(int(width / LETTER_PX), 8)) or [""]
    short = lines[0] if len(lines) == 1 else lines
    return {**layers, "encoding": {**encoding, "x": {**encoding["x"], "title": short}}}


def _panels(
    frame: pl.DataFrame,
    policies: Sequence[str],
    layers: Callable[[float], list[Spec]],
    tallest_px: int | None = None,
    *,
    most: int = 4,
    seeds: bool = False,
    remark: str = "",
) -> Draw:
    """Draw layers in panels by the columns ``scenario`` and ``panel`` of the frame.

    The heading of a panel has the values that differ between panels. `layers` takes the width of
    the chart in pixels. `tallest_px` is the largest height of a panel; without it a panel has one
    row per policy. A row has at most `most` panels. `seeds` lets a reader choose a seed.
    """
    given = [name for name in ("scenario", "panel") if name in frame.columns]
    values = {name: frame[name].unique(maintain_order=True).to_list() for name in given}
    varying = [name for name in given if len(values[name]) > 1]
    facets = ["\n".join(one) for one in itertools.product(*(values[name] for name in varying))]
    heading = " + '\\n' + ".join(f"datum.{name}" for name in varying)
    params: list[Spec] = [{"name": "policies", "value": list(policies)}]
    if seeds:
        params.append({"name": "seed", "value": None})

    def draw(width: float) -> Spec:
        room_px = width - (NAMES_PX if tallest_px is None else AXIS_PX)
        fitting = max(1, min(most, len(facets), int((room_px + GAP_PX) // (PANEL_PX + GAP_PX))))
        panels = len(values.get("panel", ()))
        # If possible, each scenario begins a row, or several scenarios fill it.
        whole_rows = (n for n in range(fitting, 1, -1) if not (panels % n and n % panels))
        columns = next(whole_rows, fitting)
        across_px = max(60, int((room_px - (columns - 1) * GAP_PX) / columns))
        height_px = ROW_PX * max(len(policies), 1)
        if tallest_px is not None:
            height_px = min(tallest_px, round(0.6 * across_px))
        drawn = [_with_short_title(one, across_px) for one in layers(width)]
        spec: Spec = {"width": across_px, "height": height_px, "layer": drawn}
        if len(facets) > 1:
            header = {"labelLimit": across_px + GAP_PX, "labelExpr": "split(datum.value, '\\n')"}
            spec = {
                "transform": [{"calculate": heading, "as": "facet"}],
                "facet": name_of("facet", sort=facets, header=header),
                "columns": columns,
                "spacing": {"row": 14, "column": GAP_PX},
                "spec": spec,
            }
        above = {"title": remark} if remark else {}
        return {"data": {"name": "rows"}, **above, **spec, "params": params}

    return draw
