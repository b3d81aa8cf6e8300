"""The answers: maps of verdicts, what they count, and the words that rest on them."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import polars as pl
import pytest

from dwell.model.controller_settings import ControllerSettings
from reproduction.answers import FOUND, RESEARCH, WORDS, page_of, read, table, words, write
from reproduction.cell import paper_cell
from reproduction.maps import COLOURS, LABELS, counts, map_of, number, svg
from reproduction.questions import chatter, concurrent, deciding, reversion, weights
from reproduction.scale import HELD_OUT, scale_of
from reproduction.verdicts import COLUMNS, SCHEMA, WITHIN, claims

QUESTIONS = (concurrent, reversion, chatter, weights, deciding)


def verdicts(*changed: dict[str, object]) -> pl.DataFrame:
    usual = {
        "claim": "one beats another",
        "design": "16 seeds of 60 windows",
        "scenario": "fault + load",
        "first": "one",
        "second": "another",
        "metric": "violation_rate",
        "effect": -0.01,
        "low": -0.02,
        "high": -0.005,
        "p": 0.01,
        "p_least": 1e-6,
        "word": "lower",
    }
    return pl.DataFrame([{**usual, **one} for one in changed], schema=SCHEMA)


def label(row: dict[str, str]) -> tuple[str, str, str]:
    fault, _, load = row["scenario"].partition(" + ")
    return "robot", fault, load


SOME = map_of(
    verdicts(
        {},
        {"scenario": "fault + more", "effect": -0.11},
        {"scenario": "fault + most", "effect": 0.002, "word": "higher"},
        {"scenario": "none + load", "effect": 0.0, "word": "same cycles"},
        {"scenario": "none + more", "effect": 0.001, "word": WITHIN},
        {"scenario": "none + most", "effect": 0.001, "word": "no difference shown"},
        {"scenario": "slow + most", "effect": None, "word": "cannot tell with 2 seeds"},
    ),
    label,
    100.0,
)


def test_a_map_has_labels_and_numbers_in_its_unit() -> None:
    assert SOME.columns == [*LABELS, *COLUMNS]
    assert SOME.select(LABELS).row(1) == ("robot", "fault", "more")
    assert SOME["effect"][1] == pytest.approx(-11.0)


def test_a_table_counts_words_with_the_range_of_the_clear_ones() -> None:
    head, _, row = counts(SOME, ["panel"]).splitlines()
    assert head == f"|   | lower | higher | {WITHIN} | same cycles | not shown | of |"
    assert row == "| robot | 2, by 1.0 to 11.0 | 1, by 0.20 | 1 | 1 | 2 | 7 |"


@pytest.mark.parametrize(
    ("value", "text"), [(-0.0001, "0.00"), (0.996, "1.0"), (-0.5, "−0.50"), (40.84, "40.8")]
)
def test_numbers_have_one_decimal_and_small_ones_two(value: float, text: str) -> None:
    assert number(value) == text


def test_a_figure_has_a_text_and_a_colour_for_every_cell() -> None:
    drawn = svg(SOME)
    texts = [one.text for one in ElementTree.fromstring(drawn).iter() if one.tag.endswith("text")]
    assert {"robot", "fault", "none", "load", "−11.0", "=", *COLOURS} <= set(texts)
    for colour in COLOURS.values():
        assert drawn.count(f'fill="{colour}"') >= 1


# ------------------------------------------------------------------------------ the margin


def runs(shift: float, spread: float) -> pl.DataFrame:
    """Return 16 runs of either policy that differ by a shift, and by chance."""
    chance = [spread * (-1) ** seed for seed in range(16)]
    rates = {"one": [0.1 + shift + each for each in chance], "another": [0.1] * 16}
    frames = [
        pl.DataFrame({"seed": range(16), "violation_rate": mine}).with_columns(
            policy=pl.lit(name), scenario=pl.lit("calm"), windows=pl.lit(1000)
        )
        for name, mine in rates.items()
    ]
    return pl.concat(frames)


@pytest.mark.parametrize(
    ("shift", "spread", "margin", "word"),
    [
        (0.0, 0.001, 0.005, WITHIN),
        (0.0, 0.001, 0.0, "no difference shown"),
        (0.0, 0.05, 0.005, "no difference shown"),
        (0.003, 0.0001, 0.005, "higher"),
    ],
)
def test_equal_is_claimed_only_within_a_margin_that_was_named(
    shift: float, spread: float, margin: float, word: str
) -> None:
    asked = {"one differs": [("one", "another")]}
    found = claims(runs(shift, spread), ("violation_rate",), ("calm",), asked, margin=margin)
    assert pl.concat(found)["word"].to_list() == [word]


def test_comparisons_with_a_margin_have_seeds_of_their_own() -> None:
    assert {one.MARGIN for one in QUESTIONS} == {0.005}
    for name in ("full", "medium", "quick", "tiny"):
        scale = scale_of(name)
        assert not set(scale.fresh_seeds) & {*scale.all_seeds, *scale.held_out}
        assert min(scale.fresh_seeds) > 2 * HELD_OUT


# -------------------------------------------------------------------------------- the cell


def test_the_questions_play_the_controller_that_the_paper_prints() -> None:
    controller = paper_cell().controller
    assert isinstance(controller, ControllerSettings)
    assert (controller.policy, controller.estimator) == ("dtp", "profile")
    assert (controller.decide_cycles, controller.min_dwell) == (100, 3)
    assert controller.shadow_fraction == 0.05


# ------------------------------------------------------------------------- what is written


def test_every_research_question_has_a_map() -> None:
    assert set(read()) == set(RESEARCH)
    assert len(words({})) > 2000


@pytest.mark.parametrize("name", RESEARCH)
def test_the_words_have_the_table_of_the_map(name: str) -> None:
    found = read()
    assert table(name, found[name]) in WORDS.read_text(encoding="utf-8")
    assert words(found) == WORDS.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", RESEARCH)
def test_the_figure_is_drawn_of_the_map(name: str) -> None:
    assert (FOUND / f"{name}.svg").read_text(encoding="utf-8") == svg(read()[name])


def test_the_words_claim_no_equality_without_a_margin() -> None:
    assert "no difference |" not in words({})
    assert "no difference\n" not in words({})


def test_the_page_has_the_words_and_the_figures_of_its_own_maps(tmp_path: Path) -> None:
    html = page_of({"RQ1": SOME})
    assert html.count("<svg") == len(RESEARCH)
    assert "<!--" not in html
    assert 'src="answers' not in html
    assert "16 seeds of 60 windows" in html
    write({"RQ1": SOME}, tmp_path)
    assert {path.name for path in (tmp_path / "answers").iterdir()} == {"RQ1.csv", "RQ1.svg"}
    assert read(tmp_path / "answers")["RQ1"].equals(SOME)
    assert table("RQ1", SOME) in (tmp_path / "ANSWERS.md").read_text(encoding="utf-8")


def test_the_largest_share_of_each_scenario_is_in_the_table_of_weights() -> None:
    found = read()["RQ4"]
    rows = table("RQ4", found).splitlines()[2:]
    assert [re.split(r" *\| *", row)[1] for row in rows] == list(
        dict.fromkeys(found["row"].to_list())
    )
