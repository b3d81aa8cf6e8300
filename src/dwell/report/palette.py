"""Colours of placements and policies: the same in every figure, distinct for colour-blind readers.

Candidates take the hues of `dwell.display` from the front. Each family of moving policies has its
own colour; DTP has the colour of the text, and further DTPs have further colours. Family and
estimator decide the marker and the dashes, so lines differ in more than colour. Colours of text,
rules and paper are CSS variables: pages set light or dark values, `PRINTED` has those for print.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from dwell.display import HUES, placement_hues
from dwell.estimators.registry import REGISTRY as ESTIMATORS
from dwell.policies import registry

#: Lengths of strokes and gaps in turn, pixels.
Dashes: TypeAlias = tuple[int, ...]

INK, MUTED, RULE = "var(--ink)", "var(--muted)", "var(--rule)"
PAPER, SHADE, BAD = "var(--paper)", "var(--shade)", "var(--bad)"
#: Colours of ordered values, first to last; for values other than placements and policies.
RAMP = tuple(f"var(--ramp-{place})" for place in range(6))
#: Colours of the parts of a cycle's latency; no placement has them.
PARTS = {part: f"var(--{part})" for part in ("compute", "queue", "network")}
#: Colours of the second and third DTP, with other estimators; colour-blind readers can distinguish
#: them from the hues, the text and each other.
APART = ("var(--apart-0)", "var(--apart-1)")
#: Values of a page's variables in printed figures.
PRINTED = {
    INK: "#000000",
    MUTED: "#444444",
    RULE: "#dddddd",
    PAPER: "#ffffff",
    SHADE: "#eeeeee",
    BAD: "#b04a00",
    **dict(
        zip(RAMP, ("#a884db", "#9d79d3", "#845dc0", "#6b43a7", "#522c87", "#3a1862"), strict=True)
    ),
    **dict(zip(PARTS.values(), ("#4d4d4e", "#88888a", "#cfcfd0"), strict=True)),
    **dict(zip(APART, ("#5216c9", "#80340e"), strict=True)),
}

MARKERS = ("diamond", "square", "triangle-up", "triangle-down", "cross", "triangle-right", "circle")
CIRCLE = "circle"
SOLID: Dashes = ()
DASHES: tuple[Dashes, ...] = (
    SOLID,
    (7, 3),
    (2, 2),
    (7, 2, 2, 2),
    (11, 3, 3, 3),
    (4, 4),
    (9, 2, 2, 2, 2, 2),
    (14, 4),
)

#: Families of moving policies, and references: label, colour and a sentence each.
FAMILIES = {
    **registry.FAMILIES,
    "clairvoyant": registry.PolicyEntry(
        "",
        "Clairvoyant",
        "muted",
        "Clairvoyant is no policy but a reference: it knows what every placement, run "
        "alone, costs in every window to come, and plays the cheapest sequence.",
    ),
    "best static": registry.PolicyEntry(
        "",
        "Best static",
        "muted",
        "Best static is no policy either: of the placements that never move, the one "
        "that turns out to be the cheapest on the same realisation.",
    ),
    "oracle": registry.PolicyEntry(
        "",
        "Oracle",
        "muted",
        "Oracle is a reference: it knows when each disturbance is on, and no other random numbers. "
        "It follows the sequence with the least expected J.",
    ),
}
COLOURS = {
    name: {"ink": INK, "muted": MUTED}.get(one.colour, one.colour) for name, one in FAMILIES.items()
}
#: Estimators in the order of their markers and dashes, which are fixed for each estimator.
BELIEFS = (*sorted(ESTIMATORS, key=lambda name: ESTIMATORS[name].style), "hindsight")


class Contended(NamedTuple):
    """Parts of a contender's name; missing parts are empty.

    Parameters
    ----------
    family : str
        The policy: ``dtp`` of ``dtp+corrected``.
    variant : str
        Variant of the policy: ``tuned`` of ``dtp-tuned+corrected``.
    belief : str
        Its estimator: ``corrected`` of ``dtp+corrected``, or of ``dtp (corrected)``.
    rest : str
        Rest of the name: ``LOC or SO`` of ``dtp+corrected LOC or SO``.
    """

    family: str
    variant: str = ""
    belief: str = ""
    rest: str = ""


NAME = re.compile(
    rf"(?P<family>{'|'.join(FAMILIES)})(?:-(?P<variant>\w+))?"
    r"(?:\+(?P<belief>\w+)| \((?P<bracket>\w+)\))?(?:,? (?P<rest>.{1,24}))?",
    re.IGNORECASE,
)


def contended(name: str) -> Contended | None:
    """Return the parts of a contender's name; None if it names no known family."""
    found = NAME.fullmatch(name)
    if found is None:
        return None
    part = {key: value or "" for key, value in found.groupdict().items()}
    belief = part["belief"] or part["bracket"]
    return Contended(part["family"].lower(), part["variant"], belief, part["rest"])


