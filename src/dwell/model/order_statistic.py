"""Percentiles that are never interpolated: the ceil(p n / 100)-th smallest of n values."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.generic)
Count = TypeVar("Count", int, NDArray[np.int64])


def rank_of(percent: int, count: Count) -> Count:
    """Return ceil(percent n / 100), in integers: 0.95 * n is not exact."""
    return -(-percent * count // 100)


def order_statistic(values: NDArray[Number], percent: int) -> NDArray[Number]:
    """Return the percentile along the last axis, which has at least one value."""
    rank = rank_of(percent, values.shape[-1])
    return np.partition(values, rank - 1, axis=-1)[..., rank - 1]


def order_statistic_of_smallest(
    values: NDArray[Number], percent: int, counts: NDArray[np.int64]
) -> NDArray[Number]:
    """Return the percentile of the `counts` smallest values of each row; of none, the smallest."""
    place = np.maximum(rank_of(percent, counts), 1) - 1
    ordered = np.partition(values, np.unique(place), axis=1)
    return np.take_along_axis(ordered, place[:, None], axis=1)[:, 0]


def percentile(values: NDArray[Number], percent: int) -> float:
    """Return the percentile of values in one dimension, as a plain number."""
    return float(order_statistic(values, percent))
