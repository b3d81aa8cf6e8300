"""Figures and tables of runs by scenario and policy, and the words that stand in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

import dwell
from dwell.report import comparison_text
from dwell.report.comparison_page import comparison_page
from dwell.report.policy_blocks import PolicyBlocks, scaled
from dwell.study import compare, over_seeds
from dwell.study.metric import METRICS
from tests.cells.examples import EXAMPLES
from tests.cells.small import SEEDS, make_comparison
from tests.report.pages import small_comparison

NOISE = np.linspace(-0.01, 0.01, len(SEEDS))


def rates(mean: float) -> dict[str, list[float]]:
    return {"violation_rate": [mean + x for x in NOISE]}


def test_a_rate_is_under_the_aim_only_where_its_limit_is() -> None:
    shown: dict[tuple[str, str], Mapping[str, float | list[float]]] = {
        ("baseline", "LOC"): rates(0.02),
        ("baseline", "SO"): rates(0.047),
        ("baseline", "HYB"): rates(0.08),
        ("baseline", "dtp"): {"violation_rate": 0.0},
    }
    comparison = make_comparison(shown)
    blocks = PolicyBlocks(comparison)
    found = [blocks.standing("baseline", name) for name in comparison.policies]
    assert found == ["under", "not shown", "over", "under"]
    # Without the windows behind them, so few runs without a miss show nothing.
    alone = PolicyBlocks(replace(comparison, runs=comparison.runs.drop("windows")))
    assert alone.standing("baseline", "dtp") == "not shown"
    counts = {row["policy"]: row for row in blocks.counts().rows}
    assert counts["LOC"]["under"] == 1
    assert counts["HYB"]["over"] == 1


LOW, NEAR, HIGH = (rates(mean) for mean in (0.02, 0.047, 0.08))


@pytest.mark.parametrize(
    ("loc", "so", "atp", "line"),
    [
        (
            (LOW, LOW),
            (LOW, HIGH),
            (NEAR, NEAR),
            "LOC in 2 of 2 scenarios; in all: LOC; not shown: ATP (our reconstruction) in 2.",
        ),
        (
            (LOW, HIGH),
            (NEAR, LOW),
            (HIGH, HIGH),
            "LOC, SO in 1 of 2 scenarios; in all: none; not shown: SO in 1.",
        ),
        (
            (HIGH, HIGH),
            (HIGH, HIGH),
            (HIGH, HIGH),
            "none in any of 2 scenarios; in all: none; not shown: none.",
        ),
    ],
)
def test_one_sentence_says_who_is_under_the_aim(
    loc: tuple[Mapping[str, list[float]], ...],
    so: tuple[Mapping[str, list[float]], ...],
    atp: tuple[Mapping[str, list[float]], ...],
    line: str,
) -> None:
    scenarios = ("baseline", "robot-cpu-stress")
    shown = {
        (scenario, name): rates
        for name, each in (("LOC", loc), ("SO", so), ("atp", atp))
        for scenario, rates in zip(scenarios, each, strict=True)
    }
    found = make_comparison(shown, scenarios=scenarios, policies=("LOC", "SO", "atp"))
    headline = f"V_D under 5 %: {line}"
    assert PolicyBlocks(found).headline() == headline
    assert comparison_page(found).sections[0].note == headline
    assert " ".join(comparison_text(found, width=70).split()).endswith(headline)


def test_a_figure_shows_every_seed_and_the_interval() -> None:
    found = small_comparison()
    frame = PolicyBlocks(found).rate().frames["rows"]
    mine = frame.filter(scenario="Robot CPU stress", policy="DTP")
    seeds = mine.filter(pl.col("seed").is_not_null())
    values = 100 * found.values("robot-cpu-stress", "dtp", "violation_rate")
    assert seeds["value"].to_list() == pytest.approx(values.tolist())
    known = found.interval("robot-cpu-stress", "dtp", "violation_rate")
    (row,) = mine.filter(pl.col("seed").is_null()).to_dicts()
    shown = [row[name] for name in ("mean", "low", "high")]
    assert shown == pytest.approx([100 * end for end in known])


def test_candidates_may_be_called_as_columns_are() -> None:
    problem = dwell.load(EXAMPLES / "canonical.yaml")
    names = dict(zip(problem.candidates, ("policy", "scenario", "part"), strict=True))
    candidates = {names[name]: placed for name, placed in problem.candidates.items()}
    controller = replace(problem.controller, initial="policy", fallbacks=())
    problem = replace(problem, candidates=candidates, controller=controller)
    policies = ("dtp", "cusum")
    scenarios = ("baseline",)
    found = compare(
        problem, policies=policies, scenarios=scenarios, seeds=(1, 2), windows=30, processes=1
    )
    (figure,) = PolicyBlocks(found).placed()
    assert set(figure.frames["rows"]["part"]) == set(candidates)


def test_shares_of_a_whole_are_drawn_of_those_that_move() -> None:
    found = small_comparison()
    (figure,) = PolicyBlocks(found, "small-").placed()
    assert figure.slug == "small-shares"
    frame = figure.frames["rows"]
    assert set(frame["policy"]) == {"ATP", "DTP"}
    sums = frame.group_by("scenario", "policy").agg(pl.col("value").sum())
    assert sums["value"].to_list() == pytest.approx([100.0] * 4)
    assert PolicyBlocks(make_comparison({}, policies=("LOC", "SO"))).placed() == []


def test_on_a_terminal_there_is_no_room_for_all_intervals() -> None:
    blocks = PolicyBlocks(small_comparison())
    page, terminal = (blocks.results(compact=compact).rows[0] for compact in (False, True))
    assert set(page) - set(terminal) == {"u_robot_low", "u_edge_low"}
    assert "share_LOC_low" not in page


def test_numbers_are_shown_in_the_unit_of_their_measure() -> None:
    runs = make_comparison({("baseline", "LOC"): rates(0.02)}, policies=("LOC",)).runs
    table = scaled(
        over_seeds(runs, ("scenario", "policy"), ["violation_rate"]), METRICS["violation_rate"]
    )
    row = table.row(0, named=True)
    assert row["mean"] == pytest.approx(2.0)
    assert row["low"] == pytest.approx(100 * row["violation_rate_low"])