@dataclass(frozen=True, slots=True)
class Style:
    """Style of a policy in figures."""

    colour: str
    marker: str
    dashes: Dashes


@dataclass(frozen=True, slots=True)
class Palette:
    """Colours of the candidates, and styles of the policies."""

    placements: Mapping[str, str]
    policies: Mapping[str, Style]

    @classmethod
    def of(
        cls, candidates: Iterable[str], policies: Iterable[str] = (), estimator: str = ""
    ) -> Palette:
        """Return a colour for every candidate and a style for every policy.

        A policy with a candidate's name is a static placement and has the candidate's colour.

        Parameters
        ----------
        policies : iterable of str
            Names of policies; the estimator may follow in brackets or after ``+``.
        estimator : str
            The cell's estimator. If any policy names its estimator, a policy without one gets the
            style of this estimator: ``dtp`` then differs from ``dtp+corrected``.
        """
        placements = placement_hues(candidates)
        policies = tuple(dict.fromkeys(policies))
        moving = {name: contended(name) for name in policies if name not in placements}
        if any(known.belief for known in moving.values() if known):
            for name, known in moving.items():
                if known and known == Contended(known.family):
                    moving[name] = known._replace(belief=estimator)
        spare = [hue for hue in reversed(HUES) if hue not in placements.values()]
        # Unknown policies take the hues of families last.
        spare.sort(key=lambda hue: hue in COLOURS.values())
        styles = {name: Style(hue, CIRCLE, SOLID) for name, hue in placements.items()}
        variants: dict[str, int] = {}
        unknown = 0
        for name, known in moving.items():
            if known is None:
                colour = (spare or [MUTED])[unknown % max(len(spare), 1)]
                unknown += 1
                styles[name] = _style(colour, unknown)
                continue
            place = _place(known, variants)
            colour = COLOURS[known.family]
            if colour in placements.values():
                colour = MUTED
            if colour == INK:
                colour = _of_several(place)
            shift = tuple(FAMILIES).index(known.family)
            styles[name] = _style(colour, place + shift)
        return cls(placements, {name: styles[name] for name in policies})


def _place(known: Contended, variants: dict[str, int]) -> int:
    """Return the place of a contender in its family; an estimator has a fixed place."""
    if not known.variant and not known.rest and known.belief in ("", *BELIEFS):
        return BELIEFS.index(known.belief) if known.belief else 0
    place = variants.get(known.family, len(BELIEFS))
    variants[known.family] = place + 1
    return place


def _of_several(place: int) -> str:
    """Return the colour of a member, by its place, in the family of the text's colour (DTP)."""
    colours = (INK, *APART, MUTED)
    if place < len(BELIEFS):
        return colours[min(place, len(colours) - 1)]
    return colours[1 + (place - len(BELIEFS)) % (len(colours) - 1)]


def _style(colour: str, place: int) -> Style:
    return Style(colour, MARKERS[place % len(MARKERS)], DASHES[place % len(DASHES)])


def ramp_styles(names: Iterable[str]) -> dict[str, Style]:
    """Return a style for each of several ordered values; the last is the darkest in print."""
    names = tuple(names)
    last = max(len(names) - 1, 1)
    # Skip the first colour if possible.
    first = 1 if len(names) < len(RAMP) else 0
    span = len(RAMP) - 1 - first
    return {
        name: _style(RAMP[first + round(i / last * span)] if len(names) > 1 else RAMP[-2], i)
        for i, name in enumerate(names)
    }
