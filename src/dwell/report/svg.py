"""Figures as SVG that stands in a page: text as text, no outside resource, the page's colours."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any

from dwell.report.formatting import SYMBOL
from dwell.report.palette import INK, MUTED, PAPER, PARTS, RAMP, RULE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["WIDTH", "drawn", "in_page", "inline", "new_figure"]

#: Inches; the page shows a figure at most at 4/3 pixels a point, 9-point text at 12 pixels.
WIDTH = 10.0

# Keys are literals that only some versions of matplotlib declare, so they have no type here.
STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "axes.grid": True,
    "figure.facecolor": "none",
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.3,
    "lines.markersize": 5,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
}

PAGE_COLOURS = {
    INK: "currentColor",
    MUTED: "var(--muted)",
    RULE: "var(--rule)",
    PAPER: "var(--paper)",
    **{colour: f"var(--ramp-{i})" for i, colour in enumerate(RAMP)},
    **{colour: f"var(--{part})" for part, colour in PARTS.items()},
}

#: What a page of several figures must not have twice, needs not at all, or says itself.
CLEANING = tuple(
    (re.compile(pattern, re.DOTALL), replacement)
    for pattern, replacement in (
        (r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>|<defs>\s*</defs>", ""),
        # What is referred to has an id made from the salt; the names of groups would repeat.
        (r'<g id="[^"]*"', "<g"),
        (r"xlink:href", "href"),
        (r' transform="rotate\(-?0 [^)]*\)"', ""),
    )
)
PLACE = re.compile(r"(\d\.\d\d)\d+")
#: The letters of a figure in a page are the page's.
LETTERS = (
    (re.compile(r"font: (?:(\d+) )?([\d.]+px) [^;\"]*"), r"font-weight: \1; font-size: \2"),
    (re.compile(r"font-weight: ; | ?font-family: [^;\"]*;"), ""),
)


@contextmanager
def new_figure(height: float) -> Iterator[Figure]:
    """Make a figure of the page's width in the page's style.

    Parameters
    ----------
    height : float
        Inches.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        # Numbers at the ends of neighbouring axes stand apart.
        figure.set_layout_engine("constrained", wspace=0.03, w_pad=0.06)
        yield figure


def inline(figure: Figure, name: str, description: str) -> str:
    """Return the SVG element of a figure.

    Parameters
    ----------
    figure : Figure
    name : str
        Different for every figure of a page: its inner references are made from it.
    description : str
        For who cannot see it.
    """
    return in_page(drawn(figure, name), description)


def in_page(svg: str, description: str) -> str:
    """Return what `drawn` gives as an element of a page."""
    text = svg
    for pattern, replacement in LETTERS:
        text = pattern.sub(replacement, text)
    for placeholder, colour in PAGE_COLOURS.items():
        text = text.replace(placeholder, colour)
    head, _, body = text.partition(">")
    label = escape(description)
    return f'<svg {_viewbox(head)} role="img" aria-label="{label}">{body}'.rstrip()


def drawn(figure: Figure, name: str) -> str:
    """Return the SVG of a figure as matplotlib draws it, without what nobody needs.

    Parameters
    ----------
    figure : Figure
    name : str
        Different for every figure of a page: its inner references are made from it.
    """
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    for pattern, replacement in CLEANING:
        text = pattern.sub(replacement, text)
    # Of places, and not of the numbers that are shown.
    text = re.sub(r"<[^>]*>", lambda found: PLACE.sub(r"\1", found.group(0)), text)
    text = re.sub(r"(?<=>)[^<>]+(?=</text>)", lambda found: _indexed(found.group(0)), text)
    return re.sub(r"\n\s*", "\n", text)


def _indexed(text: str) -> str:
    """Set the indices of symbols lower and smaller; what follows one comes back up."""
    first, *rest = SYMBOL.split(text)
    parts = [first]
    for letter, index, after in zip(rest[::3], rest[1::3], rest[2::3], strict=True):
        parts.append(f'{letter}<tspan dy="0.22em" font-size="75%">{index}</tspan>')
        if after:
            parts.append(f'<tspan dy="-0.165em">{after}</tspan>')
    return "".join(parts)


def _viewbox(head: str) -> str:
    box = re.search(r'viewBox="[^"]*"', head)
    return box.group(0) if box else ""
