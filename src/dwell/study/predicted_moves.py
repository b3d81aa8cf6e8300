"""Predicted moves: what was estimated of a placement when it was chosen, and what it then showed.

The estimate is that of the window at whose close the move was decided, and what is seen are later
windows: a disturbance that begins or ends in between is a difference, too.
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
#: Columns of what the table says of a move, by their types.
COLUMNS = {
    "window": "Int64",
    "from": "String",
    "to": "String",
    "windows": "Int64",
    **{f"{when}_{what}": "Float64" for when in ("predicted", "seen") for what in QUANTITIES},
}


def predicted_moves(run: Run, excluded: Collection[int] = ()) -> pl.DataFrame:
    """Set the estimate of every placement that a run moved to beside what it showed there.

    Moves that the guard made, which nobody estimated, have no row; nor have those that were decided
    in the warm-up.

    Parameters
    ----------
    excluded : collection of int
        Numbers of windows that are left out, with what was decided on them.

    Returns
    -------
    DataFrame
        One row a move: the ``window`` at whose close it was decided, ``from`` and ``to``; the
        estimate ``predicted_l95_ms`` and ``predicted_violation_rate`` with their standard errors
        (``predicted_l95_error_ms``, ``predicted_violation_error``; null where the run has none);
        and ``seen_...``, the means over ``windows``, as the controller saw them at their closes,
        with standard errors (null of fewer than two). These are the windows until the next move,
        without the first one, in which the old placement's cycles may still be on their way, where
        there are others.
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
        if move.by_guard or window in passed:
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
    """Return the mean and its standard error; None where they are not known."""
    spread = values.std()
    return values.mean(), None if spread is None else float(str(spread)) / math.sqrt(len(values))
