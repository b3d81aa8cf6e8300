"""Figures: data and a Vega-Lite drawing, as SVG for a page, and as files for a paper.

Drawings use CSS variables as colours. A page defines them for its light and dark themes; files for
a paper have fixed values. A drawing is made for a width, which keeps the size of its text.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from dwell.files import write_whole
from dwell.report.formatting import SYMBOL
from dwell.report.palette import PRINTED

if TYPE_CHECKING:
    import polars as pl

Spec: TypeAlias = "dict[str, Any]"
#: Takes a width in pixels and returns a Vega-Lite drawing about as wide, without data.
Draw: TypeAlias = "Callable[[float], Spec]"

#: Width of a figure in a page, pixels, and in a paper's column, points.
PAGE_PX, COLUMN_PT = 940, 252
#: Size of letters in a page, pixels, and on paper, points.
LETTERS_PX, LETTERS_PT = 12, 7
FONT = "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Arial, sans-serif"
PRINTED_FONT = "Liberation Sans, Arial, Helvetica, sans-serif"


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure.

    `slug` is its name in files and links, unique in a page. `frames` has the data by their names
    in the drawing. `caption` is plain text. A figure with `widths`, in pixels, has one
    picture per width; the page shows the widest picture that fits, and no script redraws it.
    """

    slug: str
    title: str
    frames: Mapping[str, pl.DataFrame]
    draw: Draw
    caption: str = ""
    widths: Sequence[float] = ()

    def spec(self, width: float = PAGE_PX, *, letters: float = LETTERS_PX) -> Spec:
        """Return the drawing with its data and style; lengths and letters in pixels."""
        return {
            **self.draw(width),
            "datasets": {name: _rows(frame) for name, frame in self.frames.items()},
            "config": _style(letters),
            "background": "transparent",
            "padding": {"left": 12, "right": 6, "top": 2, "bottom": 2},
        }


def _rows(frame: pl.DataFrame) -> list[dict[str, Any]]:
    """Return the rows for JSON: six digits per number, null for infinity and NaN."""
    return [
        {name: _plain(value) for name, value in row.items()} for row in frame.iter_rows(named=True)
    ]


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def svg(figure: Figure, width: float | None = None) -> str:
    """Return the SVG element of a figure for a page, or for a part of it that is `width` wide."""
    import vl_convert

    text = vl_convert.vegalite_to_svg(figure.spec(width or (*figure.widths, PAGE_PX)[0]))
    text = _typeset(text)
    # vl-convert resolves links within the page against a site of Vega; restore them.
    text = text.replace("https://vega.github.io/vega-datasets/#", "#")
    # Two decimals and no ARIA attributes keep a page with many figures small.
    text = re.sub(r"(?<=\d\.\d\d)\d+", "", text)
    text = re.sub(r' (?:role|aria-\w+)="[^"]*"', "", text)
    # vl-convert numbers ids across drawings; ids by slug do not depend on earlier drawings.
    names = list(dict.fromkeys(re.findall(r'id="(\w+)"', text)))
    for place, name in enumerate(names):
        own = figure.slug if width is None else f"{figure.slug}-{width:.0f}"
        text = re.sub(rf"\b{name}\b", f"{own}-{place}", text)
    label = escape(figure.title)
    whole = re.search(r'width="([\d.]+)"', text)
    most = "" if whole is None else f' style="max-width:{float(whole[1]):.0f}px"'
    return re.sub(
        r'<svg ([^>]*?)width="[^"]*" height="[^"]*"',
        rf'<svg role="img" aria-label="{label}"{most} \1',
        text,
        count=1,
    )


def _typeset(drawing: str) -> str:
    """Lower the indices of symbols in the texts of an SVG: V_D."""
    # `dy` is in letters of its own element, and lasts; the letter after an index ends it.
    lowered = r'\1<tspan dy=".3em" font-size="75%">\2</tspan><tspan dy="-.225em">\3</tspan>'
    return re.sub(
        r"(?<=>)[^<>]+(?=</text>)",
        lambda text: re.sub(f"{SYMBOL.pattern}(.?)", lowered, text[0]),
        drawing,
    )


