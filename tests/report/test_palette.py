"""Colours: one a placement, none shared, the same wherever they are asked for."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import dwell.dash
from dwell.display import HUES
from dwell.policies import registry
from dwell.report.page import TEMPLATES
from dwell.report.palette import (
    APART,
    INK,
    MUTED,
    PAPER,
    PARTS,
    PRINTED,
    RAMP,
    RULE,
    Palette,
)

DASH = Path(dwell.dash.__file__).parent / "static"
CANDIDATES = ("LOC", "SO", "HYB")
NAMES = (*CANDIDATES, "atp", "dtp", "latency-first", "dtp+corrected", "cusum+corrected")


def test_a_placement_has_its_colour_whoever_is_compared() -> None:
    alone = Palette.of(CANDIDATES)
    among = Palette.of(CANDIDATES, ("dtp", "HYB", "LOC", "atp"))
    assert alone.placements == among.placements
    assert among.policies["HYB"].colour == alone.placements["HYB"]
    assert len(set(alone.placements.values())) == len(CANDIDATES)


def test_policies_that_move_differ_from_placements_and_each_other() -> None:
    palette = Palette.of(CANDIDATES, (*CANDIDATES, "atp", "dtp", "latency-first"))
    assert palette.policies["dtp"].colour == INK
    assert len({style.colour for style in palette.policies.values()}) == 6
    moving = [palette.policies[name] for name in ("atp", "dtp", "latency-first")]
    assert len({style.marker for style in moving}) == 3
    assert len({str(style.dashes) for style in moving}) == 3


def test_no_colour_is_a_placeholder_of_the_page() -> None:
    many = Palette.of([f"c{i}" for i in range(9)], ["a", "b"])
    drawn = {*many.placements.values(), *PARTS.values()}
    assert not drawn & {INK, MUTED, PAPER, RULE}


def test_no_two_contenders_are_drawn_alike() -> None:
    styles = Palette.of(CANDIDATES, NAMES, "profile").policies
    assert list(styles) == list(NAMES)
    moving = [styles[name] for name in NAMES[3:]]
    assert len({style.marker for style in moving}) == len(moving)
    assert len({str(style.dashes) for style in moving}) == len(moving)


def test_where_nobody_says_what_it_believes_nothing_changes() -> None:
    assert Palette.of(CANDIDATES, NAMES[:6], "profile") == Palette.of(CANDIDATES, NAMES[:6])


@pytest.mark.parametrize(
    "names",
    [
        ("dtp", "dtp+corrected", "dtp+shadow"),
        ("dtp+corrected", "dtp+profile", "dtp+shadow", "dtp+scaling"),
        ("dtp", "dtp-tuned", "dtp-eager"),
        ("DTP (corrected)", "DTP, N_min 0", "DTP, N_min 9"),
    ],
)
def test_several_dtps_differ_by_colour_marker_and_dashes(names: tuple[str, ...]) -> None:
    styles = Palette.of(CANDIDATES, (*CANDIDATES, *names), "profile").policies
    shown = [styles[name] for name in names]
    for looks in ("colour", "marker", "dashes"):
        assert len({getattr(style, looks) for style in shown}) == len(names)
    assert not {style.colour for style in shown} & set(HUES)


def luminance(colour: str) -> float:
    """Return the relative luminance of WCAG 2.2."""
    shares = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return sum(w * s for w, s in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("folder", [TEMPLATES, DASH])
def test_every_mark_has_a_contrast_of_three_with_the_paper(folder: Path) -> None:
    css = (folder / "page.css").read_text(encoding="utf-8").replace("#fff;", "#ffffff;")
    pages = re.findall(r":root \{\s*([^}]*)\}", css)
    assert len(pages) == 2
    policies = {one.colour for one in registry.FAMILIES.values() if one.colour.startswith("#")}
    # Parts of bars have an outline; rules, bands and shades are no marks.
    unmarked = {"paper", "rule", "shade", "band", "compute", "queue", "network"}
    for page in pages:
        values = dict(re.findall(r"--([\w-]+): (#\w{6})", page))
        drawn = {*HUES, *policies, *(one for name, one in values.items() if name not in unmarked)}
        assert {one for one in drawn if contrast(one, values["paper"]) < 3} == set()


def test_lists_of_runs_have_the_hues_of_placements() -> None:
    css = (DASH / "page.css").read_text(encoding="utf-8")
    assert tuple(re.findall(r"--hue-\d: (#\w{6})", css))[: len(HUES)] == HUES


def test_every_colour_of_a_drawing_has_a_value_on_paper_and_in_the_page() -> None:
    css = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    light, dark = re.findall(r":root \{\s*([^}]*)\}", css)
    for colour in (*APART, *RAMP, *PARTS.values(), INK, MUTED):
        assert PRINTED[colour].startswith("#")
        name = colour.removeprefix("var(").removesuffix(")")
        assert f"{name}: #" in light
        assert f"{name}: #" in dark
