"""Predicted moves: the estimate for a placement at the decision, and the measurements after it.

The estimate is from the window at whose end the move was decided; the measurements are from later
windows. A disturbance that begins or ends in between also causes a difference.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator
from typing import TYPE_CHECKING

from dwell.record.moves import moves

if TYPE_CHECKING:
    import polars as pl

    from dwell.record import Run

QUANTITIES = ("l95_ms", "l95_error_ms", "violation_rate", "violation_error")
#: Polars types of the table's columns, by name.
COLUMNS = {
    "window": "Int64",
    "from": "String",
    "to": "String",
    "windows": "Int64",
    **{f"{when}_{what}": "Float64" for when in ("predicted", "seen") for what in QUANTITIES},
}


def predicted_moves(run: Run, excluded: Collection[int] = ()) -> pl.DataFrame:
    """Return a table of the moves of a run, with predicted and seen metrics of the new placement.

    The table omits moves of the guard, which have no estimate, and moves decided in the warm-up.

    Parameters
    ----------
    excluded : collection of int
        Numbers of windows to omit, together with the moves decided at their ends.

    Returns
    -------
    DataFrame
        One row per move: the ``window`` at whose end it was decided, ``from`` and ``to``; the
        estimates ``predicted_l95_ms`` and ``predicted_violation_rate`` with their standard errors
        (``predicted_l95_error_ms``, ``predicted_violation_error``; null if the run has none); and
        the means ``seen_...`` of the metrics that the controller saw in the next ``windows``
        windows, with standard errors (null for fewer than two windows). The means cover the windows
        until the next move. They omit the first window if there are others, because cycles of the
        old placement may still be in flight in it.
    """
    import polars as pl

    schema = {name: getattr(pl, kind) for name, kind in COLUMNS.items()}
    return pl.DataFrame(list(_rows(run, excluded)), schema=schema, orient="row")


def _rows(run: Run, excluded: Collection[int]) -> Iterator[tuple[object, ...]]:
    import polars as pl

    left_out = pl.col("warmup") | pl.col("window").is_in([*excluded])
    passed = {*excluded, *run.windows.filter(pl.col("warmup"))["window"]}
    shown = run.windows.filter(~left_out & ~pl.col("mixed") & pl.col("seen_l95_ms").is_not_null())
    found, decisions = moves(run), run.decisions
    for move, following in itertools.zip_longest(found, found[1:]):
        window, target = move.window, move.target
        if not move.is_decided or window in passed:
            continue
        until = math.inf if following is None else following.window
        estimates = (f"est_{what}_{target}" for what in QUANTITIES)
        held = shown.filter(
            (pl.col("window") > window)
            & (pl.col("window") <= until)
            & (pl.col("placement").cast(pl.String) == target)
        )
        settled = held.filter(pl.col("window") > window + 1)
        held = held if settled.is_empty() else settled
        yield (
            window,
            move.source,
            target,
            held.height,
            *(decisions[name][move.row] if name in decisions else None for name in estimates),
            *_mean_and_error(held["seen_l95_ms"]),
            *_mean_and_error(held["seen_violation_rate"]),
        )


def _mean_and_error(values: pl.Series) -> tuple[object, float | None]:
    """Return the mean and its standard error; None if unknown."""
    spread = values.std()
    return values.mean(), None if spread is None else float(str(spread)) / math.sqrt(len(values))