def printed_svg(figure: Figure, width_pt: float = COLUMN_PT) -> str:
    """Return a figure as an SVG document for a column of a paper, with text of 7 pt."""
    # One unit of the drawing is one point.
    return re.sub(
        r'width="([\d.]+)" height="([\d.]+)"',
        r'width="\1pt" height="\2pt"',
        _printed(figure, width_pt),
        count=1,
    )


def pdf(figure: Figure, width_pt: float = COLUMN_PT) -> bytes:
    """Return a figure as PDF for a column of a paper, with text of 7 pt."""
    import vl_convert

    return bytes(vl_convert.svg_to_pdf(_printed(figure, width_pt)))


def _printed(figure: Figure, width_pt: float) -> str:
    """Return the SVG whose total width, with axes, is `width_pt`, within 1 pt if possible."""
    import vl_convert

    asked, text = width_pt, ""
    for _ in range(4):
        drawn = figure.spec(asked, letters=LETTERS_PT)
        text = vl_convert.vegalite_to_svg(_resolved({**drawn, "background": "white"}))
        found = re.search(r'width="([\d.]+)"', text)
        off = width_pt - (width_pt if found is None else float(found[1]))
        if 0 <= off < 1:
            break
        asked += off - 0.5
    # Links lead to places of a page, which a printed figure leaves.
    return _typeset(re.sub(r"</?a\b[^>]*>", "", text))


def _resolved(drawing: Spec) -> Spec:
    """Return a drawing with the colours and the font of printed figures."""
    text = json.dumps(drawing)
    for name, value in {**PRINTED, FONT: PRINTED_FONT}.items():
        text = text.replace(name, value)
    resolved: Spec = json.loads(text)
    return resolved


@cache
def javascript() -> str:
    """Return Vega, Vega-Lite, their embedding and its interpreter as one script.

    vl-convert takes seconds to make it, so the user's cache keeps one per version of vl-convert.
    """
    from importlib.metadata import version

    # Without a home directory (RuntimeError) or a writable cache, every process makes the script.
    with suppress(OSError, RuntimeError):
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        kept = Path(caches, "dwell", f"vega-{version('vl-convert-python')}.js")
        if not kept.is_file():
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_whole(kept, _made_javascript())
        return kept.read_bytes().decode()
    return _made_javascript()


@cache
def _made_javascript() -> str:
    import vl_convert

    # Without a snippet the function returns the complete bundle; its type stub requires a snippet.
    return str(vl_convert.javascript_bundle())  # type: ignore[call-arg]


def _style(letters: float) -> Spec:
    ink, muted, rule = "var(--ink)", "var(--muted)", "var(--rule)"
    text = {"labelFontSize": letters, "titleFontSize": letters, "labelFont": FONT}
    text |= {"titleFont": FONT, "titleFontWeight": "normal"}
    return {
        # The description of a mark would be twice as long as the mark.
        "aria": False,
        "font": FONT,
        "view": {"stroke": None, "fill": None},
        "axis": {
            **text,
            "labelColor": muted,
            "titleColor": muted,
            "gridColor": rule,
            "gridWidth": 0.6,
            "domainColor": muted,
            "domainWidth": 0.6,
            "tickColor": muted,
            "tickWidth": 0.6,
            "tickSize": 3,
            "titlePadding": 5,
            "labelLimit": 240,
        },
        "axisY": {"domain": False, "ticks": False, "minExtent": 30},
        "header": {
            **text,
            "titleColor": muted,
            "labelColor": ink,
            "labelFontWeight": 600,
            "labelAnchor": "start",
            "labelLimit": 320,
        },
        "legend": {
            **text,
            "labelColor": ink,
            "titleColor": muted,
            "orient": "top",
            "symbolStrokeWidth": 1.5,
            "labelLimit": 260,
            "columns": 0,
        },
        "title": {"color": ink, "font": FONT, "fontSize": letters, "anchor": "start"},
        "text": {"color": muted, "font": FONT, "fontSize": letters},
        "rule": {"color": ink},
        "concat": {"spacing": 10},
    }
