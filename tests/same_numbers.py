"""Prints digests of numbers that runs depend on; test_processors.py compares them."""

from __future__ import annotations

import hashlib
import math
import random
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dwell.estimators.pool import PlaceSums, Reference
from dwell.model import AR1, LogNormal, Normal

rng = random.Random(1)
#: Exact logarithms take 0.1 ms each. Of these 10,000 three have another `math.log1p` without FMA.
MOMENTS = [(rng.uniform(1e-3, 1e3), rng.uniform(1e-4, 10)) for _ in range(20_000)][10_000:]


def libm() -> list[float]:
    """Depends on the processor, which shows that the others would, too."""
    return [math.log1p(cv * cv) for _, cv in MOMENTS]


def numpy() -> NDArray[np.float64]:
    """Depends on the processor, too."""
    return np.log1p(np.array(MOMENTS, np.float64))


def log_parameters() -> list[tuple[float, float]]:
    return [LogNormal(*moments).log_parameters for moments in MOMENTS]


def correlations() -> list[float]:
    return [AR1(*moments, 0.5).log_correlation for moments in MOMENTS]


def means_of_clipped_normals() -> list[float]:
    return [Normal(*moments).expectation for moments in MOMENTS]


def likeness() -> list[float]:
    rng = np.random.default_rng(1)
    values = rng.uniform(1, 2, (1_000, 20, 1)) * rng.uniform(1, 3, (1_000, 20, 10))
    return [Reference(one.ravel(), 10).likeness for one in values]


def deviations() -> list[float]:
    sums = (PlaceSums(k, k * cv, 0.5 * k, 0.5 * k) for k, (_, cv) in enumerate(MOMENTS, 1))
    return [one.deviations(0.1) for one in sums]


NUMBERS: tuple[Callable[[], object], ...] = (
    *(libm, numpy),
    *(log_parameters, correlations, means_of_clipped_normals, likeness, deviations),
)

if __name__ == "__main__":
    for function in NUMBERS:
        digest = hashlib.sha256(np.array(function(), np.float64).tobytes()).hexdigest()
        print(function.__name__, digest)
