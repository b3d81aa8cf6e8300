"""RQ3: the penalty, the threshold, and what can be told of them without a run."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import polars as pl
import pytest

from dwell.cost import hamming
from dwell.sim import draw, simulate_realisation
from dwell.study.family import Comparative
from dwell.study.paper import Chapter, Runner
from dwell.study.paper.chatter import (
    DWELLS,
    ESTIMATORS,
    FEW_STRENGTHS,
    JUDGED_BY,
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

NO: Comparative = "no difference shown"
ALIKE = Seen((NO, NO, NO), (NO, NO))
CALMER = Seen(("lower", NO, NO), (NO, "lower"))
ROUGHER = Seen((NO, "higher", NO), (NO, NO))
TRADED = Seen(("lower", NO, NO), ("higher", NO))
TRADED_BACK = Seen((NO, "higher", NO), (NO, "lower"))


@pytest.mark.parametrize(
    ("seen", "equivalent", "expected"),
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
    seen: Sequence[Seen], equivalent: bool, expected: str
) -> None:
    answer, sentence = verdict(seen, equivalent=equivalent)
    assert answer == expected
    assert f"of {len(seen)} comparisons" in sentence
    assert ("agree within 10 %" in sentence) == equivalent


def test_what_is_traded_is_neither_calmer_nor_rougher() -> None:
    for one in (TRADED, TRADED_BACK):
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


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Chapter:
    folder = tmp_path_factory.mktemp("chatter")
    return chapter(make_cell("flapping"), SCALE, Runner(folder, processes=1))


def test_with_two_candidates_and_a_dwell_the_rules_are_one(written: Chapter) -> None:
    (said,) = [one for one in written.findings if "N_min = 3, the two rules" in one]
    assert said.endswith("in 8 of 8 pairs as the rule implies.")


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
