"""Probe: measures the lateness of a process that needs little CPU time, and the CPU's speed.

The probe sleeps 5 ms at a time, and records how late it wakes. It has normal priority, and its
control group has a node's weight but no quota. Nodes within their quotas delay it by less than a
quota's period; a stalled or overloaded machine delays it more. After every fifth sleep (25 ms) it
does a fixed piece of work, whose CPU time shows the speed of a shared machine's CPU.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import time
from collections.abc import Sequence
from typing import NamedTuple

from dwell.live.local.child import Child, Parent

SLEEP_NS = 5_000_000
#: Wakes per piece of work, and turns of its loop (about 0.1 ms).
WORK_EVERY, WORK_TURNS = 5, 2_000


class Lateness(NamedTuple):
    """Largest lateness of a probe, and the mean CPU time of its work (None if it did no work)."""

    max_ms: float
    work_ms: float | None


class Probe(Child):
    """Context manager that runs a probe on one CPU.

    Parameters
    ----------
    prefix : sequence of str
        Command prefix of its process.
    """

    def __init__(self, cpu: int, prefix: Sequence[str] = ()) -> None:
        self.cpu = cpu
        super().__init__("dwell_lab.testbed.probe", f"probe of CPU {cpu}", cpu, prefix=prefix)

    def read(self) -> Lateness:
        """Return the measurements since the last call; raise a LiveError if it does not run."""
        longest_ns, works, work_ns = self.ask(None)
        return Lateness(longest_ns / 1e6, work_ns / works / 1e6 if works else None)


def main() -> None:
    """Measure until the parent ends."""
    parent = Parent()
    with contextlib.suppress(EOFError):
        os.sched_setaffinity(0, [parent.receive()])
        parent.answer(None)
        gc.freeze()
        _measure(parent)


def _measure(parent: Parent) -> None:
    longest_ns, wakes, works, work_ns = 0, 0, 0, 0
    due_ns = time.monotonic_ns() + SLEEP_NS
    while parent.alive:
        wait_s = max(due_ns - time.monotonic_ns(), 0) / 1e9
        asked, _, _ = select.select([parent], [], [], wait_s)
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns:
            longest_ns, wakes = max(longest_ns, now_ns - due_ns), wakes + 1
            if wakes % WORK_EVERY == 0:
                works, work_ns = works + 1, work_ns + _work_ns()
            due_ns = time.monotonic_ns() + SLEEP_NS
        if asked:
            parent.receive()
            parent.answer((longest_ns, works, work_ns))
            longest_ns, works, work_ns = 0, 0, 0


def _work_ns() -> int:
    """Do the piece of work; return its CPU time.

    It uses only small numbers, which Python caches. Other numbers are allocated; in a process whose
    heap is at the edge of a pool, this would always take twice as long.
    """
    begun_ns, value = time.thread_time_ns(), 1
    for _ in range(WORK_TURNS):
        value = value * 3 & 0x3F | 1
    return time.thread_time_ns() - begun_ns


if __name__ == "__main__":
    main()
