"""Cycles in which tasks are needed: waited flows lead from them to a sink that is due."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from dwell.model.pipeline import Pipeline

Mask: TypeAlias = NDArray[np.bool_]


class NeededCycles:
    """The cycles of a run in which tasks are needed.

    Attributes
    ----------
    of : mapping of str to bool array, shape (cycles,)
        Cycles in which each task is needed; None for all cycles.
    due : bool array, shape (cycles,)
        Cycles in which a sink is due; None for all cycles.
    """

    def __init__(self, pipeline: Pipeline, cycles: int) -> None:
        rates = pipeline.sink_rates
        self.of = {name: _multiples(rates[name], cycles) for name in rates}
        sinks = {every for name in pipeline.sinks for every in rates[name]}
        self.due = _multiples(tuple(sinks), cycles)

    def __repr__(self) -> str:
        return f"<NeededCycles of {', '.join(self.of)}>"

    def is_never(self, name: str) -> bool:
        """Whether a task is needed in no cycle."""
        needed = self.of[name]
        return needed is not None and not needed.any()


def _multiples(rates: tuple[int, ...], cycles: int) -> Mask | None:
    """Return the cycles that are multiples of a rate; None for all cycles."""
    if 1 in rates:
        return None
    found = np.zeros(cycles, np.bool_)
    for every in rates:
        found[::every] = True
    return found
