"""How much is simulated: the same designs in full, for a look, or as little as they work with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import yaml

Value = TypeVar("Value")

SCALES = Path(__file__).parent / "scales.yaml"

#: Seeds that parameters are tuned on begin after this one; no comparison uses them.
HELD_OUT = 1000
#: Seeds of the comparisons behind maps begin after this one. None was played before the margins of
#: the questions were written down.
FRESH = 2000


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
    def fresh_seeds(self) -> tuple[int, ...]:
        """Seeds of a comparison with a margin."""
        return tuple(FRESH + seed for seed in self.all_seeds)

    @property
    def some_seeds(self) -> tuple[int, ...]:
        """Seeds of a grid: the first of those of a comparison."""
        return tuple(range(1, self.grid_seeds + 1))

    @property
    def held_out(self) -> tuple[int, ...]:
        """Seeds that parameters are tuned on, and nothing else is done on."""
        return tuple(HELD_OUT + seed for seed in range(1, self.tuning_seeds + 1))


def scale_of(name: str) -> Scale:
    """Return a scale of ``scales.yaml``."""
    return Scale(**yaml.safe_load(SCALES.read_text(encoding="utf-8"))[name])


def thinned(values: Sequence[Value], count: int) -> tuple[Value, ...]:
    """Return at most `count` of the values, evenly spread, both ends among them."""
    if len(values) <= count:
        return tuple(values)
    places = np.linspace(0, len(values) - 1, count)
    return tuple(values[round(float(place))] for place in places)
