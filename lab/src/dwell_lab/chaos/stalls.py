"""Stalls: times in which the machine did not schedule a thread that only sleeps."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Collection

from dwell.live.local.child import Started


class StallDetector(Started):
    """Context manager with one thread per CPU that records when it was scheduled too late.

    The cell's processes have the same priority: if a thread here is late, they are late as well.
    """

    STEP_S = 0.004

    def __init__(self) -> None:
        super().__init__()
        self.stalls: list[tuple[int, int, int]] = []
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=self._watch, args=(cpu,), daemon=True)
            for cpu in sorted(os.sched_getaffinity(0))
        ]

    def _start(self) -> None:
        for thread in self._threads:
            thread.start()
            self._stack.callback(thread.join)
            self._stack.callback(self._stopped.set)

    def _watch(self, cpu: int) -> None:
        os.sched_setaffinity(0, {cpu})
        before_ns = time.monotonic_ns()
        while not self._stopped.is_set():
            time.sleep(self.STEP_S)
            now_ns = time.monotonic_ns()
            if now_ns - before_ns > 3 * self.STEP_S * 1e9:
                self.stalls.append((before_ns, now_ns, cpu))
            before_ns = now_ns

    def worst_ms(self, since_ns: int, until_ns: int, *, but: Collection[int] = ()) -> float:
        """Return the longest stall that overlaps an interval, except on the CPUs in `but`."""
        lengths = [
            b - a for a, b, cpu in self.stalls if b >= since_ns and a <= until_ns and cpu not in but
        ]
        return max(lengths, default=0) / 1e6
