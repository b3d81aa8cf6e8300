"""Colours: one a placement, the same in every figure, told apart by colour-blind readers too.

Candidates have the hues of `dwell.display`, from the front; a policy that moves has a colour of its
own, DTP that of the text and several DTPs one each, and a marker and dashes that say what it
believes, so that no two lines differ by their colour alone. Colours of text, rules and paper are
CSS variables that the page gives a value to, light or dark, and paper another.
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
#: Of values that have an order and are neither placements nor policies, the first to the last.
RAMP = tuple(f"var(--ramp-{place})" for place in range(6))
#: Where the time of a cycle goes: no placement's colours.
PARTS = {part: f"var(--{part})" for part in ("compute", "queue", "network")}
#: Of several DTPs, which differ in what they believe, the second and the third: apart from the
#: hues, the text and each other for colour-blind readers, too.
APART = ("var(--apart-0)", "var(--apart-1)")
#: What a paper's figures have for the variables of a page.
PRINTED = {
    INK: "#000000",
    MUTED: "#444444",
    RULE: "#dddddd",
    PAPER: "#ffffff",
    SHADE: "#eeeeee",
    BAD: "#b04a00",
    **dict(
        zip(RAMP, ("#b697e3", "#9d79d3", "#845dc0", "#6b43a7", "#522c87", "#3a1862"), strict=True)
    ),
    **dict(zip(PARTS.values(), ("#4d4d4e", "#9a9a9b", "#cfcfd0"), strict=True)),
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

#: Policies that move, by family, and the references that stand beside them: their labels, their
#: hues, from the back of the placements', and a sentence each.
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
#: Places of what a policy believes: each has its marker and dashes, whoever else is shown.
BELIEFS = (*sorted(ESTIMATORS, key=lambda name: ESTIMATORS[name].style), "hindsight")


class Contended(NamedTuple):
    """A contender's name, taken apart; what it does not have is empty.

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
    """Take a contender's name apart; None where no policy is meant."""
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
        """Give every candidate a colour and every policy a style.

        A policy with a candidate's name is that placement and has its colour.

        Parameters
        ----------
        policies : iterable of str
            With what they believe in brackets, where that tells them apart.
        estimator : str
            Estimator that the cell gives its policies. Where any of them says so itself, the others
            are drawn as who believes this: ``dtp`` is then another line than ``dtp+corrected``.
        """
        placements = placement_hues(candidates)
        policies = tuple(dict.fromkeys(policies))
        moving = {name: contended(name) for name in policies if name not in placements}
        if any(known.belief for known in moving.values() if known):
            for name, known in moving.items():
                if known and known == Contended(known.family):
                    moving[name] = known._replace(belief=estimator)
        spare = [hue for hue in reversed(HUES) if hue not in placements.values()]
        # Hues that a family has by its name are not given to others while there are more.
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
    """Return the place of a contender in its family; what it believes has a fixed one."""
    if not known.variant and not known.rest and known.belief in ("", *BELIEFS):
        return BELIEFS.index(known.belief) if known.belief else 0
    place = variants.get(known.family, len(BELIEFS))
    variants[known.family] = place + 1
    return place


def _of_several(place: int) -> str:
    """Return the colour of a contender of the family that has the text's, by its place there."""
    colours = (INK, *APART, MUTED)
    if place < len(BELIEFS):
        return colours[min(place, len(colours) - 1)]
    return colours[1 + (place - len(BELIEFS)) % (len(colours) - 1)]


def _style(colour: str, place: int) -> Style:
    return Style(colour, MARKERS[place % len(MARKERS)], DASHES[place % len(DASHES)])


def ramp_styles(names: Iterable[str]) -> dict[str, Style]:
    """Give a style to each of several values that have an order, the last the darkest."""
    names = tuple(names)
    last = max(len(names) - 1, 1)
    # Two are told apart best by the middle and the end.
    first = 1 if len(names) < len(RAMP) else 0
    span = len(RAMP) - 1 - first
    return {
        name: _style(RAMP[first + round(i / last * span)] if len(names) > 1 else RAMP[-2], i)
        for i, name in enumerate(names)
    }
