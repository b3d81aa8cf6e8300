"""Studies: what makes none, what shares a realisation, and how a contender sees the cell."""

from __future__ import annotations

import itertools
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dwell.cellfile.study_paths import with_settings
from dwell.errors import DwellError, ProblemError, SimulationError
from dwell.model import Constant, Problem, evolve
from dwell.model.objective import MissCap
from dwell.policies import Static
from dwell.study import Contender, Point, Study
from tests.cells.small import make_problem

PROBLEM = make_problem()


def with_delay(problem: Problem, delay_ms: float) -> Problem:
    links = {
        name: replace(link, delay_ms=Constant(delay_ms))
        for name, link in problem.fabric.links.items()
    }
    return replace(problem, fabric=replace(problem.fabric, links=links))


def make_study(**changes: Any) -> Study:
    usual = Study(
        name="small",
        points=(Point({}, PROBLEM),),
        scenarios=("baseline", "network-impairment"),
        contenders=(Contender("LOC", "LOC"), Contender("dtp", "dtp")),
        seeds=(1, 2, 3),
        windows=6,
    )
    return replace(usual, **changes)


def grid(*, dwells: range, delays: range) -> tuple[Point, ...]:
    return tuple(
        Point(
            {"controller.min_dwell": dwell, "links[0].delay_ms": delay},
            with_settings(with_delay(PROBLEM, delay), {"controller.min_dwell": dwell}),
        )
        for delay in delays
        for dwell in dwells
    )


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"points": ()}, SimulationError, "points is empty"),
        ({"points": (Point({}, PROBLEM),) * 2}, SimulationError, "points holds {} twice"),
        ({"scenarios": ()}, SimulationError, "scenarios is empty"),
        ({"scenarios": ("rain",)}, ProblemError, "unknown scenario 'rain'"),
        ({"contenders": ()}, SimulationError, "policies is empty"),
        ({"contenders": (Contender("a", "LOC"),) * 2}, SimulationError, "holds 'a' twice"),
        ({"seeds": (1, 2, 1)}, SimulationError, "seeds holds 1 twice"),
        ({"windows": 2}, ProblemError, "more than the 2 windows of warm-up"),
        ({"windows": 2**32}, ProblemError, "windows of window_cycles = .* 4294967295"),
        (
            {"contenders": (Contender("clairvoyant", "LOC"),), "references": True},
            SimulationError,
            "'clairvoyant' is a reference's name",
        ),
        (
            {"contenders": (Contender("oracle", "dtp"),), "references": True},
            SimulationError,
            "'oracle' is a reference's name",
        ),
        (
            {
                "points": (Point({}, evolve(PROBLEM, {"objective.caps.misses": MissCap(1, 20)})),),
                "references": True,
            },
            ProblemError,
            "references do not support objective.caps.misses",
        ),
        (
            {"points": (Point({"a": 1}, PROBLEM), Point({"b": 1}, PROBLEM))},
            SimulationError,
            "the points differ in parameters: a, and b",
        ),
    ],
)
def test_what_makes_no_study_is_refused(
    wrong: dict[str, Any], error: type[DwellError], message: str
) -> None:
    with pytest.raises(error, match=message):
        make_study(**wrong)


def test_points_with_other_candidates_are_refused() -> None:
    fewer = {name: place for name, place in PROBLEM.candidates.items() if name != "HYB"}
    other = replace(PROBLEM, candidates=fewer)
    points = (Point({"a": 1}, PROBLEM), Point({"a": 2}, other))
    with pytest.raises(SimulationError, match="differ in candidates: LOC, SO, HYB, and LOC, SO"):
        make_study(points=points)


def test_items_cover_every_combination_once() -> None:
    study = make_study(points=grid(dwells=range(3), delays=range(1, 4)))
    covered = [(point, item.scenario, item.seed) for item in study.items() for point in item.points]
    assert sorted(covered) == sorted(itertools.product(range(9), study.scenarios, study.seeds))
    assert len(set(study.items())) == len(study.items())
    assert study.runs == len(covered) * 2
    assert study.cycles == study.runs * 6 * PROBLEM.window_cycles


def test_points_that_differ_in_what_is_not_drawn_share_an_item() -> None:
    study = make_study(points=grid(dwells=range(3), delays=range(1, 3)))
    assert {item.points for item in study.items()} == {(0, 1, 2), (3, 4, 5)}


def test_an_item_is_not_too_long_to_lose() -> None:
    points = grid(dwells=range(50), delays=range(1, 2))
    sizes = [len(item.points) for item in make_study(points=points, seeds=(1,)).items()]
    assert sizes == [32, 18] * 2  # of two contenders; every scenario has two items


def test_seeds_come_one_after_another() -> None:
    items = make_study().items()
    assert [item.seed for item in items] == [1, 1, 2, 2, 3, 3]
    assert [item.scenario for item in items[:2]] == ["baseline", "network-impairment"]


def test_a_contender_sees_the_cell_with_its_settings() -> None:
    settings = {"controller.min_dwell": 0, "objective.weights.switching": 0.5}
    seen = Contender("mine", "dtp", settings=settings).problem(PROBLEM)
    assert seen.controller == replace(PROBLEM.controller, min_dwell=0)
    weights = replace(PROBLEM.objective.weights, switching=0.5)
    assert seen.objective == replace(PROBLEM.objective, weights=weights)
    assert (seen.pipeline, seen.fabric) == (PROBLEM.pipeline, PROBLEM.fabric)
    assert Contender("mine", "dtp").problem(PROBLEM) is PROBLEM


def test_an_estimator_by_name_is_one_of_the_controllers_settings() -> None:
    seen = Contender("mine", "dtp", "shadow", {"controller.shadow_fraction": 0.1})
    assert seen.problem(PROBLEM).controller.estimator == "shadow"
    wrong = Contender("mine", "dtp", "shadow", {"controller.shadow_fraction": 0.9})
    with pytest.raises(ProblemError, match="more than all cycles"):
        wrong.problem(PROBLEM)


def test_only_a_bare_candidate_is_one() -> None:
    assert Contender("LOC", "LOC").is_candidate(PROBLEM)
    assert not Contender("dtp", "dtp").is_candidate(PROBLEM)
    assert not Contender("LOC", "LOC", "profile").is_candidate(PROBLEM)
    assert not Contender("LOC", "LOC", settings={"controller.escape": True}).is_candidate(PROBLEM)
    own = Static(candidates=PROBLEM.candidates, initial="LOC")
    assert not Contender("own", own).is_candidate(PROBLEM)


def test_values_of_arrays_become_plain() -> None:
    point = Point({"a": np.float64(0.5), "b": np.int64(3)}, PROBLEM)  # type: ignore[dict-item]
    assert [type(value) for value in point.values.values()] == [float, int]


def test_a_study_pickles() -> None:
    study = make_study(points=grid(dwells=range(2), delays=range(1, 2)))
    assert pickle.loads(pickle.dumps(study)) == study
