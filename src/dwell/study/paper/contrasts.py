"""Contrasts: two groups of a study's runs, compared seed by seed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.errors import SimulationError
from dwell.study.family import Difference, Family
from dwell.study.intervals import Interval, median_interval, share_interval
from dwell.study.over_seeds import interval_of
from dwell.study.paired import paired_difference, paired_median

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Contrast", "Labels", "contrast", "family_of", "interval", "values"]

Floats: TypeAlias = NDArray[np.float64]

#: Columns of runs and what they have to be, for one run a seed to be left.
Labels: TypeAlias = Mapping[str, object]
Contrast: TypeAlias = "tuple[Labels, Labels]"


def values(runs: pl.DataFrame, column: str, labels: Labels) -> Floats:
    """Return one number a seed, in the order of the seeds.

    Parameters
    ----------
    runs : DataFrame
        See `dwell.study.StudyResult`.
    column : str
    labels : mapping of str to object
        Leave one run a seed.

    Raises
    ------
    SimulationError
        If they leave none, or several a seed.
    """
    import polars as pl

    mine = runs.filter(*(pl.col(name) == value for name, value in labels.items()))
    if mine.is_empty() or mine["seed"].n_unique() != mine.height:
        raise SimulationError(
            f"{dict(labels)} leaves {mine.height} runs of {mine['seed'].n_unique()} seeds; it must "
            "leave one a seed"
        )
    return mine.sort("seed")[column].cast(pl.Float64).to_numpy()


def interval(runs: pl.DataFrame, column: str, labels: Labels) -> Interval:
    """Return a column over seeds with the interval that it takes everywhere."""
    return interval_of(column)(values(runs, column, labels))


def contrast(runs: pl.DataFrame, column: str, pair: Contrast) -> Difference:
    """Compare the first of a pair to the second; by medians where a column may be infinite."""
    first, second = (values(runs, column, labels) for labels in pair)
    if interval_of(column) is median_interval:
        return paired_median(first, second)
    return paired_difference(first, second, shares=interval_of(column) is share_interval)


def family_of(
    runs: pl.DataFrame, question: str, column: str, pairs: Mapping[str, Contrast]
) -> Family:
    """Compare a column of all pairs that answer one question.

    Parameters
    ----------
    runs : DataFrame
    question, column : str
    pairs : mapping of str to (labels, labels)
        By a name; the first of each is what its verdict is about.
    """
    found = {name: contrast(runs, column, pair) for name, pair in pairs.items()}
    return Family(question, column, found)
