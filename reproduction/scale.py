"""How much is simulated: the same designs in full, for a look, or as little as they work with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

__all__ = ["FULL", "QUICK", "TINY", "Scale", "thinned"]

Value = TypeVar("Value")

#: Seeds that parameters are tuned on begin after this one; no comparison uses them.
HELD_OUT = 1000


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is simulated.

    Parameters
    ----------
    seeds : int
        Seeds of a comparison: 1 to this.
    windows : int
        Length of a run in a steady scenario, the warm-up included.
    dynamic_windows : int
        The same in a dynamic one; a timetable takes 300 windows.
    grid : int
        Points along each axis of a map.
    grid_seeds : int
        Seeds of a grid, a map or a sweep, whose points share what one comparison has alone.
    sobol_n, sobol_seeds, sobol_windows : int
        Base points of a Sobol design (a power of two), seeds of every point, length of its runs.
    tuning_seeds : int
        Seeds that parameters are tuned on.
    """

    seeds: int
    windows: int
    dynamic_windows: int
    grid: int
    grid_seeds: int
    sobol_n: int
    sobol_seeds: int
    sobol_windows: int
    tuning_seeds: int

    @property
    def coarse(self) -> bool:
        """Whether an axis has a few of its values only."""
        return self.grid < 5

    @property
    def all_seeds(self) -> tuple[int, ...]:
        """Seeds of a comparison."""
        return tuple(range(1, self.seeds + 1))

    @property
    def some_seeds(self) -> tuple[int, ...]:
        """Seeds of a grid: the first of those of a comparison."""
        return tuple(range(1, self.grid_seeds + 1))

    @property
    def held_out(self) -> tuple[int, ...]:
        """Seeds that parameters are tuned on, and nothing else is done on; five at most."""
        return tuple(range(HELD_OUT + 1, HELD_OUT + 1 + min(self.tuning_seeds, 5)))


FULL = Scale(
    seeds=20,
    windows=150,
    dynamic_windows=300,
    grid=9,
    grid_seeds=12,
    sobol_n=32,
    sobol_seeds=3,
    sobol_windows=60,
    tuning_seeds=10,
)
#: Every question is asked, and hardly anything can be shown.
QUICK = Scale(
    seeds=3,
    windows=20,
    dynamic_windows=60,
    grid=3,
    grid_seeds=2,
    sobol_n=2,
    sobol_seeds=2,
    sobol_windows=15,
    tuning_seeds=2,
)
#: The least that every design works with; its numbers mean nothing.
TINY = Scale(
    seeds=2,
    windows=7,
    dynamic_windows=7,
    grid=2,
    grid_seeds=2,
    sobol_n=2,
    sobol_seeds=2,
    sobol_windows=7,
    tuning_seeds=2,
)


def thinned(values: Sequence[Value], count: int) -> tuple[Value, ...]:
    """Return at most `count` of the values, evenly spread, both ends among them."""
    if len(values) <= count:
        return tuple(values)
    places = np.linspace(0, len(values) - 1, count)
    return tuple(values[round(float(place))] for place in places)
