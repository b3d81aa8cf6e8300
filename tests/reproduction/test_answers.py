"""The answers: rows of the primary comparisons and of their kin, and figures of them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from reproduction.answers import (
    COLOURS,
    ELSEWHERE,
    FOUND,
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
from reproduction.page import SHARES
from reproduction.verdicts import SCHEMA
from tests.regression.paper import FULL, read

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
    for told in ("one less another", "one less third", "in calm", "V_D, points", word, colour):
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


# ------------------------------------------------------------------------- what is written


def section(name: str) -> str:
    """What is written of a question."""
    return re.split(r"^## ", words(), flags=re.MULTILINE)[1 + list(PRIMARY).index(name)]


def line(row: Mapping[str, Any]) -> str:
    """A row of an answer as the page has it."""
    unit = 100 if row["metric"].startswith(SHARES) else 1
    effect, low, high = (
        f"{unit * row[name]:+.2f}".replace("-", "−") for name in ("effect", "low", "high")
    )
    names = f"{row['scenario']} | {row['first']} | {row['second']}"
    return f"| {names} | {effect} [{low}, {high}] | {row['word']} |"


@pytest.mark.parametrize("name", PRIMARY)
def test_every_row_that_is_written_is_one_that_was_found(name: str) -> None:
    rows = pl.read_csv(FOUND / f"{name}.csv")
    primary, *others = [one for one in section(name).splitlines() if "] | " in one]
    known = {line(row) for row in rows.drop_nulls("low").iter_rows(named=True)}
    assert primary == line(rows.row(0, named=True))
    assert len(others) == 3
    assert set(others) <= known


@pytest.mark.parametrize("name", PRIMARY)
def test_what_was_found_is_of_the_comparison_that_was_named(name: str) -> None:
    rows = pl.read_csv(
        FOUND / f"{name}.csv", schema_overrides=dict.fromkeys(("p", "low"), pl.Float64)
    )
    primary = PRIMARY[name]
    assert rows.row(0, named=True)["part"] == PRIMARY_PART
    for key in ("claim", "scenario", "first", "second", "metric"):
        assert rows[key][0] == getattr(primary, key)
    assert rows.equals(rows_of(primary, rows.drop("part")))


@pytest.mark.parametrize("name", PRIMARY)
def test_the_figure_is_drawn_of_what_was_found(name: str) -> None:
    drawn = (FOUND / f"{name}.svg").read_text(encoding="utf-8")
    assert drawn == svg(pl.read_csv(FOUND / f"{name}.csv"))


@pytest.mark.parametrize(
    ("name", "study", "first", "second"),
    [
        ("RQ1", "concurrent", "dtp+corrected", "atp-tuned"),
        ("RQ4", "weights-one", "α_V × ½", "as in the cell"),
    ],
)
def test_effects_are_differences_of_the_means_that_are_kept(
    name: str, study: str, first: str, second: str
) -> None:
    kept = read(FULL).filter(study=study, scenario=PRIMARY[name].scenario)
    one, other = (kept.filter(policy=who)["violation_rate"][0] for who in (first, second))
    effect = pl.read_csv(FOUND / f"{name}.csv")["effect"][0]
    assert one - other == pytest.approx(effect, abs=1e-6)


def test_weights_change_nothing_in_three_steady_scenarios() -> None:
    kept = read(FULL).filter(study="weights")
    steady = ("edge-cpu-stress", "network-impairment", "network-impairment-mild")
    for scenario in steady:
        assert kept.filter(scenario=scenario)["violation_rate"].n_unique() == 1
    for scenario in ("baseline", "robot-cpu-stress"):
        assert kept.filter(scenario=scenario)["violation_rate"].n_unique() > 1
