"""Tables over seeds: every column of runs with its 95 % interval."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from dwell.errors import MetricError
from dwell.model.number_arrays import Floats
from dwell.model.semantics import nearest
from dwell.study.intervals import (
    Interval,
    mean_interval,
    median_interval,
    share_difference_interval,
    share_interval,
    share_limits,
)
from dwell.study.metric import metric_of

if TYPE_CHECKING:
    import polars as pl

    from dwell.study.summary import Row


#: Column of runs with their independent unit, `WINDOW` or `RUN`.
UNIT = "unit"
WINDOW, RUN = "window", "run"


def over_seeds(
    runs: pl.DataFrame, keys: Sequence[str], columns: Sequence[str] | None = None
) -> pl.DataFrame:
    """Return one row per group of runs: columns over seeds with their intervals.

    Parameters
    ----------
    runs : DataFrame
        One row per run, with a column ``seed``.
    keys : sequence of str
        Columns whose values define a group. Groups have the order of their first runs.
    columns : sequence of str, optional
        Default: all other columns of numbers.

    Returns
    -------
    DataFrame
        The keys, ``seeds``, and for each column x: ``x``, ``x_low`` and ``x_high`` (see
        `interval_of`; the ends are null for a single seed). The violation rate also has its
        one-sided limits, ``violation_rate_at_least`` and ``violation_rate_at_most``.

    Raises
    ------
    MetricError
        If a column is not in `runs`, or holds text.
    """
    import polars as pl

    if columns is None:
        numbers = runs.select(pl.selectors.numeric()).columns
        columns = [name for name in numbers if name not in (*keys, "seed")]
    rows: list[Row] = []
    for labels, mine in runs.group_by(keys, maintain_order=True):
        row: Row = {**dict(zip(keys, labels, strict=True)), "seeds": mine.height}
        windows = windows_behind(mine)
        for column in columns:
            row |= interval_of(column, windows)(metric_values(mine, column)).columns(column)
        if "violation_rate" in columns:
            rates = metric_values(mine, "violation_rate")
            at_least, at_most = share_limits(rates, windows=windows)
            row["violation_rate_at_least"] = at_least
            row["violation_rate_at_most"] = at_most
        rows.append(row)
    return pl.DataFrame(rows, infer_schema_length=None).fill_nan(None)


def windows_behind(*groups: pl.DataFrame) -> int | None:
    """Number of independent windows in the group with the fewest; None if unknown.

    Parameters
    ----------
    *groups : DataFrame
        One row per run; the column ``windows`` counts the windows after the warm-up. The number is
        unknown without this column, or if the `UNIT` of a run is `RUN` (see `unit_of`).
    """
    for runs in groups:
        if "windows" not in runs.columns or RUN in runs.get_column(UNIT, default=()):
            return None
    return min(int(runs["windows"].sum()) for runs in groups)


def interval_of(column: str, windows: int | None = None) -> Callable[[Floats], Interval]:
    """Return the function for the interval of a column: of a median if values may be infinite.

    Parameters
    ----------
    windows : int, optional
        Windows behind the runs (see `windows_behind`); without them shares have wide intervals.
    """
    match metric_of(column).values:
        case "median":
            return median_interval
        case "share":
            return partial(share_interval, windows=windows)
        case "positive":
            return _not_negative
        case "any":
            return mean_interval


def difference_of(column: str, windows: int | None = None) -> Callable[[Floats, Floats], Interval]:
    """Return the function for the interval of a column's mean difference over pairs of runs."""
    if metric_of(column).values == "share":
        return partial(share_difference_interval, windows=windows)
    return lambda first, second: mean_interval(first - second)


def _not_negative(values: Floats) -> Interval:
    mean, low, high = mean_interval(values)
    return Interval(mean, max(low, 0.0), high)


def metric_values(runs: pl.DataFrame, metric: str) -> Floats:
    """Return a column of runs as numbers, shape (runs,).

    Parameters
    ----------
    runs : DataFrame
        One row per run.
    metric : str
        Name of a column of numbers.

    Raises
    ------
    MetricError
        If no column of numbers has this name; the message suggests the nearest name.
    """
    import polars as pl

    known = [name for name, kind in runs.schema.items() if kind != pl.String]
    if metric not in known:
        raise MetricError(f"unknown metric {metric!r}; {nearest(metric, known)}")
    return runs[metric].cast(pl.Float64).to_numpy()
