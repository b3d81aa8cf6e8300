"""The paper's predictions against comparisons made to agree, and to differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from dwell.study.predictions import (
    PAPER,
    applies,
    judge_claim,
    judge_placement,
    paper_predictions,
)
from tests.cells.small import SEEDS, make_comparison

BY_SCENARIO = {prediction.scenario: prediction for prediction in PAPER}
NOISE = np.linspace(-0.02, 0.02, len(SEEDS))


def shares(
    loc: float, so: float, noise: Sequence[float] = tuple(NOISE)
) -> Mapping[str, list[float]]:
    """Return shares of windows, seed by seed; HYB has the rest."""
    return {
        "share_LOC": [loc + x for x in noise],
        "share_SO": [so - x for x in noise],
        "share_HYB": [1 - loc - so for _ in noise],
    }


@pytest.mark.parametrize(
    ("scenario", "loc", "so", "answer"),
    [
        ("baseline", 0.7, 0.1, "agrees"),
        ("baseline", 0.45, 0.2, "differs"),
        ("baseline", 0.2, 0.6, "differs"),
        ("baseline", 0.5, 0.4, "open"),
        ("baseline", 0.4, 0.4, "differs"),
        ("robot-cpu-stress", 0.02, 0.95, "agrees"),
        ("robot-cpu-stress", 0.1, 0.6, "differs"),
        ("robot-cpu-stress", 0.6, 0.1, "differs"),
        ("edge-cpu-stress", 0.5, 0.03, "agrees"),
        ("edge-cpu-stress", 0.3, 0.4, "differs"),
        ("edge-cpu-stress", 0.1, 0.8, "differs"),
        ("network-impairment", 0.95, 0.03, "agrees"),
        ("network-impairment", 0.9, 0.1, "open"),
        ("network-impairment", 0.03, 0.5, "differs"),
    ],
)
def test_placements(scenario: str, loc: float, so: float, answer: str) -> None:
    shown = {(scenario, "dtp"): shares(loc, so)}
    judgement = judge_placement(
        make_comparison(shown, scenarios=(scenario,)), BY_SCENARIO[scenario]
    )
    assert judgement.answer == answer
    names = {"LOC": loc, "SO": so, "HYB": 1 - loc - so}
    together = sum(names[name] for name in BY_SCENARIO[scenario].dominant)
    assert judgement.share.value == pytest.approx(together)
    if loc != so:
        assert judgement.leader == max(names, key=lambda name: names[name])


def test_seeds_that_disagree_leave_it_open() -> None:
    noise = np.linspace(-0.5, 0.5, len(SEEDS))
    shown = {("baseline", "dtp"): shares(0.5, 0.5, tuple(noise))}
    comparison = make_comparison(shown)
    assert judge_placement(comparison, BY_SCENARIO["baseline"]).answer == "open"


@pytest.mark.parametrize(("loc", "answer"), [(1.0, "agrees"), (0.5, "differs")])
def test_a_share_that_is_the_same_in_every_seed_is_judged_by_its_interval(
    loc: float, answer: str
) -> None:
    """What no window showed leaves the interval some width, and here not enough to matter."""
    shown = {("network-impairment", "dtp"): shares(loc, 1 - loc, np.zeros(len(SEEDS)).tolist())}
    comparison = make_comparison(shown, scenarios=("network-impairment",))
    judgement = judge_placement(comparison, BY_SCENARIO["network-impairment"])
    assert judgement.answer == answer
    bound = BY_SCENARIO["network-impairment"].share
    assert (judgement.share.low >= bound, judgement.share.high < bound) == (
        answer == "agrees",
        answer == "differs",
    )


def test_one_seed_leaves_it_open() -> None:
    shown = {("baseline", "dtp"): {"share_LOC": 1.0}}
    comparison = make_comparison(shown, seeds=(1,))
    assert judge_placement(comparison, BY_SCENARIO["baseline"]).answer == "open"


def judge(scenario: str, policy: str, words: str, **shown: Mapping[str, float]) -> str:
    """Judge a claim, given what policies show in its scenario (``LOC={...}``)."""
    comparison = make_comparison(
        {(scenario, name): columns for name, columns in shown.items()},
        scenarios=list(dict.fromkeys(("baseline", scenario))),
    )
    claims = BY_SCENARIO[scenario].claims[policy]
    claim = next(claim for claim in claims if claim.words == words)
    return judge_claim(comparison, scenario, claim)


def test_claims_about_the_baseline() -> None:
    low, high = {"violation_rate": 0.02}, {"violation_rate": 0.08}
    assert judge("baseline", "LOC", "Low V_D", LOC=low) == "agrees"
    assert judge("baseline", "LOC", "Low V_D", LOC=high) == "differs"
    assert judge("baseline", "LOC", "Low V_D", LOC={"violation_rate": 0.05}) == "open"
    assert judge("baseline", "SO", "moderate V_D", LOC=low, SO=high) == "agrees"
    assert judge("baseline", "SO", "moderate V_D", LOC=high, SO=low) == "differs"
    busy = {"u_robot": 0.6}
    for policy, words in (("LOC", "high U_r"), ("SO", "Low U_r")):
        assert judge("baseline", policy, words, LOC=busy) == "agrees"
        assert judge("baseline", policy, words, SO=busy) == "differs"
        # The same in every run: not above, and not below.
        assert judge("baseline", policy, words) == "differs"


def test_claims_about_saturation() -> None:
    full, easy = {"u_robot": 1.0, "u_edge": 1.0}, {"u_robot": 0.5, "u_edge": 0.5}
    for scenario, policy, words in (
        ("robot-cpu-stress", "LOC", "U_r sat."),
        ("edge-cpu-stress", "SO", "U_e sat."),
    ):
        assert judge(scenario, policy, words, **{policy: full}) == "agrees"
        assert judge(scenario, policy, words, **{policy: easy}) == "differs"


def test_a_delay_that_alone_breaks_the_deadline_is_no_jitter() -> None:
    scenario, words = "network-impairment", "via jitter"
    assert judge(scenario, "SO", words, SO={"p50_ms": 30.0}) == "agrees"
    assert judge(scenario, "SO", words, SO={"p50_ms": 70.0}) == "differs"


def test_a_tail_without_end_leaves_its_length_open() -> None:
    shown = {"spread_ms": float("inf")}
    assert judge("network-impairment", "LOC", "Low variance", SO=shown) == "open"


def test_what_was_not_run_is_open() -> None:
    comparison = make_comparison({}, scenarios=("robot-cpu-stress",), policies=("LOC", "dtp"))
    for claims in BY_SCENARIO["robot-cpu-stress"].claims["SO"]:
        assert judge_claim(comparison, "robot-cpu-stress", claims) == "open"


def test_predictions_are_about_the_papers_scenarios() -> None:
    assert applies(make_comparison({}))
    assert not applies(make_comparison({}, scenarios=("radio-outage",)))


def test_all_predictions_are_rows() -> None:
    shown = {("baseline", "dtp"): shares(0.7, 0.1), ("baseline", "atp"): shares(0.2, 0.6)}
    comparison = make_comparison(
        shown, scenarios=("baseline",), policies=("LOC", "SO", "HYB", "dtp", "atp")
    )
    rows = paper_predictions(comparison, ("dtp", "atp"))
    answers = dict(rows.select("policy", "answer").rows()[:2])
    assert answers == {"dtp": "agrees", "atp": "differs"}
    assert rows["leader"].to_list()[:2] == ["LOC", "SO"]
    claims = [claim for mine in BY_SCENARIO["baseline"].claims.values() for claim in mine]
    assert rows["words"].to_list()[2:] == [claim.words for claim in claims]
    assert rows["share"].null_count() == len(claims)
    assert paper_predictions(make_comparison({}, scenarios=("radio-outage",))).is_empty()
