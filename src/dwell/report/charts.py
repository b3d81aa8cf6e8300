"""Charts: what several pages draw, from data frames, as Vega-Lite.

Every chart names its limit (a deadline, the aim of 5 %), shows intervals where there are any, and
says under the pointer what a mark stands for.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dwell.report.figure import Figure, Spec
from dwell.report.palette import INK, MUTED, PARTS, Style

if TYPE_CHECKING:
    import polars as pl

    from dwell.report.formatting import Measure

#: Names of the parts of a latency, and their colours by these.
PARTS_SHOWN = {"compute": "computing", "queue": "waiting", "network": "network"}
PART_COLOURS = {PARTS_SHOWN[part]: colour for part, colour in PARTS.items()}
#: Factor between numbers above which an axis is logarithmic.
WIDE = 30.0
#: Least width of a panel, and what a panel of named rows has beside it, pixels.
PANEL_PX, NAMES_PX, GAP_PX = 170, 150, 16
ROW_PX = 17
#: Width of a legend's symbol with what is beside it, and of a letter.
SYMBOL_PX, LETTER_PX = 34, 6.2
#: Share of cycles below which a distribution is not drawn.
LEAST_SHARE = 1e-4


class Limit(NamedTuple):
    """A line on an axis, in the unit that is shown, and its name; none where it is infinite."""

    value: float
    name: str


NO_LIMIT = Limit(math.inf, "")


def quantity(field: str, title: str | None, **more: Any) -> Spec:
    """Return the encoding of a number; ``scale`` and other properties as Vega-Lite has them."""
    return {"field": field, "type": "quantitative", "title": title, **more}


def name_of(field: str, **more: Any) -> Spec:
    """Return the encoding of a name, without a title."""
    return {"field": field, "type": "nominal", "title": None, **more}


def styled(styles: Mapping[str, Style], width: float = 0.0) -> dict[str, Spec]:
    """Return the encodings of colour, dashes and marker of named series.

    Parameters
    ----------
    styles : mapping of str to Style
        By the names that the data have in the column ``policy``.
    width : float
        Of their legend, pixels; none where it is 0.
    """
    names = list(styles)
    each = SYMBOL_PX + LETTER_PX * max(map(len, names), default=0)
    shown = {"columns": max(1, int(width / each)), "symbolSize": 60} if width else None

    def scale(values: Sequence[Any]) -> Spec:
        return {"domain": names, "range": list(values)}

    def encoded(values: Sequence[Any]) -> Spec:
        return name_of("policy", scale=scale(values), legend=shown)

    return {
        "color": encoded([one.colour for one in styles.values()]),
        "shape": encoded([one.marker for one in styles.values()]),
        "strokeDash": encoded([list(one.dashes) for one in styles.values()]),
    }


def limit_rule(axis: str, limit: float, name: str) -> list[Spec]:
    """Return the line of a limit on an axis, and its name; nothing where it is infinite."""
    if not math.isfinite(limit):
        return []
    rule = {"type": "rule", "color": INK, "strokeDash": [4, 3], "strokeWidth": 1}
    # Data of its own: one line, and not one for every row of the chart's.
    once: Spec = {"values": [{}]}
    return [{"data": once, "mark": {**rule, "tooltip": name}, "encoding": {axis: {"datum": limit}}}]


def is_wide(values: Sequence[float]) -> bool:
    """Whether numbers are so far apart that an axis has to be logarithmic."""
    known = [value for value in values if math.isfinite(value) and value > 0]
    return len(known) > 1 and max(known) / min(known) > WIDE


def thinned(count: int, points: int = 200) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return which of `count` sorted values to draw: the nearer to the tail, the more of them."""
    if not count:
        return np.zeros(0, np.int64)
    from_end = np.unique(np.rint(np.geomspace(1, count, min(count, points))).astype(np.int64))
    return (count - from_end)[::-1]


