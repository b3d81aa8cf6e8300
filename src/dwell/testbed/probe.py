"""Probe: how late a process that wants little of a CPU gets it.

It sleeps 5 ms, and notes how much later than that it runs again: at normal priority, in a group as
weighty as the nodes' and without a quota. Nodes that use what their quotas grant make it late by
less than one period of a quota; a machine that stands still, or has more to do than it can, makes
it later.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from dwell.testbed.child import Child, Parent, Started

__all__ = ["Lateness", "Probe"]

SLEEP_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late a probe ran.

    Parameters
    ----------
    wakes : int
    mean_ms, max_ms : float
    """

    wakes: int
    mean_ms: float
    max_ms: float


class Probe(Started):
    """Measures on one CPU until it is stopped; a context manager.

    Parameters
    ----------
    cpu : int
    prefix : sequence of str
        First words of its command.
    """

    def __init__(self, cpu: int, prefix: Sequence[str] = ()) -> None:
        self.cpu = cpu
        self._child = Child("dwell.testbed.probe", f"probe of CPU {cpu}", prefix=prefix)

    def start(self) -> None:
        """Start it.

        Raises
        ------
        LiveError
            If it does not start.
        """
        self._child.start({"cpu": self.cpu})

    def stop(self) -> None:
        """End it; safe to call twice."""
        self._child.stop()

    def read(self) -> Lateness:
        """Return how late it was since this was last asked.

        Raises
        ------
        LiveError
            If it does not run.
        """
        found = cast("dict[str, float]", self._child.ask({}))
        wakes = int(found["wakes"])
        return Lateness(wakes, found["late_ns"] / max(wakes, 1) / 1e6, found["max_ns"] / 1e6)


def main() -> None:
    """Sleep, and note how long, until the parent ends."""
    parent = Parent()
    with contextlib.suppress(EOFError):
        os.sched_setaffinity(0, [cast("int", parent.receive()["cpu"])])
        parent.answer({})
        gc.freeze()
        _measure(parent)


def _measure(parent: Parent) -> None:
    wakes = late_ns = max_ns = 0
    due_ns = time.monotonic_ns() + SLEEP_NS
    while parent.alive:
        wait_s = max(due_ns - time.monotonic_ns(), 0) / 1e9
        asked, _, _ = select.select([parent], [], [], wait_s)
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns:
            late = now_ns - due_ns
            wakes, late_ns, max_ns = wakes + 1, late_ns + late, max(max_ns, late)
            due_ns = now_ns + SLEEP_NS
        if asked:
            parent.receive()
            parent.answer({"wakes": wakes, "late_ns": late_ns, "max_ns": max_ns})
            wakes = late_ns = max_ns = 0


if __name__ == "__main__":
    main()
