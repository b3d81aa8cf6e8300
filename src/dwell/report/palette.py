"""Colours: one a placement, the same in every figure, told apart by colour-blind readers too.

The hues are those of Okabe and Ito (2008). Candidates take them from the front, in the order of
the cell file; policies that move from the back, DTP the colour of the text. Colours of text, rules
and paper are names that the page gives a value to, light or dark.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

__all__ = ["INK", "MUTED", "PAPER", "PARTS", "RULE", "Palette", "Style"]

HUES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#b8a800")

# Placeholders that `svg.inline` replaces; no other colour of a figure may equal one of them.
INK = "#1a1a1b"
MUTED = "#6b6b6c"
RULE = "#d9d9da"
PAPER = "#fefeff"

#: Where the time of a cycle goes: no placement's colours.
PARTS = {"compute": "#4d4d4e", "queue": "#9a9a9b", "network": "#cfcfd0"}

MARKERS = ("D", "s", "^", "v", "P", "X")
DASHES = ("solid", (0, (5, 2)), (0, (1.2, 1.6)), (0, (5, 1.5, 1.2, 1.5)))


@dataclass(frozen=True, slots=True)
class Style:
    """How a policy is drawn."""

    colour: str
    marker: str
    dashes: str | tuple[float, tuple[float, ...]]
    width: float


@dataclass(frozen=True, slots=True)
class Palette:
    """Colours of the candidates, and styles of the policies."""

    placements: Mapping[str, str]
    policies: Mapping[str, Style]

    @classmethod
    def of(cls, candidates: Iterable[str], policies: Iterable[str] = ()) -> Palette:
        """Give every candidate a colour and every policy a style.

        A policy with a candidate's name is that placement and has its colour.
        """
        placements = {name: HUES[i % len(HUES)] for i, name in enumerate(candidates)}
        styles: dict[str, Style] = {}
        spare = [hue for hue in HUES if hue not in placements.values()] or [MUTED]
        moving = [name for name in policies if name not in placements]
        # DTP first, whatever its place in the tables: it has the colour of the text.
        moving.sort(key=lambda name: name != "dtp")
        for i, name in enumerate(moving):
            colour = INK if name == "dtp" else spare[i % len(spare) - 1]
            dashes = DASHES[i % len(DASHES)]
            styles[name] = Style(colour, MARKERS[i % len(MARKERS)], dashes, 1.8 if i == 0 else 1.3)
        for name in policies:
            if name in placements:
                styles[name] = Style(placements[name], "o", "solid", 1.3)
        return cls(placements, styles)
