"""Factor maps: a comparison in every cell of two factors, in panels of a third, and its figure.

A map has a row per cell: its labels (`LABELS`), then the columns of a verdict, numbers in the unit
that the panel names.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import polars as pl
import vl_convert

from reproduction.verdicts import COLUMNS, WITHIN, brief

LABELS = ("panel", "row", "column")
#: Words with a column of their own in a table of counts: with the range of effects, and without.
CLEAR, OTHERS = ("lower", "higher"), (WITHIN, "same cycles", "same run")

#: Readable on white and on black; cells of these colours have white text.
INK, COLOURS = "#808080", {"lower": "#0072b2", "higher": "#b84f00", WITHIN: "#00785a"}
FAINT = "#80808022"
STEP_PX, ROW_PX = 74, 24


def map_of(
    verdicts: pl.DataFrame, label: Callable[[dict[str, str]], tuple[str, str, str]], factor: float
) -> pl.DataFrame:
    """Return verdicts as the cells of a map, numbers times a factor."""
    rows = verdicts.to_dicts()
    labels = pl.DataFrame([label(row) for row in rows], schema=LABELS, orient="row")
    numbers = pl.col("effect", "low", "high") * factor
    return labels.hstack(verdicts.with_columns(numbers).select(COLUMNS))


def counts(cells: pl.DataFrame, by: Sequence[str]) -> str:
    """Return a table (Markdown) of how often each word was found, by some of the labels."""
    words = [*CLEAR, *(word for word in OTHERS if word in cells["word"])]
    head = [*(" " for _ in by), *words, "not shown", "of"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for labels, group in cells.group_by(by, maintain_order=True):
        told = [_told(group.filter(word=word), word) for word in words]
        rest = group.filter(~pl.col("word").is_in(words)).height
        ends = [str(rest or "–"), str(group.height)]
        lines.append("| " + " | ".join([*map(str, labels), *told, *ends]) + " |")
    return "\n".join(lines)


def _told(group: pl.DataFrame, word: str) -> str:
    if group.is_empty():
        return "–"
    if word not in CLEAR:
        return str(group.height)
    sizes = group["effect"].abs().sort()
    ends = dict.fromkeys((number(sizes[0]), number(sizes[-1])))
    return f"{group.height}, by {' to '.join(ends)}"


def number(value: float) -> str:
    """Write an effect: one decimal, two below 1."""
    places = 1 if abs(value) >= 0.995 else 2
    return f"{round(value, places) + 0.0:.{places}f}".replace("-", "−")


def svg(cells: pl.DataFrame) -> str:
    """Draw a map: a panel below the other, in each cell its effect, coloured by its word."""
    panels = [_panel(mine) for _, mine in cells.group_by("panel", maintain_order=True)]
    style = {
        "font": "system-ui, sans-serif",
        "view": {"stroke": None},
        "axis": {
            **dict.fromkeys(("labelColor", "titleColor"), INK),
            **dict.fromkeys(("domain", "ticks"), False),
            "labelLimit": 200,
            "labelFontSize": 12,
        },
        "title": {"color": INK, "anchor": "start", "fontWeight": "normal", "limit": 0},
        "legend": {"labelColor": INK, "labelFontSize": 12},
    }
    # Fonts of browsers may be wider than the font that the drawing is laid out by.
    room = {"left": 24, "right": 24, "top": 5, "bottom": 5}
    drawing = {
        "vconcat": panels,
        "padding": room,
        "background": "transparent",
        "config": style,
    }
    return re.sub(r' (?:role|aria-[\w-]+)="[^"]*"', "", vl_convert.vegalite_to_svg(drawing))


def _panel(cells: pl.DataFrame) -> dict[str, object]:
    shown = brief(cells).select(*LABELS, "effect", "word")
    texts = [
        "=" if word.startswith("same") else number(effect) if effect is not None else ""
        for effect, word in shown.select("effect", "word").iter_rows()
    ]
    data = shown.with_columns(text=pl.Series(texts, dtype=pl.String))
    words = list(dict.fromkeys(data["word"]))
    colours = [COLOURS.get(word, FAINT) for word in words]
    is_coloured = f"indexof({list(COLOURS)}, datum.word) >= 0"
    places = {
        channel: {
            "field": field,
            "type": "nominal",
            "title": None,
            "sort": list(dict.fromkeys(data[field])),
            "axis": axis,
        }
        for channel, field, axis in (
            ("x", "column", {"orient": "top", "labelAngle": 0, "labelLimit": STEP_PX - 4}),
            ("y", "row", {}),
        )
    }
    fill = {
        "field": "word",
        "scale": {"domain": words, "range": colours},
        "legend": {"title": None, "orient": "bottom", "columnPadding": 24} if any(words) else None,
    }
    ink = {"condition": {"test": is_coloured, "value": "white"}, "value": INK}
    return {
        "title": data["panel"][0],
        "width": {"step": STEP_PX},
        "height": {"step": ROW_PX},
        "data": {"values": data.to_dicts()},
        "encoding": places,
        "layer": [
            {"mark": {"type": "rect", "cornerRadius": 2}, "encoding": {"fill": fill}},
            {
                "mark": {"type": "text", "fontSize": 12},
                "encoding": {"text": {"field": "text"}, "color": ink},
            },
        ],
    }
