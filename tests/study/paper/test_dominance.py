"""Maps: who wins a cell, and the placement that the paper leaves out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from dwell.errors import SimulationError
from dwell.model import Execution, Problem, Task, Trace, TraceTable
from dwell.sim import draw, simulate_realisation
from dwell.study.paper import Runner
from dwell.study.paper import dominance as module
from dwell.study.paper.dominance import (
    FOURTH,
    FOURTH_MOVES,
    PARAMETERS,
    Cell,
    chapter,
    held,
    map_points,
    verdict,
    winners,
    wins,
)
from dwell.study.paper.variants import with_candidate, with_scenarios, with_speed
from tests.study.paper.families import make_family
from tests.study.paper.small_cell import SCALE, make_cell
from tests.study.paper.written import check_written, told

CLEAR, UNCLEAR = (0.1, 0.05, 0.2), (0.1, -0.1, 0.3)
LOCAL = Cell("robot-cpu-stress", 1.0, 0.0, "LOC", "SO", *CLEAR)
OURS = Cell("robot-cpu-stress", 1.0, 0.0, FOURTH, "SO", *CLEAR)
MAYBE = Cell("robot-cpu-stress", 1.0, 0.0, FOURTH, "SO", *UNCLEAR)


@pytest.mark.parametrize(
    ("rates", "costs", "cell", "expected"),
    [
        ({"baseline": -0.01}, {"baseline": -0.1}, LOCAL, "yes"),
        ({"baseline": -0.01}, {"step": -0.1}, LOCAL, "in part"),
        ({}, {}, OURS, "in part"),
        ({}, {}, MAYBE, "no"),
        ({}, {}, LOCAL, "no"),
    ],
)
def test_the_answer_asks_for_a_clear_win(
    rates: dict[str, float], costs: dict[str, float], cell: Cell, expected: str
) -> None:
    won = {"violation_rate": rates, "cost": costs}
    answer, sentence = told(verdict(won, 5, {"violation_rate": [cell], "cost": [LOCAL]}))
    assert answer == expected
    assert f"in {len(rates)} of 5 scenarios" in sentence
    assert f"wins {int(cell is OURS)} clearly by V_D and 0 by J" in sentence


def test_who_wins_is_lower_than_everybody() -> None:
    family = make_family(
        {
            f"a: {FOURTH}, LOC": "lower",
            f"a: {FOURTH}, SO": "lower",
            f"b: {FOURTH}, LOC": "lower",
            f"b: {FOURTH}, SO": "open",
        }
    )
    assert wins(family, ("LOC", "SO")) == {"a": pytest.approx(-0.1)}


def test_a_cell_is_won_by_the_least_mean() -> None:
    shown = {"LOC": [0.2, 0.3, 0.4, 0.5], "SO": [0.1, 0.2, 0.31, 0.4], "HYB": [0.9] * 4}
    runs = pl.concat(
        pl.DataFrame(
            {
                **{f"parameter.{name}": [2.0] * 4 for name in PARAMETERS},
                "scenario": ["undisturbed"] * 4,
                "policy": [name] * 4,
                "seed": [1, 2, 3, 4],
                "cost": values,
            }
        )
        for name, values in shown.items()
    )
    (cell,) = winners(runs, "cost", ("LOC", "SO", "HYB"))
    assert (cell.winner, cell.second, cell.speed, cell.width_ms) == ("SO", "LOC", 2.0, 2.0)
    assert cell.margin == pytest.approx(0.35 - 1.01 / 4)
    assert cell.clear
    # Nobody else may win if nobody else is asked about.
    (other,) = winners(runs, "cost", ("HYB", "LOC"))
    assert (other.winner, other.second) == ("LOC", "HYB")


def test_predictions_hold_where_the_best_is_one_that_is_predicted() -> None:
    cells = {
        "cost": [
            Cell("undisturbed", 1.0, 0.0, "LOC", "SO", *CLEAR),
            Cell("undisturbed", 2.0, 0.0, "SO", "LOC", *CLEAR),
            Cell("robot-cpu-stress", 1.0, 0.0, "HYB", "SO", *UNCLEAR),
        ]
    }
    led = {("undisturbed", 1.0, 0.0): "LOC", ("robot-cpu-stress", 1.0, 0.0): "SO"}
    assert held(cells, led) == {
        "baseline": {"cost": (1, 2), "dtp": (1, 1)},
        "robot-cpu-stress": {"cost": (0, 1), "dtp": (1, 1)},
    }


def test_the_fourth_candidate_is_the_other_half() -> None:
    problem = with_candidate(make_cell(), FOURTH, FOURTH_MOVES)
    placement = problem.candidates[FOURTH]
    assert (placement["perception"], placement["planning"]) == ("R1", "E")
    assert tuple(problem.candidates) == ("LOC", "SO", "HYB", FOURTH)


def test_a_faster_node_takes_less_time_and_nothing_else_changes() -> None:
    problem = make_cell()
    fast = with_speed(problem, "E", 2.0)
    drawn = [draw(one, scenario="baseline", seed=1, windows=4) for one in (problem, fast)]
    for row, (_, node) in enumerate(drawn[0].sites):
        before, after = (one.exec_ns[row] for one in drawn)
        assert np.allclose(after, before / (2.0 if node == "E" else 1.0), atol=1.0)
    assert (drawn[0].delay_ns == drawn[1].delay_ns).all()


def test_a_recording_is_as_fast_as_it_is() -> None:
    table = TraceTable("times.parquet", {"exec_ms": np.array([1.0, 2.0])})
    recorded = Task("perception", {"E": Execution(Trace(table, "exec_ms"))})
    problem = make_cell()
    pipeline = problem.pipeline

    class Recorded:
        tasks = {**pipeline.tasks, "perception": recorded}  # noqa: RUF012

    class Cell_:  # noqa: N801
        pipeline = Recorded

    with pytest.raises(SimulationError, match="is recorded"):
        with_speed(Cell_, "E", 2.0)  # type: ignore[arg-type]


def test_points_of_the_map_are_the_cell_at_its_middle() -> None:
    problem = with_scenarios(make_cell("robot-cpu-stress"), make_cell("robot-cpu-stress").scenarios)
    (middle, jittered) = map_points(problem, (1.0,), (0.0, 4.0))
    rates = [mean_latency(point.problem) for point in (middle, jittered)]
    plain = mean_latency(problem, "baseline")
    assert rates[0] == pytest.approx(plain)
    # LOC crosses one link, whose delay grows by 2 ms in the mean.
    assert rates[1] == pytest.approx(plain + 2.0, abs=0.5)


def mean_latency(problem: Problem, scenario: str = "undisturbed") -> float:
    realisation = draw(problem, scenario=scenario, seed=1, windows=30)
    run = simulate_realisation(problem, realisation, policy="LOC", estimator="profile")
    return float(run.cycles["latency_ns"].mean()) / 1e6  # type: ignore[arg-type]


def test_the_chapter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "MAP_WINDOWS", 6)
    written = chapter(make_cell("step"), SCALE, Runner(tmp_path, processes=1))
    check_written(written)
    tables = {table.slug: table.frame for table in written.tables}
    assert set(tables["dominance-cell"]["scenario"]) == {
        *("baseline", "step"),
        *module.CASES,
    }
    shares = tables["dominance-shares"]
    won = sum(shares[name].sum() for name in ("LOC", "SO", "HYB", FOURTH))
    assert won == shares["cells"].sum() == 2 * 2 * 4
    assert tables["dominance-map"].height == 2 * 2 * 4