def panels(width: float, count: int, *, beside: float = NAMES_PX, most: int = 4) -> tuple[int, int]:
    """Return how many panels stand beside one another, and how wide each is, pixels."""
    room = width - beside
    columns = max(1, min(most, count, int((room + GAP_PX) // (PANEL_PX + GAP_PX))))
    return columns, max(60, int((room - (columns - 1) * GAP_PX) / columns))


def faceted(
    layers: Sequence[Spec], facets: Sequence[str], columns: int, size: Mapping[str, float]
) -> Spec:
    """Return layers, a panel for each value of ``scenario``; a single one has no heading."""
    spec = {**size, "layer": list(layers)}
    if len(facets) < 2:
        return {"data": {"name": "rows"}, **spec}
    return {
        "data": {"name": "rows"},
        "facet": name_of(
            "scenario", sort=list(facets), header={"labelLimit": size["width"] + GAP_PX}
        ),
        "columns": columns,
        "spacing": {"row": 14, "column": GAP_PX},
        "spec": spec,
    }


def chosen(policies: Sequence[str], seeds: bool = False) -> list[Spec]:
    """Return what a reader can choose: policies, and with `seeds` one of these."""
    found: list[Spec] = [{"name": "policies", "value": list(policies)}]
    return [*found, {"name": "seed", "value": None}] if seeds else found


SHOWN: Spec = {"filter": "indexof(policies, datum.policy) >= 0"}


def intervals(
    slug: str,
    frame: pl.DataFrame,
    measure: Measure,
    styles: Mapping[str, Style],
    *,
    limit: Limit = NO_LIMIT,
    title: str = "",
    caption: str = "",
) -> Figure:
    """Draw a measure of policies, a panel a scenario: means with intervals, and every seed.

    Parameters
    ----------
    frame : DataFrame
        ``scenario``, ``policy``, ``mean``, ``low``, ``high``, ``seed``, ``value``, in the
        measure's shown unit: a row a policy without a seed, and a row a seed without a mean.
    styles : mapping of str to Style
        By policy, in the order of the rows.
    """
    shown = [frame[name].drop_nulls().to_list() for name in ("value", "mean", "low")]
    scale: Spec = {"nice": True}
    ticks = {"tickCount": 4, "labelOverlap": "greedy", "labelSeparation": 4}
    # Of a utilisation nobody asks how often it is another one.
    if is_wide([*shown[0], *shown[1]]) and not measure.column.startswith("u_"):
        # An interval may reach below what any run has shown.
        zero = min(itertools.chain(*shown)) <= 0
        scale = {"type": "symlog", "constant": 1} if zero else {"type": "log"}
    across = quantity("mean", measure.heading, scale=scale, axis=ticks)
    down = name_of("policy", sort=list(styles))
    colours = styled(styles)
    about = [name_of("policy", title="policy"), name_of("scenario", title="scenario")]
    faded = {"condition": {"test": "seed === datum.seed", "value": 1}, "value": 0.22}
    layers: list[Spec] = [
        *limit_rule("x", *limit),
        {
            "transform": [SHOWN, {"filter": "isValid(datum.value)"}],
            "mark": {"type": "tick", "thickness": 1.2, "size": 9},
            "encoding": {
                "x": {**across, "field": "value"},
                "y": down,
                "color": colours["color"],
                "opacity": faded,
                "tooltip": [*about, quantity("seed", "seed"), quantity("value", measure.heading)],
            },
        },
        {
            "transform": [SHOWN, {"filter": "isValid(datum.low) && isValid(datum.high)"}],
            "mark": {"type": "rule", "strokeWidth": 2},
            "encoding": {
                "x": {**across, "field": "low"},
                "x2": {"field": "high"},
                "y": down,
                "color": colours["color"],
            },
        },
        {
            "transform": [SHOWN, {"filter": "isValid(datum.mean)"}],
            "mark": {"type": "point", "filled": True, "size": 55, "opacity": 1},
            "encoding": {
                "x": across,
                "y": down,
                "color": colours["color"],
                "shape": colours["shape"],
                "tooltip": [
                    *about,
                    quantity("mean", measure.heading),
                    quantity("low", "from"),
                    quantity("high", "to"),
                ],
            },
        },
    ]
    return _rows(slug, frame, layers, list(styles), title, caption, seeds=True)


def stacked(
    slug: str,
    frame: pl.DataFrame,
    policies: Sequence[str],
    parts: Mapping[str, str],
    heading: str,
    *,
    limit: Limit = NO_LIMIT,
    title: str = "",
    caption: str = "",
) -> Figure:
    """Draw parts of a whole as bars, a row a policy and a panel a scenario.

    Parameters
    ----------
    frame : DataFrame
        ``scenario``, ``policy``, ``part``, ``value``.
    policies : sequence of str
        In the order of the rows.
    parts : mapping of str to str
        Colours, in the order of the bars.
    heading : str
        Of the axis, with its unit.
    """
    names = list(parts)
    order = {"calculate": f"indexof({names!r}, datum.part)", "as": "place"}
    bars: Spec = {
        "transform": [SHOWN, order],
        "mark": {"type": "bar", "height": {"band": 0.7}},
        "encoding": {
            "x": quantity("value", heading, stack="zero", axis={"tickCount": 4}),
            "y": name_of("policy", sort=list(policies)),
            "order": {"field": "place", "type": "quantitative"},
            "color": name_of(
                "part",
                scale={"domain": names, "range": list(parts.values())},
                legend={"symbolType": "square"},
            ),
            "tooltip": [
                name_of("policy", title="policy"),
                name_of("part", title="part"),
                quantity("value", heading),
            ],
        },
    }
    return _rows(slug, frame, [bars, *limit_rule("x", *limit)], policies, title, caption)


def distributions(
    slug: str,
    frame: pl.DataFrame,
    styles: Mapping[str, Style],
    deadline_ms: float,
    *,
    title: str = "",
    caption: str = "",
) -> Figure:
    """Draw the share of cycles that took longer than a latency, a panel a scenario.

    Parameters
    ----------
    frame : DataFrame
        ``scenario``, ``policy``, ``latency_ms``, ``longer``: share of the cycles, above 0.
    styles : mapping of str to Style
    """
    five = {
        "data": {"values": [{}]},
        "mark": {"type": "rule", "color": MUTED, "strokeDash": [1, 3], "tooltip": "5 %"},
        "encoding": {"y": {"datum": 0.05}},
    }
    across = quantity("latency_ms", "latency (ms)", axis={"tickCount": 5})
    up = quantity(
        "longer",
        "cycles that took longer",
        scale={"type": "log", "domain": [LEAST_SHARE, 1], "clamp": True},
        axis={"values": [1, 0.1, 0.01, 0.001, LEAST_SHARE], "format": "~%"},
    )

    def layers(encoded: Mapping[str, Spec]) -> list[Spec]:
        deadline = limit_rule("x", deadline_ms, "deadline")
        return [_steps(across, up, encoded, "policy"), *deadline, five]

    return _plots(slug, frame, styles, layers, 180, title, caption)


def cumulative(
    slug: str,
    frame: pl.DataFrame,
    styles: Mapping[str, Style],
    headings: tuple[str, str],
    *,
    limit: Limit = NO_LIMIT,
    title: str = "",
    caption: str = "",
) -> Figure:
    """Draw empirical distributions, a line a policy and a panel a scenario.

    Parameters
    ----------
    frame : DataFrame
        ``scenario``, ``policy``, ``value``, ``share`` at or below it.
    styles : mapping of str to Style
    headings : (str, str)
        Of the axes: values, shares.
    """
    across = quantity("value", headings[0], axis={"tickCount": 4})
    up = quantity("share", headings[1], axis={"format": "~%", "tickCount": 4})

    def layers(encoded: Mapping[str, Spec]) -> list[Spec]:
        return [_steps(across, up, encoded, "line"), *limit_rule("x", *limit)]

    return _plots(slug, frame, styles, layers, 150, title, caption)


def _steps(across: Spec, up: Spec, encoded: Mapping[str, Spec], what: str) -> Spec:
    """Return the lines of distributions, a step at each value; `what` a line stands for."""
    return {
        "transform": [SHOWN],
        "mark": {"type": "line", "interpolate": "step-after", "strokeWidth": 1.5, "clip": True},
        "encoding": {
            "x": across,
            "y": up,
            **_of(encoded, "color", "strokeDash"),
            "tooltip": [
                name_of("policy", title=what),
                quantity(across["field"], across["title"]),
                quantity(up["field"], up["field"], format=".3~%"),
            ],
        },
    }


def curves(
    slug: str,
    frame: pl.DataFrame,
    measure: Measure,
    styles: Mapping[str, Style],
    heading: str,
    *,
    limit: Limit = NO_LIMIT,
    title: str = "",
    caption: str = "",
) -> Figure:
    """Draw a measure over a parameter, a line a policy and a panel a scenario.

    Parameters
    ----------
    frame : DataFrame
        ``scenario``, ``policy``, ``at`` (the parameter's values, texts or numbers), ``mean``,
        ``low``, ``high`` in the measure's shown unit.
    styles : mapping of str to Style
    heading : str
        Of the parameter.
    """
    numeric = frame["at"].dtype.is_numeric()
    values = frame["at"].unique(maintain_order=True).to_list()
    across: Spec = {
        "field": "at",
        "type": "quantitative" if numeric else "ordinal",
        "title": heading,
        "axis": {"values": values, "labelOverlap": True, "labelAngle": 0, "grid": numeric},
        "sort": None,
    }
    if numeric:
        across["scale"] = {"type": "log" if min(values) > 0 and is_wide(values) else "linear"}
        across["scale"]["zero"] = False
        across["axis"]["format"] = ".6~g"
    up = quantity("mean", measure.heading, axis={"tickCount": 5})

    def layers(encoded: Mapping[str, Spec]) -> list[Spec]:
        return [
            *limit_rule("y", *limit),
            {
                "transform": [SHOWN, {"filter": "isValid(datum.low) && isValid(datum.high)"}],
                "mark": {"type": "rule", "strokeWidth": 1.3},
                "encoding": {
                    "x": across,
                    "y": {**up, "field": "low"},
                    "y2": {"field": "high"},
                    "color": encoded["color"],
                },
            },
            {
                "transform": [SHOWN],
                "mark": {"type": "line", "strokeWidth": 1.3},
                "encoding": {"x": across, "y": up, **_of(encoded, "color", "strokeDash")},
            },
            {
                "transform": [SHOWN, {"filter": "isValid(datum.mean)"}],
                "mark": {"type": "point", "filled": True, "size": 40, "opacity": 1},
                "encoding": {
                    "x": across,
                    "y": up,
                    **_of(encoded, "color", "shape"),
                    "tooltip": [
                        name_of("policy", title="policy"),
                        {"field": "at", "type": across["type"], "title": heading},
                        quantity("mean", measure.heading),
                        quantity("low", "from"),
                        quantity("high", "to"),
                    ],
                },
            },
        ]

    return _plots(slug, frame, styles, layers, 170, title, caption, most=3)


def _rows(
    slug: str,
    frame: pl.DataFrame,
    layers: Sequence[Spec],
    policies: Sequence[str],
    title: str,
    caption: str,
    *,
    seeds: bool = False,
) -> Figure:
    """Return a figure with a row for each policy, a panel a scenario."""
    facets = _facets(frame)

    def draw(width: float) -> Spec:
        columns, across_px = panels(width, len(facets))
        size = {"width": across_px, "height": ROW_PX * max(len(policies), 1)}
        return {**faceted(layers, facets, columns, size), "params": chosen(policies, seeds)}

    return Figure(slug, title, {"rows": frame}, draw, caption)


def _plots(
    slug: str,
    frame: pl.DataFrame,
    styles: Mapping[str, Style],
    layers: Callable[[Mapping[str, Spec]], list[Spec]],
    tallest_px: int,
    title: str,
    caption: str,
    *,
    most: int = 4,
) -> Figure:
    """Return a figure of layers over two numbers, made of encodings; a panel a scenario."""
    facets = _facets(frame)

    def draw(width: float) -> Spec:
        columns, across_px = panels(width, len(facets), beside=60, most=most)
        size = {"width": across_px, "height": min(tallest_px, round(0.6 * across_px))}
        drawn = faceted(layers(styled(styles, width)), facets, columns, size)
        return {**drawn, "params": chosen(list(styles))}

    return Figure(slug, title, {"rows": frame}, draw, caption)


def _of(encoded: Mapping[str, Spec], *channels: str) -> dict[str, Spec]:
    return {channel: encoded[channel] for channel in channels}


def _facets(frame: pl.DataFrame) -> list[str]:
    return [str(name) for name in frame["scenario"].unique(maintain_order=True)]
