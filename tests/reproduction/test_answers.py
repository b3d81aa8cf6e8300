"""The answers: rows of the primary comparisons and of their kin, and figures of them."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from reproduction.answers import (
    COLOURS,
    ELSEWHERE,
    OTHERS,
    PRIMARY,
    PRIMARY_PART,
    Compared,
    found,
    page_of,
    rows_of,
    svg,
    words,
    write,
)
from reproduction.verdicts import SCHEMA

COMPARED = Compared("asked", "one beats another", "calm", "one", "another", "violation_rate")


def verdicts(*changed: dict[str, object]) -> pl.DataFrame:
    usual = {
        "claim": COMPARED.claim,
        "design": "20 seeds of 150 windows",
        "scenario": "calm",
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


SOME = verdicts(
    {"scenario": "rough", "word": "higher"},
    {"scenario": "rough", "second": "third"},
    {"second": "third"},
    {},
    {"metric": "cost"},
    {"claim": "another claim"},
)


def test_kin_differ_in_the_scenario_or_in_who_is_compared() -> None:
    rows = rows_of(COMPARED, SOME)
    assert rows.select("part", "scenario", "second").rows() == [
        (PRIMARY_PART, "calm", "another"),
        (ELSEWHERE, "rough", "another"),
        (OTHERS, "calm", "third"),
    ]


def test_only_what_was_asked_is_answered() -> None:
    assert set(found({})) == set()
    asked = {one.question: verdict_of(one) for one in PRIMARY.values()}
    assert set(found(asked)) == set(PRIMARY)


def verdict_of(one: Compared) -> pl.DataFrame:
    told = one._asdict()
    del told["question"]
    return verdicts(told)


def test_an_effect_that_is_infinite_is_not_drawn() -> None:
    rows = rows_of(COMPARED, verdicts({}, {"scenario": "rough", "effect": float("inf")}))
    assert "rough" not in svg(rows)


@pytest.mark.parametrize(("word", "colour"), COLOURS.items())
def test_a_figure_names_who_where_and_the_word(word: str, colour: str) -> None:
    drawn = svg(rows_of(COMPARED, verdicts({"word": word}, {"second": "third", "word": word})))
    for told in ("one less another", "one less third", "in calm", "V_D points", word, colour):
        assert told in drawn


def test_the_page_has_the_words_and_every_figure(tmp_path: Path) -> None:
    answers = {name: rows_of(one, verdict_of(one)) for name, one in PRIMARY.items()}
    html = page_of(answers)
    assert html.count("<svg") == words().count("](answers/RQ")
    assert "![" not in html
    assert 'src="answers' not in html
    write(answers, tmp_path / "answers")
    assert {path.name for path in (tmp_path / "answers").iterdir()} == {
        f"{name}.{end}" for name in PRIMARY for end in ("csv", "svg")
    }
    assert pl.read_csv(tmp_path / "answers" / "RQ1.csv").height == 1
