"""Log: what went wrong, without its floods."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress

__all__ = ["Log"]


class Log:
    """Passes on a line a second at most, and says how many it has left out.

    Parameters
    ----------
    say : callable
        Takes the lines.
    every_s : float
    clock : callable
        Seconds.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        every_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._say, self._every_s, self._clock = say, every_s, clock
        self._next_s = float("-inf")
        self._left_out = 0
        self._lock = threading.Lock()

    def __call__(self, line: str) -> None:
        """Take a line."""
        with self._lock:
            now_s = self._clock()
            if now_s < self._next_s:
                self._left_out += 1
                return
            more = f" (and {self._left_out} lines before it)" if self._left_out else ""
            self._next_s, self._left_out = now_s + self._every_s, 0
        # A log on a disk that is full must not end who writes it.
        with suppress(OSError):
            self._say(f"{line}{more}")
