"""Names and styles: the same thing is called and drawn the same wherever it is shown."""

from __future__ import annotations

from dataclasses import replace

import polars as pl
import pytest

from dwell.report.formatting import shown_contender
from dwell.report.palette import INK, MUTED, PAPER, RAMP, RULE, Palette, contended, ramp_styles
from dwell.report.style import PageStyle
from tests.report.paper_chapters import POLICIES, every_kind, one_of
from tests.study.cell import make_problem


@pytest.fixture(scope="module")
def look() -> PageStyle:
    return PageStyle.of(make_problem(), every_kind())


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("dtp", "DTP"),
        ("dtp+corrected", "DTP (corrected)"),
        ("dtp (profile)", "DTP (profile)"),
        ("dtp-tuned+hindsight", "DTP-tuned (hindsight)"),
        ("dtp+corrected LOC or SO", "DTP (corrected), LOC or SO"),
        ("atp", "ATP"),
        ("work-function+corrected", "Work-function (corrected)"),
        ("clairvoyant-dwell", "Clairvoyant-dwell"),
        ("best static", "Best static"),
        ("LOC", "LOC"),
        ("dtpx", "dtpx"),
        ("my own policy", "my own policy"),
    ],
)
def test_contenders_have_names(name: str, shown: str) -> None:
    assert shown_contender(name) == shown


def test_a_sentence_names_them_alike(look: PageStyle) -> None:
    text = "dtp+corrected beats atp in robot-cpu-stress, not `dtp+corrected`; my-dtp stays."
    assert look.prose(text) == (
        "DTP (corrected) beats ATP in robot CPU stress, not `dtp+corrected`; my-dtp stays."
    )


def test_a_placement_of_a_chapter_has_a_colour_of_its_own(look: PageStyle) -> None:
    # REV is in no cell of these chapters' problem; a map shows it.
    alone = PageStyle.of(make_problem())
    assert tuple(look.placements) == (*alone.placements, "REV")
    assert alone.placements.items() <= look.placements.items()
    assert len(set(look.placements.values())) == 4


def test_what_a_map_shows_beside_winners_is_no_placement() -> None:
    figure = one_of("map")
    counted = replace(figure, frame=figure.frame.with_columns(winner=pl.lit("3 of 4")))
    chapter = replace(every_kind()[3], figures=(counted,))
    assert tuple(PageStyle.of(make_problem(), (chapter,)).placements) == ("LOC", "SO", "HYB")


def test_policies_differ_by_more_than_colour(look: PageStyle) -> None:
    styles = look.styles(POLICIES)
    assert [styles[name].colour for name in POLICIES[:3]] == list(look.placements.values())[:3]
    moving = [styles[name] for name in POLICIES[3:]]
    assert len({(style.colour, style.marker) for style in moving}) == len(moving)
    assert len({(style.colour, str(style.dashes)) for style in moving}) == len(moving)
    assert styles["dtp+corrected"].colour == INK


def test_what_a_policy_believes_has_the_same_place_whoever_is_shown() -> None:
    names = ("dtp+profile", "dtp+corrected", "dtp+shadow", "dtp+scaling")
    together = Palette.of(("LOC",), names).policies
    for name in names:
        assert Palette.of(("LOC",), (name,)).policies[name] == together[name]
    assert len({style.marker for style in together.values()}) == len(names)


def test_values_share_a_ramp() -> None:
    for count in range(1, 10):
        styles = ramp_styles([str(i) for i in range(count)])
        shades = [RAMP.index(style.colour) for style in styles.values()]
        assert shades == sorted(shades)
    assert len({style.colour for style in ramp_styles("abcdef").values()}) == 6
    assert not set(RAMP) & {INK, MUTED, PAPER, RULE}


def test_long_sentences_are_no_contenders() -> None:
    assert contended("DTP loses in all of the scenarios that were looked at") is None


def test_links_have_arrows_and_titles_begin_large(look: PageStyle) -> None:
    assert look.prose("R1->E carries what dtp+corrected sends") == (
        "R1→E carries what DTP (corrected) sends"
    )
    assert look.prose("the best static placement") == "the best static placement"
    assert look.shown("R1->E") == "R1→E"
    titles = {"both links": "Both links", "link R1-R2": "Link R1-R2", "R1 2 a core": "R1 2 a core"}
    assert {name: look.titled(name) for name in titles} == titles
