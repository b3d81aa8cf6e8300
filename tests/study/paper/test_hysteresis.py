"""Dwell and threshold: their bound, and what they change."""

from __future__ import annotations

import pytest

from dwell.study.family import Comparative
from dwell.study.paper import Chapter, Runner
from dwell.study.paper.hysteresis import (
    DWELLS,
    FEW_DWELLS,
    FEW_THRESHOLDS,
    NONE,
    SETTINGS,
    START_MS,
    THRESHOLDS,
    Bounded,
    Bounds,
    bound_of,
    bounds,
    chapter,
    gridded,
    heavy,
    verdict,
)
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import told

KEPT = Bounds(runs=10, broken=0, reached=2)


NO: Comparative = "no difference shown"


@pytest.mark.parametrize(
    ("held", "migrations", "rate", "cost", "expected"),
    [
        (KEPT, ("lower", "lower"), (NO, NO), ("lower", NO), "yes"),
        (KEPT, ("lower", "lower"), (NO, NO), ("higher", NO), "in part"),
        (KEPT, ("lower", "lower"), (NO, "higher"), (NO, NO), "in part"),
        (KEPT, ("lower", NO), (NO, NO), ("lower", "lower"), "in part"),
        (KEPT, (NO, NO), ("higher", NO), ("lower", "lower"), "no"),
        (KEPT, (NO, NO), (NO, NO), ("lower", "lower"), "not shown"),
        (Bounds(10, 1, 2), ("lower", "lower"), (NO, NO), ("lower", "lower"), "no"),
    ],
)
def test_the_answer_follows_from_what_is_shown(
    held: Bounds,
    migrations: tuple[Comparative, Comparative],
    rate: tuple[Comparative, Comparative],
    cost: tuple[Comparative, Comparative],
    expected: str,
) -> None:
    shown = {
        metric: dict(zip(("baseline", "step"), said, strict=True))
        for metric, said in (("migrations", migrations), ("violation_rate", rate), ("cost", cost))
    }
    answer, sentence = told(verdict(held, shown))
    assert answer == expected
    assert ("broken in 1 of 10 runs" in sentence) == bool(held.broken)
    if rate[1] == "higher":
        assert "V_D is higher in 1 (step) and lower in none" in sentence


def test_bounds_count_what_breaks_and_what_reaches_them() -> None:
    rows = [Bounded("baseline", 3, moves, bound_of(11, 3)) for moves in (1, 2, 3)]
    assert bounds(rows) == Bounds(runs=3, broken=1, reached=1)


@pytest.mark.parametrize(("windows", "dwell", "bound"), [(100, 0, 100), (100, 3, 25), (11, 12, 0)])
def test_the_bound(windows: int, dwell: int, bound: int) -> None:
    assert bound_of(windows, dwell) == bound


def test_the_grid_has_every_setting_once() -> None:
    problem = make_cell()
    seen = {
        (settings.min_dwell, settings.min_improvement)
        for settings in (one.problem(problem).controller for one in gridded())
    }
    assert seen == {(dwell, threshold) for dwell in DWELLS for threshold in THRESHOLDS}


def test_the_coarse_grid_has_what_is_compared() -> None:
    for dwell, threshold in (NONE, *SETTINGS):
        assert (dwell in FEW_DWELLS, threshold in FEW_THRESHOLDS) == (True, True)


def test_only_tasks_that_move_are_heavy() -> None:
    tasks = heavy(make_cell()).pipeline.tasks
    assert {name for name, task in tasks.items() if task.start_ms == START_MS} == {
        "perception",
        "planning",
    }


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Chapter:
    folder = tmp_path_factory.mktemp("hysteresis")
    return chapter(make_cell("step"), SCALE, Runner(folder, processes=1))


def test_no_run_migrates_beyond_its_bound(written: Chapter) -> None:
    table = next(one.frame for one in written.tables if one.slug == "hysteresis-bound")
    assert table["min_dwell"].to_list() == list(FEW_DWELLS)
    assert table["broken"].sum() == 0
    assert max(table["most"].to_list()) > 0
    assert (table["runs"] == 2 * len(FEW_THRESHOLDS) * SCALE.grid_seeds).all()


def test_the_grid_has_a_row_a_scenario_and_setting(written: Chapter) -> None:
    table = next(one.frame for one in written.tables if one.slug == "hysteresis")
    assert table.height == 2 * len(FEW_DWELLS) * len(FEW_THRESHOLDS)
    assert table["min_dwell"].null_count() == 0
    figure = written.figures[0]
    assert "bound" in figure.frame["threshold"].to_list()
    bound = figure.frame.filter(figure.frame["threshold"] == "bound")
    assert (bound["y"] >= 0).all()
