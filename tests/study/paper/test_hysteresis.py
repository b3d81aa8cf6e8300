"""Dwell and threshold: what they change."""

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
    chapter,
    gridded,
    heavy,
    verdict,
)
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import told

NO: Comparative = "no difference shown"
FEW: Comparative = "cannot tell with 3 seeds"


@pytest.mark.parametrize(
    ("migrations", "rate", "cost", "expected"),
    [
        (("lower", "lower"), (NO, NO), ("lower", NO), "yes"),
        (("lower", "lower"), (NO, NO), ("higher", NO), "in part"),
        (("lower", "lower"), (NO, "higher"), (NO, NO), "in part"),
        (("lower", NO), (NO, NO), ("lower", "lower"), "in part"),
        ((NO, NO), ("higher", NO), ("lower", "lower"), "no"),
        ((NO, NO), (NO, NO), ("lower", "lower"), "not shown"),
        ((FEW, FEW), (FEW, FEW), (FEW, FEW), "not shown"),
    ],
)
def test_the_answer_follows_from_what_is_shown(
    migrations: tuple[Comparative, Comparative],
    rate: tuple[Comparative, Comparative],
    cost: tuple[Comparative, Comparative],
    expected: str,
) -> None:
    shown = {
        metric: dict(zip(("baseline", "step"), said, strict=True))
        for metric, said in (("migrations", migrations), ("violation_rate", rate), ("cost", cost))
    }
    answer, sentence = told(verdict(shown))
    assert answer == expected
    if rate[1] == "higher":
        assert "V_D is higher in 1 (step) and lower in none" in sentence


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


def test_the_grid_has_a_row_a_scenario_and_setting(written: Chapter) -> None:
    table = next(one.frame for one in written.tables if one.slug == "hysteresis")
    assert table.height == 2 * len(FEW_DWELLS) * len(FEW_THRESHOLDS)
    assert table["min_dwell"].null_count() == 0
