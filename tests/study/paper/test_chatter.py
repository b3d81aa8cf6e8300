"""RQ3: the penalty, the threshold, and what can be told of them without a run."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.cost import hamming
from dwell.model import Caps, QoS, Targets, Weights
from dwell.policies import DTP
from dwell.sim import draw, simulate_realisation
from dwell.study.family import Comparative
from dwell.study.paper import Chapter, Runner
from dwell.study.paper.chatter import (
    DWELLS,
    ESTIMATORS,
    FEW_STRENGTHS,
    JUDGED_BY,
    METRICS,
    OF_TWO,
    PENALTY,
    STRENGTHS,
    THRESHOLD,
    Seen,
    chapter,
    contenders,
    judging,
    mean_distance,
    named,
    of_two,
    verdict,
    with_moves,
)
from dwell.study.study import Point, Study
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import told

NO: Comparative = "no difference shown"


def seen(dwell: int = 3, **said: Comparative) -> Seen:
    """Return what was shown, nothing where it is not said."""
    return Seen(dwell, dict.fromkeys(METRICS, NO) | said)


ALIKE = seen()
CALMER = seen(migrations="lower", j_still="lower")
ROUGHER = seen(dwell=0, returns="higher")
TRADED = seen(migrations="lower", violation_rate="higher")
TRADED_BACK = seen(dwell=0, returns="higher", j_still="lower")
SPLIT = seen(migrations="higher", moved="lower")


@pytest.mark.parametrize(
    ("places", "equivalent", "expected"),
    [
        ([CALMER, CALMER, ALIKE], False, "yes"),
        ([CALMER, ALIKE, ALIKE], False, "in part"),
        ([CALMER, CALMER, ROUGHER], False, "in part"),
        ([ROUGHER, ALIKE], False, "no"),
        ([ALIKE, ALIKE], True, "no"),
        ([ALIKE, ALIKE], False, "not shown"),
        ([TRADED, TRADED_BACK], False, "not shown"),
    ],
)
def test_the_answer_follows_from_what_is_shown(
    places: Sequence[Seen], equivalent: bool, expected: str
) -> None:
    answer, sentence = told(verdict(places, equivalent=equivalent))
    assert answer == expected
    assert f"of {len(places)} comparisons" in sentence
    assert ("agree within 10 %" in sentence) == equivalent


def test_the_sentence_counts_each_dwell_apart() -> None:
    _, sentence = told(verdict([CALMER, SPLIT, ROUGHER], equivalent=False))
    assert (
        "N_min = 0, of 1 comparisons: migrations fewer in 0, more in 0; returns fewer in 0, more "
        "in 1" in sentence
    )
    assert "N_min = 3, of 2 comparisons: migrations fewer in 1, more in 1" in sentence
    assert "tasks moved fewer in 1, more in 0" in sentence


def test_what_is_traded_is_neither_calmer_nor_rougher() -> None:
    for one in (TRADED, TRADED_BACK, SPLIT):
        assert [one.calmer, one.rougher, one.alike] == [False] * 3


def test_the_mean_distance_of_the_papers_candidates() -> None:
    # LOC and SO differ in two tasks of four, the others in one.
    assert mean_distance(make_cell().candidates) == pytest.approx((0.5 + 0.25 + 0.25) / 3)


def test_both_rules_have_the_same_mean_threshold() -> None:
    problem = judging(make_cell())
    by_name = {one.name: one.problem(problem) for one in contenders(problem)}
    pairs = list(itertools.combinations(problem.candidates.values(), 2))
    for estimator, dwell, strength in itertools.product(ESTIMATORS, DWELLS, STRENGTHS):
        means = []
        for rule in (PENALTY, THRESHOLD):
            mine = by_name[named(estimator, dwell, rule, strength)]
            thresholds = [
                mine.controller.min_improvement
                + mine.objective.weights.switching * hamming(one, other)
                for one, other in pairs
            ]
            means.append(sum(thresholds) / len(thresholds))
            assert mine.controller.min_dwell == dwell
            # A price of a move from which both could not be told apart.
            assert mine.objective.weights.switching != JUDGED_BY
        assert means[0] == pytest.approx(means[1])


def test_tasks_moved_are_those_of_the_decisions(tmp_path_factory: pytest.TempPathFactory) -> None:
    problem = judging(make_cell("flapping"))
    chosen = [one for one in contenders(problem, (0.2,)) if "profile, N_min = 0" in one.name]
    study = Study(
        name="moves",
        points=(Point({}, problem),),
        scenarios=("flapping",),
        contenders=tuple(chosen),
        seeds=(1, 2),
        windows=30,
    )
    folder = tmp_path_factory.mktemp("moves")
    runs = with_moves(Runner(folder, processes=1).run(study))
    assert runs["moved"].max() > 0  # type: ignore[operator]
    for one, seed in itertools.product(chosen, study.seeds):
        realisation = draw(problem, scenario="flapping", seed=seed, windows=30)
        mine = one.problem(problem)
        run = simulate_realisation(mine, realisation, policy=one.policy, estimator=one.estimator)
        counted = run.windows.filter(~pl.col("warmup"))
        before = run.windows["placement"].shift(1)[run.windows.height - counted.height :]
        moves = [
            4 * hamming(problem.candidates[now], problem.candidates[then])
            for now, then in zip(counted["placement"], before, strict=True)
        ]
        row = runs.filter((pl.col("policy") == one.name) & (pl.col("seed") == seed))
        assert row["moved"].item() == pytest.approx(sum(moves))
        price = mine.objective.weights.switching
        still = counted["cost"].mean() - price * sum(moves) / 4 / counted.height  # type: ignore[operator]
        assert row["j_still"].item() == pytest.approx(still)


def ruled(switching: float, least: float, dwell: int, names: Sequence[str]) -> DTP:
    """Return a DTP whose J is L95 in milliseconds, and the price of a move."""
    problem = make_cell()
    objective = replace(
        problem.objective,
        weights=Weights(latency=1, violations=0, robot=0, edge=0, switching=switching),
        targets=Targets(latency_ms=1.0),
        caps=Caps(),
    )
    candidates = {name: problem.candidates[name] for name in names}
    return DTP(candidates=candidates, objective=objective, min_dwell=dwell, min_improvement=least)


def moves(policy: DTP, rows: Sequence[Sequence[float]]) -> list[str]:
    """Return where a policy is after each window, given J of every candidate in each."""
    path = []
    for row in rows:
        seen = {
            name: QoS(ms, 0.0, {"R1": 0.0, "E": 0.0, "R2": 0.0})
            for name, ms in zip(policy.candidates, row, strict=True)
        }
        path.append(policy.decide(observed=seen[policy.incumbent], estimates=seen).name)
    return path


# Sums of these are exact, so that only the rules decide.
EIGHTHS = st.integers(0, 40).map(lambda number: number / 8)
TWO = st.lists(st.tuples(EIGHTHS, EIGHTHS), max_size=40)
THREE = st.lists(st.tuples(EIGHTHS, EIGHTHS, EIGHTHS), max_size=40)


@given(rows=TWO, dwell=st.integers(1, 4), switching=st.sampled_from([0.5, 1.0, 2.0]))
def test_between_two_candidates_the_penalty_is_a_threshold(
    rows: list[tuple[float, float]], dwell: int, switching: float
) -> None:
    pair = ("LOC", "SO")
    penalty = ruled(switching, 0.25, dwell, pair)
    threshold = ruled(0.0, 0.25 + switching / 2, dwell, pair)
    assert moves(penalty, rows) == moves(threshold, rows)


@given(rows=THREE, dwell=st.integers(1, 4), switching=st.sampled_from([0.5, 1.0, 2.0]))
def test_with_a_dwell_the_penalty_is_a_threshold_of_each_pair(
    rows: list[tuple[float, float, float]], dwell: int, switching: float
) -> None:
    names = ("LOC", "SO", "HYB")
    policy = ruled(switching, 0.25, dwell, names)
    placements, at, waited, expected = policy.candidates, "LOC", 0, []
    for row in rows:
        costs = dict(zip(names, row, strict=True))
        asked = {name: switching * hamming(placements[name], placements[at]) for name in names}
        best = min(names, key=lambda name: (costs[name] + asked[name], name != at))
        if waited >= dwell and best != at and costs[at] - costs[best] > 0.25 + asked[best]:
            at, waited = best, 0
        else:
            waited += 1
        expected.append(at)
    assert moves(policy, rows) == expected


@pytest.mark.parametrize(("gain", "returns"), [(0.5, False), (0.625, True), (0.75, True)])
def test_right_after_a_move_the_penalty_asks_for_less(gain: float, returns: bool) -> None:
    # α_S · S = 0.5 and Δ_min = 0.25: to go back it takes 0.5, not 0.75.
    rows = [(5.0, 1.0), (1.0, 1.0 + gain)]
    path = moves(ruled(1.0, 0.25, 0, ("LOC", "SO")), rows)
    assert path == ["SO", "LOC" if returns else "SO"]
    assert moves(ruled(0.0, 0.75, 0, ("LOC", "SO")), rows) == ["SO", "SO"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Chapter:
    folder = tmp_path_factory.mktemp("chatter")
    return chapter(make_cell("flapping"), SCALE, Runner(folder, processes=1))


def test_with_two_candidates_and_a_dwell_the_rules_are_one(written: Chapter) -> None:
    (said,) = [one for one in written.findings if "N_min = 3, the two rules" in one]
    assert said.endswith("in 8 of 8 pairs, as the rule implies.")


def test_two_candidates_are_the_farthest_apart() -> None:
    two = of_two(make_cell())
    assert tuple(two.candidates) == ("LOC", "SO")
    assert mean_distance(two.candidates) == 0.5
    raised = next(one for one in contenders(two, (OF_TWO,)) if THRESHOLD in one.name).problem(two)
    assert raised.controller.min_improvement == pytest.approx(0.05 + 0.5 * OF_TWO)


def test_every_comparison_has_a_row(written: Chapter) -> None:
    tables = {table.slug: table.frame for table in written.tables}
    places = 2 * len(ESTIMATORS) * len(DWELLS)
    assert tables["chatter"].height == places * (1 + 2 * len(FEW_STRENGTHS))
    assert tables["chatter-calm"].height == places * len(FEW_STRENGTHS)
