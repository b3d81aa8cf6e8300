"""Stages to measure: the example of docs/howto/profiling.md."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FRAMES = [np.random.default_rng(seed).random((240, 320)) for seed in range(20)]


def frame(run: int) -> NDArray[np.float64]:
    """Return the camera frame of a run: the same one for run k on every node."""
    return FRAMES[run % len(FRAMES)]


def perceive(image: NDArray[np.float64]) -> tuple[float, float]:
    """Find the brightest spot, by a blur of 5 x 5 pixels."""
    total = np.cumsum(np.cumsum(image, axis=0), axis=1)
    blurred = total[5:, 5:] - total[:-5, 5:] - total[5:, :-5] + total[:-5, :-5]
    row, column = divmod(int(blurred.argmax()), blurred.shape[1])
    return row + 2.5, column + 2.5


def plan() -> list[float]:
    """Return the angles of a path of 500 points around the origin."""
    points = ((math.cos(0.01 * step), math.sin(0.02 * step)) for step in range(500))
    return [math.atan2(y, x) for x, y in points]
