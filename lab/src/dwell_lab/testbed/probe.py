"""Probe: how late a process that wants little of a CPU gets it, and how fast it is then.

It sleeps 5 ms, and notes how much later than that it runs again: at normal priority, in a group as
weighty as the nodes' and without a quota. Nodes that use what their quotas grant make it late by
less than one period of a quota; a machine that stands still, or has more to do than it can, makes
it later. Every 25 ms it does a fixed piece of work: what that takes of the CPU's time says how fast
the CPU is, on a machine that others share.
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
#: Wakes between two pieces of work, and turns of its loop: about 0.1 ms.
WORK_EVERY, WORK_TURNS = 5, 2_000


class Lateness(NamedTuple):
    """Longest lateness of a probe, and the mean CPU time of its work; None where it did none."""

    max_ms: float
    work_ms: float | None


class Probe(Child):
    """Measures on one CPU until it is stopped; a context manager.

    Parameters
    ----------
    prefix : sequence of str
        First words of its command.
    """

    def __init__(self, cpu: int, prefix: Sequence[str] = ()) -> None:
        self.cpu = cpu
        super().__init__("dwell_lab.testbed.probe", f"probe of CPU {cpu}", cpu, prefix=prefix)

    def read(self) -> Lateness:
        """Return how late it was since this was last asked.

        Raises
        ------
        LiveError
            If it does not run.
        """
        longest_ns, works, work_ns = self.ask(None)
        return Lateness(longest_ns / 1e6, work_ns / works / 1e6 if works else None)


def main() -> None:
    """Sleep, and note how long, until the parent ends."""
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
    """Do the piece of work; returns the CPU time that it took.

    Its numbers are small ones, which Python keeps: others are allocated, and where a process's heap
    stands at the edge of a pool, that takes twice as long, for as long as the process lives.
    """
    begun_ns, value = time.thread_time_ns(), 1
    for _ in range(WORK_TURNS):
        value = value * 3 & 0x3F | 1
    return time.thread_time_ns() - begun_ns


if __name__ == "__main__":
    main()
