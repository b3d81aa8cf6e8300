"""What is drawn on the way along one direction of an emulated link."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dwell.testbed.conditions import Conditions, changed, delays_ns


class Draws:
    """Conditions that may change, and streams of their own for each delay and for losses.

    A stream goes on for as long as its process stays, whether it counts or not.

    Parameters
    ----------
    seed : (int, int)
        Of the link, and of the direction.
    """

    def __init__(self, seed: tuple[int, int]) -> None:
        self.conditions = Conditions()
        self._delays_rng, self._added_rng, self._losses = np.random.default_rng(seed).spawn(3)
        self._delays = delays_ns(self.conditions.delay_ms, self._delays_rng)
        self._added: list[Iterator[int]] = []

    def apply(self, changes: dict[str, object]) -> None:
        """Change conditions, as `to_json` has written them."""
        before, now = self.conditions, changed(self.conditions, changes)
        self.conditions = now
        if before.delay_ms != now.delay_ms:
            self._delays = delays_ns(now.delay_ms, self._delays_rng)
        if before.add_delays_ms != now.add_delays_ms:
            rngs = self._added_rng.spawn(len(now.add_delays_ms))
            pairs = zip(now.add_delays_ms, rngs, strict=True)
            self._added = [delays_ns(process, rng) for process, rng in pairs]

    def lose(self) -> bool:
        """Decide whether what comes next is lost."""
        return self.conditions.loss > 0 and self._losses.random() < self.conditions.loss

    def delay_ns(self) -> int:
        """Draw a delay."""
        shares = zip(self._added, self.conditions.shares, strict=True)
        return next(self._delays) + sum(round(next(added) * share) for added, share in shares)
