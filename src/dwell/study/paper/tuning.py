"""Tuning: the best of several contenders on seeds that nothing is reported on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dwell.study.study import Contender

if TYPE_CHECKING:
    import polars as pl

__all__ = ["TUNING_SEEDS", "best", "scores", "thinned"]

Value = TypeVar("Value")

#: Held-out seeds that a setting is tried on, at most; all scenarios together are many runs.
TUNING_SEEDS = 5


def thinned(values: Sequence[Value], count: int) -> tuple[Value, ...]:
    """Return at most `count` of the values, evenly spread, both ends among them.

    Parameters
    ----------
    values : sequence
    count : int
        At least 2.
    """
    if len(values) <= count:
        return tuple(values)
    places = np.linspace(0, len(values) - 1, count)
    return tuple(values[round(float(place))] for place in places)


def scores(runs: pl.DataFrame, column: str) -> dict[str, float]:
    """Return the mean over scenarios of the mean over seeds, by policy; less is better.

    Parameters
    ----------
    runs : DataFrame
        Of a study with one point.
    column : str
    """
    import polars as pl

    # Every scenario counts alike, however many of its runs there are.
    means = runs.group_by("policy", "scenario", maintain_order=True).agg(pl.col(column).mean())
    found = means.group_by("policy", maintain_order=True).agg(pl.col(column).mean())
    return dict(found.rows())


def best(
    contenders: Sequence[Contender],
    score: Mapping[str, float],
    among: Callable[[Contender], bool] = lambda _: True,
) -> Contender:
    """Return the contender with the least score, the first of equals.

    Parameters
    ----------
    contenders : sequence of Contender
    score : mapping of str to float
        By the contenders' names.
    among : callable
        Which of them may be chosen; at least one.
    """
    return min(filter(among, contenders), key=lambda one: score[one.name])
