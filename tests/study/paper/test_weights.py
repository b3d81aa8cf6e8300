"""RQ4: what the five weights do."""

from __future__ import annotations

import numpy as np
import pytest

from dwell.study import Interval
from dwell.study.paper import Chapter, Runner
from dwell.study.paper.weights import (
    STEPS,
    WEIGHTS,
    Reaction,
    chapter,
    luck,
    ordered,
    parameters,
    stepping,
    verdict,
    weighing,
)
from dwell.study.sensitivity import sobol_design
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import told

SYMBOLS = tuple(WEIGHTS.values())


def reaction(spread: float, lucky: float, leading: str = "α_V") -> Reaction:
    totals = {
        symbol: Interval(0.9, 0.8, 1.0) if symbol == leading else Interval(0.01, 0.0, 0.02)
        for symbol in SYMBOLS
    }
    return Reaction("baseline", 0.05, 0.05 + spread, lucky, totals)


def test_luck_is_what_seeds_and_points_make_together() -> None:
    seeds, points = np.arange(4.0)[:, None], np.arange(50.0)
    assert luck(seeds + points) == pytest.approx(0.0, abs=1e-12)
    assert luck(np.zeros((3, 7))) == 0.0
    # Rounding is no luck.
    assert luck(np.full((3, 7), 0.1) + 1e-17 * points[:7]) == 0.0
    assert np.isnan(luck(points[None]))
    noise = np.random.default_rng(1).normal(size=(4, 4000))
    assert luck(noise) == pytest.approx(1.0, abs=0.1)
    # As large as the effect of the points, in each of four seeds: a fifth of the variance.
    effect = np.random.default_rng(2).normal(size=4000)
    assert luck(noise + effect) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    ("reactions", "expected"),
    [
        ([reaction(0.02, 0.1), reaction(0.05, 0.4)], "yes"),
        ([reaction(0.02, 0.1), reaction(0.001, 0.1)], "in part"),
        ([reaction(0.02, 0.1), reaction(0.02, 0.9)], "in part"),
        ([reaction(0.02, 0.9), reaction(0.001, 0.1)], "not shown"),
        ([reaction(0.001, 0.9), reaction(0.0, 0.0)], "no"),
    ],
)
def test_the_answer_follows_from_the_reactions(reactions: list[Reaction], expected: str) -> None:
    assert verdict(reactions)[0] == expected


def test_the_sentence_names_the_leading_weight_and_the_idle_ones() -> None:
    _, sentence = told(verdict([reaction(0.02, 0.1), reaction(0.03, 0.9)]))
    assert "1 of 2 scenarios (baseline)" in sentence
    assert "baseline (5.0 % to 7.0 %, most by α_V" in sentence
    assert "luck" in sentence
    assert sentence.endswith("α_L, α_r, α_e and α_S have no part in it.")


def test_a_weight_leads_only_where_that_is_shown() -> None:
    totals = {symbol: Interval(0.3, -0.1, 0.7) for symbol in SYMBOLS}
    assert Reaction("step", 0.1, 0.2, 0.1, totals).leading is None
    assert "no single weight" in str(Reaction("step", 0.1, 0.2, 0.1, totals))
    totals["α_r"] = Interval(0.2, 0.1, 0.3)
    assert Reaction("step", 0.1, 0.2, 0.1, totals).leading == "α_r"


def test_the_design_spreads_factors_around_the_weights_of_the_cell() -> None:
    problem = make_cell()
    ranges = parameters(problem)
    design = sobol_design(ranges, 64, seed=1)
    for one, name, column in zip(ranges, WEIGHTS, design.T, strict=True):
        usual = getattr(problem.objective.weights, name)
        assert (one.low, one.high) == (usual / 4, usual * 4)
        assert np.median(np.log(column)) == pytest.approx(np.log(usual), abs=0.2)
    assert 0 < ordered(weighing(design)) < 1


def test_one_weight_at_a_time_is_changed() -> None:
    problem = make_cell()
    first, *changed = stepping(problem)
    assert first.problem(problem).objective == problem.objective
    assert len(changed) == len(WEIGHTS) * len(STEPS)
    for one in changed:
        weights = one.problem(problem).objective.weights
        differing = [
            name
            for name in WEIGHTS
            if getattr(weights, name) != getattr(problem.objective.weights, name)
        ]
        assert [WEIGHTS[name] for name in differing] == [one.name.split(" ", 1)[0]]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Chapter:
    folder = tmp_path_factory.mktemp("weights")
    return chapter(make_cell("step"), SCALE, Runner(folder, processes=1))


def test_every_scenario_output_and_weight_has_its_indices(written: Chapter) -> None:
    tables = {table.slug: table.frame for table in written.tables}
    assert tables["weights-sobol"].height == 2 * 5 * 5
    assert tables["weights-ranges"].height == 2 * 5
    assert tables["weights-one"].height == 2 * 15
    ranges = tables["weights-ranges"]
    assert (ranges["low"] <= ranges["high"]).all()


def test_the_figure_of_steps_parts_its_names(written: Chapter) -> None:
    figure = next(one for one in written.figures if one.slug == "weights-one")
    assert set(figure.frame["weight"]) == set(SYMBOLS)
    assert set(figure.frame["step"]) == set(STEPS)
    assert set(figure.frame["scenario"]) == {"baseline", "step"}
