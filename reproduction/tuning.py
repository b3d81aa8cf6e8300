"""Tuning: the best of several contenders on seeds that nothing is reported on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import polars as pl

from dwell.study import Contender

__all__ = ["best", "scores"]


def scores(runs: pl.DataFrame, column: str) -> dict[str, float]:
    """Return the mean over scenarios of the mean over seeds, by policy; less is better."""
    # Every scenario counts alike, however many of its runs there are.
    means = runs.group_by("policy", "scenario", maintain_order=True).agg(pl.col(column).mean())
    found = means.group_by("policy", maintain_order=True).agg(pl.col(column).mean())
    return dict(found.rows())


def best(contenders: Sequence[Contender], score: Mapping[str, float]) -> Contender:
    """Return the contender with the least score, the first of equals."""
    return min(contenders, key=lambda one: score[one.name])
