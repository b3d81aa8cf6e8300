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

if TYPE_CHECKING:
    import polars as pl

    from dwell.study.summary import Row


#: Column of runs that names what is independent in them, `WINDOW` or `RUN`.
UNIT = "unit"
WINDOW, RUN = "window", "run"

#: Means of what cannot be below 0, as utilisations cannot.
NOT_NEGATIVE = frozenset({"cost", "j_still", "l95_ms", "migrations", "moved", "returns"})


def over_seeds(
    runs: pl.DataFrame, keys: Sequence[str], columns: Sequence[str] | None = None
) -> pl.DataFrame:
    """Return one row a group of runs: columns over seeds with their intervals.

    Parameters
    ----------
    runs : DataFrame
        One row a run, with a column ``seed``.
    keys : sequence of str
        Columns that runs of one group share; groups come in the order of their first runs.
    columns : sequence of str, optional
        All others that hold numbers where None.

    Returns
    -------
    DataFrame
        The keys, ``seeds``, and for each column x: ``x``, ``x_low`` and ``x_high`` (see
        `interval_of`; null ends where one seed gives none); with the violation rate, also its
        one-sided limits ``violation_rate_at_least`` and ``violation_rate_at_most``.

    Raises
    ------
    MetricError
        If a column is none of `runs`, or holds text.
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
    """Windows behind the runs of each of some groups: the fewest; None if they tell nothing.

    Parameters
    ----------
    *groups : DataFrame
        One row a run each; their column ``windows`` counts those after the warm-up. None if a
        table has no such column, or if the `UNIT` of a run is `RUN` (see `unit_of`).
    """
    for runs in groups:
        if "windows" not in runs.columns or RUN in runs.get_column(UNIT, default=()):
            return None
    return min(int(runs["windows"].sum()) for runs in groups)


def has_median(column: str) -> bool:
    """Whether a column of runs may be infinite, so that its median stands for it."""
    return column in ("p95_ms", "p50_ms", "spread_ms") or column.startswith("tracking_")


def is_share(column: str) -> bool:
    """Whether a column of runs is a share of cycles or windows, in [0, 1]."""
    return column == "violation_rate" or column.startswith(("share_", "over_"))


def interval_of(column: str, windows: int | None = None) -> Callable[[Floats], Interval]:
    """Which interval a column of runs takes: of a median where it may be infinite, or a mean.

    Parameters
    ----------
    windows : int, optional
        Behind the runs (see `windows_behind`); shares have wide intervals where None.
    """
    if has_median(column):
        return median_interval
    if is_share(column):
        return partial(share_interval, windows=windows)
    return _not_negative if column in NOT_NEGATIVE or column.startswith("u_") else mean_interval


def is_plain(column: str) -> bool:
    """Whether a column's name gives no other interval than that of a mean."""
    return interval_of(column) is mean_interval


def difference_of(column: str, windows: int | None = None) -> Callable[[Floats, Floats], Interval]:
    """Which interval the mean difference of a column of runs takes, between pairs of runs."""
    if is_share(column):
        return partial(share_difference_interval, windows=windows)
    return lambda first, second: mean_interval(first - second)


def _not_negative(values: Floats) -> Interval:
    mean, low, high = mean_interval(values)
    return Interval(mean, max(low, 0.0), high)


def metric_values(runs: pl.DataFrame, metric: str) -> Floats:
    """Return a column of runs, one number a run.

    Parameters
    ----------
    runs : DataFrame
        One row a run.
    metric : str
        Name of a column that holds no text.

    Returns
    -------
    ndarray, shape (runs,)

    Raises
    ------
    MetricError
        If there is no such column; with the nearest name.
    """
    import polars as pl

    known = [name for name, kind in runs.schema.items() if kind != pl.String]
    if metric not in known:
        raise MetricError(f"unknown metric {metric!r}; {nearest(metric, known)}")
    return runs[metric].cast(pl.Float64).to_numpy()
