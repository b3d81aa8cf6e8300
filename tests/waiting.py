"""Waiting until something holds."""

from __future__ import annotations

import time
from collections.abc import Callable

# Longer than a machine under load ever needs; a test that passes never waits so long.
PATIENCE_S = 120.0


def wait_until(holds: Callable[[], bool]) -> None:
    """Look until something holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline, "it has not come true"
        time.sleep(0.002)
