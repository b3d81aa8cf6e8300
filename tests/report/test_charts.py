"""Charts: limits, axes, and which values are drawn."""

from __future__ import annotations

import math

import polars as pl
import pytest

from dwell.display import Measure
from dwell.report.charts import intervals, is_wide, limit_rule, thinned
from dwell.report.figure import Figure, svg
from dwell.report.palette import Palette


def test_a_limit_is_one_line_and_none_where_it_is_infinite() -> None:
    (rule,) = limit_rule("x", 33.0, "deadline")
    assert rule["encoding"]["x"] == {"datum": 33.0}
    assert rule["data"] == {"values": [{}]}
    assert limit_rule("x", math.inf, "deadline") == []


def test_axes_are_logarithmic_where_numbers_are_far_apart() -> None:
    assert is_wide([1.0, 31.0])
    assert not is_wide([1.0, 29.0, math.inf, 0.0])
    assert not is_wide([5.0])


def test_of_many_values_the_tail_is_kept() -> None:
    kept = thinned(100_000)
    assert len(kept) <= 200
    assert kept[-1] == 99_999
    assert set(range(99_990, 100_000)) <= set(kept.tolist())
    assert (kept[1:] > kept[:-1]).all()
    assert thinned(0).tolist() == []
    assert thinned(3).tolist() == [0, 1, 2]


@pytest.mark.parametrize(("low", "kind"), [(5.0, "log"), (-2.0, "symlog")])
def test_an_axis_has_room_for_an_interval_that_reaches_below_nothing(low: float, kind: str) -> None:
    rows = [("a", "LOC", 10.0, low, 20.0, None, None), ("a", "LOC", None, None, None, 1, 10.0)]
    rows.append(("a", "LOC", None, None, None, 2, 900.0))
    names = ["scenario", "policy", "mean", "low", "high", "seed", "value"]
    frame = pl.DataFrame(rows, schema=names, orient="row", infer_schema_length=None)
    styles = Palette.of(("LOC",), ("LOC",)).policies
    draw = intervals(frame, Measure("l95_ms", "L95", "ms"), styles)
    figure = Figure("l95", "", {"rows": frame}, draw)
    (marks,) = figure.spec()["layer"]
    assert marks["encoding"]["x"]["scale"]["type"] == kind
    assert "NaN" not in svg(figure)
