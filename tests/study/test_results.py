"""Numbers of a study's runs over its seeds, by scenario, policy and column."""

from __future__ import annotations

from dataclasses import replace

import polars as pl
import pytest

from dwell.errors import DwellError, MetricError, PolicyError, SimulationError
from dwell.study import Comparison, run_study
from dwell.study.intervals import mean_interval, share_limits
from dwell.study.results import PARAMETER
from tests.study.test_comparison import POLICIES, small
from tests.study.test_study import grid, make_study


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    return small()


def test_the_table_has_every_column_with_its_interval(comparison: Comparison) -> None:
    table = comparison.table()
    assert table.height == 2 * len(POLICIES)
    row = table.filter((pl.col("scenario") == "baseline") & (pl.col("policy") == "dtp"))
    costs = comparison.values("baseline", "dtp", "cost")
    over = mean_interval(costs)
    assert row.select("cost", "cost_low", "cost_high").row(0) == over
    rates = comparison.values("baseline", "dtp", "violation_rate")
    limits = row.select("violation_rate_at_least", "violation_rate_at_most").row(0)
    windows = comparison.windows_behind("baseline", "dtp")
    assert windows == comparison.runs.filter(scenario="baseline", policy="dtp")["windows"].sum()
    assert limits == share_limits(rates, windows=windows)
    for name in ("l95_ms", "u_robot", "u_edge", "migrations", "share_LOC", "share_HYB"):
        assert {name, f"{name}_low", f"{name}_high"} <= set(table.columns)


def test_differences_are_those_of_pairs(comparison: Comparison) -> None:
    found = comparison.difference("baseline", ("dtp", "LOC"), "l95_ms")
    gaps = comparison.values("baseline", "dtp", "l95_ms") - comparison.values(
        "baseline", "LOC", "l95_ms"
    )
    assert found == mean_interval(gaps)


@pytest.mark.parametrize(
    ("values", "axes"),
    [
        ({"a": [1, 1, 2, 2], "b": [3, 4, 3, 4]}, [("a",), ("b",)]),
        ({"a": [1, 2], "b": [5, 5]}, [("a", "b")]),
        ({"a": [5, 5], "b": [1, 2]}, [("b", "a")]),
        ({"a": [1, 1, 2, 2], "b": ["x", "x", "y", "y"], "c": [1, 2, 1, 2]}, [("a", "b"), ("c",)]),
        ({"a": [7], "b": [8]}, [("a", "b")]),
        ({}, []),
    ],
)
def test_parameters_whose_values_go_together_are_one_axis(
    comparison: Comparison, values: dict[str, list[object]], axes: list[tuple[str, ...]]
) -> None:
    runs = pl.DataFrame({PARAMETER + name: each for name, each in values.items()})
    expected = tuple(tuple(PARAMETER + name for name in axis) for axis in axes)
    assert replace(comparison, runs=runs).axes == expected


def test_one_seed_gives_no_interval() -> None:
    table = small(seeds=(1,)).table()
    assert table["cost"].null_count() == 0
    assert table["cost_low"].null_count() == table.height


@pytest.mark.parametrize(
    ("asked", "error", "message"),
    [
        (("baseline", "LOC", "violaton_rate"), MetricError, "metric 'violaton_rate'; did you mean"),
        (
            ("baselin", "LOC", "cost"),
            SimulationError,
            "scenario 'baselin'; did you mean 'baseline'",
        ),
        (("baseline", "LOK", "cost"), PolicyError, "policy 'LOK'; did you mean 'LOC'"),
        (("baseline", "LOC", "policy"), MetricError, "unknown metric 'policy'; "),
    ],
)
def test_what_is_misspelt_gets_the_nearest_name_once(
    comparison: Comparison, asked: tuple[str, str, str], error: type[DwellError], message: str
) -> None:
    scenario, policy, column = asked
    for ask in (
        lambda: comparison.values(*asked),
        lambda: comparison.interval(*asked),
        lambda: comparison.difference(scenario, (policy, "SO"), column),
    ):
        with pytest.raises(error, match=message) as caught:
            ask()
        assert str(caught.value).count("violation_rate") <= 1


def test_a_study_with_parameters_has_no_single_number_a_seed() -> None:
    points = grid(dwells=range(2), delays=range(1, 2))
    found = run_study(make_study(points=points, seeds=(1, 2)), processes=1)
    assert found.parameters == ("parameter.controller.min_dwell", "parameter.links[0].delay_ms")
    assert found.statics == ("LOC",)
    with pytest.raises(SimulationError, match="study small has parameters"):
        found.values("baseline", "dtp", "cost")
    assert found.table(["cost"]).height == 2 * 2 * 2
