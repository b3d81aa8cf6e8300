"""Which interval a column of runs has."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

import dwell.study
from dwell.study.intervals import mean_interval
from dwell.study.over_seeds import interval_of, over_seeds, windows_behind


@pytest.mark.parametrize("column", ["migrations", "l95_ms", "cost", "u_edge", "returns"])
def test_what_cannot_be_below_nothing_has_no_limit_there(column: str) -> None:
    values = np.array([0.0, 0.0, 1.0])
    mean, low, high = mean_interval(values)
    assert low < 0
    assert interval_of(column)(values) == (mean, 0.0, high)


def test_the_package_has_the_function_and_not_the_module_of_its_name() -> None:
    assert dwell.study.over_seeds is over_seeds


def test_a_mean_of_differences_may_be_on_either_side() -> None:
    values = np.array([0.0, 0.0, 1.0])
    assert interval_of("regret")(values) == mean_interval(values)


def test_behind_two_groups_of_runs_are_the_windows_of_the_smaller() -> None:
    few, many = (pl.DataFrame({"windows": windows}) for windows in ([40, 40], [90, 10, 1]))
    assert windows_behind(few, many) == windows_behind(many, few) == 80
    assert windows_behind(few, pl.DataFrame({"seed": [1]})) is None
