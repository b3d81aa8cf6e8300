"""Waiting until something holds."""

from __future__ import annotations

import time
from collections.abc import Callable

# Longer than a machine under load ever needs; a test that passes never waits so long.
PATIENCE_S = 120.0


def wait_until(
    holds: Callable[[], object], what: str = "it", *, patience_s: float = PATIENCE_S
) -> None:
    """Look until something holds."""
    deadline = time.monotonic() + patience_s
    while not holds():
        assert time.monotonic() < deadline, f"{what} has not come true within {patience_s:g} s"
        time.sleep(0.002)
