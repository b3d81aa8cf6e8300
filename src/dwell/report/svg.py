"""Figures as SVG that stands in a page: text as text, colours of the page, no outside resource."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from dwell.report.palette import INK, MUTED, PAPER, RULE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["WIDTH", "inline", "new_figure"]

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
}


#: What a page of several figures must not have twice, needs not at all, or says itself.
CLEANING = tuple(
    (re.compile(pattern, re.DOTALL), replacement)
    for pattern, replacement in (
        (r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>|<defs>\s*</defs>", ""),
        # What is referred to has an id made from the salt; the names of groups would repeat.
        (r'<g id="[^"]*"', "<g"),
        (r"xlink:href", "href"),
        (r"font: (?:(\d+) )?([\d.]+px) [^;\"]*", r"font-weight: \1; font-size: \2"),
        (r"font-weight: ; | ?font-family: [^;\"]*;", ""),
        (r' transform="rotate\(-?0 [^)]*\)"', ""),
        (r"(\d\.\d\d)\d+", r"\1"),
    )
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
        yield Figure(figsize=(WIDTH, height), layout="constrained")


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
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({**STYLE, "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    for pattern, replacement in CLEANING:
        text = pattern.sub(replacement, text)
    for placeholder, colour in PAGE_COLOURS.items():
        text = text.replace(placeholder, colour)
    head, _, body = text.partition(">")
    box = re.search(r'viewBox="[^"]*"', head)
    label = description.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    viewbox = box.group(0) if box else ""
    body = re.sub(r"\n\s*", "\n", body)
    return f'<svg {viewbox} role="img" aria-label="{label}">{body}'.rstrip()
