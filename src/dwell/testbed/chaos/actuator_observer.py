"""ActuatorObserver: hears a cell through its own sessions, and judges what it hears."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from dwell.errors import LiveError
from dwell.testbed.chaos.invariants import Judge
from dwell.testbed.chaos.wiretap import Records, Wiretap
from dwell.testbed.testbed import LocalTestbed

__all__ = ["ActuatorObserver"]

HEARD_S = 20.0


class ActuatorObserver:
    """Ears wherever they are needed, and a judge; a context manager.

    Parameters
    ----------
    testbed : LocalTestbed
        That runs.
    cell : Path
        Its cell file.
    """

    def __init__(self, testbed: LocalTestbed, cell: Path) -> None:
        self.judge = Judge(testbed.problem)
        self._taps: list[Wiretap] = []
        self._records: list[Records] = []
        self._stack = ExitStack()
        for nodes, prefix in testbed.taps().items():
            out = testbed.folder / f"heard-{'-'.join(nodes)}"
            self._taps.append(Wiretap(cell, nodes, out, prefix))
            self._records.append(Records(out))

    def __enter__(self) -> Self:
        """Begin to listen; returns when something has been heard.

        Raises
        ------
        LiveError
            If nothing is.
        """
        try:
            for tap in self._taps:
                self._stack.enter_context(tap)
            until = time.monotonic() + HEARD_S
            while not {"stamped", "done", "in"} <= self.judge.counts.keys():
                if time.monotonic() > until:
                    raise LiveError(f"of the cell only {sorted(self.judge.counts)} is heard")
                time.sleep(0.05)
                self.look()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End."""
        self._stack.close()

    def look(self) -> list[str]:
        """Return what is wrong with what has been heard since the last time."""
        news = [one for records in self._records for one in records.news()]
        news.sort(key=lambda one: one[0])
        found = [wrong for one in news for wrong in self.judge.hear(*one)]
        return found + self.judge.migrations()
