"""Waiting until something holds."""

from __future__ import annotations

import time
from collections.abc import Callable

# Longer than a machine under load ever needs; a test that passes never waits so long.
PATIENCE_S = 120.0


# Shortest and longest pause between two looks, seconds.
PAUSES_S = 0.002, 0.1


def wait_until(
    holds: Callable[[], object], what: str = "it", *, patience_s: float = PATIENCE_S
) -> None:
    """Look until something holds."""
    begin_s = time.monotonic()
    while not holds():
        waited_s = time.monotonic() - begin_s
        assert waited_s < patience_s, f"{what} has not come true within {patience_s:g} s"
        pause(waited_s)


def pause(waited_s: float) -> None:
    """Sleep for a tenth of the time waited: looks take CPU from what a test waits for."""
    shortest_s, longest_s = PAUSES_S
    time.sleep(min(max(shortest_s, waited_s / 10), longest_s))
