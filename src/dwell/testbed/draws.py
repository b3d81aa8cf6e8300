"""What is drawn on the way along one direction of an emulated link."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dwell.testbed.conditions import Conditions, changed, delays_ns

__all__ = ["Draws"]


class Draws:
    """Conditions that may change, and streams of their own for each delay and for losses.

    Parameters
    ----------
    seed : (int, int)
        Of the link, and of the direction.
    """

    def __init__(self, seed: tuple[int, int]) -> None:
        self.conditions = Conditions()
        delays, added, losses = np.random.default_rng(seed).spawn(3)
        self._rngs = {"delay_ms": delays, "add_delay_ms": added}
        self._delays = {name: self._drawn(name) for name in self._rngs}
        self._losses = losses

    def _drawn(self, name: str) -> Iterator[int]:
        return delays_ns(getattr(self.conditions, name), self._rngs[name])

    def apply(self, changes: dict[str, object]) -> None:
        """Change conditions, as `to_json` has written them."""
        before = self.conditions
        self.conditions = changed(before, changes)
        for name in self._rngs:
            if getattr(before, name) != getattr(self.conditions, name):
                self._delays[name] = self._drawn(name)

    def lose(self) -> bool:
        """Decide whether what comes next is lost."""
        return self.conditions.loss > 0 and self._losses.random() < self.conditions.loss

    def delay_ns(self) -> int:
        """Draw a delay."""
        return sum(map(next, self._delays.values()))
