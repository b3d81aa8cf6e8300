"""Loads: CPU counters of nodes and processes, interpolated between two reports."""

from __future__ import annotations

import bisect
from collections import Counter, deque
from collections.abc import Iterable

import numpy as np

from dwell.live.wire.continuity import OvershootDetector
from dwell.live.wire.messages import Load
from dwell.model.number_arrays import Floats

#: Largest number of reports kept per node or process.
KEPT = 4_096
#: Largest number of processes per node; more are not from the cell.
MOST_PROCESSES = 256


class NodeLoad:
    """Work of a node by its own clock.

    Core-nanoseconds of all work, of the cell's processes and of its shadows; nanoseconds for which
    its accelerator was busy, and for which a hook measured it.
    """

    def __init__(self) -> None:
        self._at_ns: deque[int] = deque(maxlen=KEPT)
        self._total: deque[Floats] = deque(maxlen=KEPT)
        self._life = -1
        self._read = np.zeros(3)
        self._overshoot = OvershootDetector()

    def report(self, load: Load) -> None:
        """Add a report; copies and late reports are ignored."""
        last_ns = self._at_ns[-1] if self._at_ns else -1
        if (load.life, load.at_ns) <= (self._life, last_ns):
            if not self._overshoot.behind(load.life, load.at_ns):
                return
            self._life = -1
        self._overshoot.advanced()
        read = np.array((load.busy_ns, load.own_ns, load.shadow_ns), np.float64)
        total = self._total[-1] if self._total else np.zeros(5)
        if load.life == self._life:
            told_ns = load.at_ns - self._at_ns[-1] if load.accelerator >= 0.0 else 0
            grown = np.maximum(read - self._read, 0.0)
            total = total + np.append(grown, (load.accelerator * told_ns, told_ns))
        elif load.at_ns <= last_ns:
            # The node's clock has restarted too, or the last instant was false.
            self._at_ns.clear()
            self._total.clear()
        self._life, self._read = load.life, read
        self._at_ns.append(load.at_ns)
        self._total.append(total)

    def at(self, instant_ns: int) -> Floats:
        """Return the work up to an instant, as in the class; shape (5,).

        Values between two reports are interpolated. Values outside are extrapolated by at most one
        interval between reports, after which a silent node counts as idle.
        """
        at_ns, total = self._at_ns, self._total
        if len(at_ns) < 2:
            return np.zeros(5)
        place = min(max(bisect.bisect(at_ns, instant_ns), 1), len(at_ns) - 1)
        begin_ns, end_ns = at_ns[place - 1], at_ns[place]
        share = min(max((instant_ns - begin_ns) / (end_ns - begin_ns), -1.0), 2.0)
        found: Floats = total[place - 1] + share * (total[place] - total[place - 1])
        return found

    def forget(self, before_ns: int) -> None:
        """Drop the reports that only earlier instants need."""
        while len(self._at_ns) > 2 and self._at_ns[1] < before_ns:
            self._at_ns.popleft()
            self._total.popleft()


class ProcessLoads:
    """CPU time of processes, by the clock of their node."""

    def __init__(self) -> None:
        self._of: dict[tuple[str, str], tuple[deque[int], deque[int]]] = {}
        self._read: dict[tuple[str, str], int] = {}
        self._count: Counter[str] = Counter()

    def report(self, node: str, at_ns: int, processes: Iterable[tuple[str, int]]) -> None:
        """Add the CPU time of a node's processes since their starts, ns."""
        for who, cpu_ns in processes:
            key = node, who
            if key not in self._of:
                if self._count[node] >= MOST_PROCESSES:
                    continue
                self._count[node] += 1
                self._of[key] = deque(maxlen=KEPT), deque(maxlen=KEPT)
            at, total = self._of[key]
            if at and at_ns < at[-1]:
                # The node's clock has restarted.
                at.clear()
                total.clear()
            elif at and at_ns == at[-1]:
                continue
            before = self._read.get(key, 0)
            # A restarted process counts from 0.
            grown = cpu_ns - before if cpu_ns >= before else cpu_ns
            at.append(at_ns)
            total.append((total[-1] if total else 0) + grown)
            self._read[key] = cpu_ns

    def between(self, node: str, begin_ns: int, end_ns: int) -> dict[str, float]:
        """Return the CPU time, ns, of every process of a node between two instants of its clock.

        Values between two reports are interpolated; outside the reports there is no use of CPU.
        """
        spent_ns = {}
        for (where, who), (at, total) in self._of.items():
            if where == node:
                first, last = np.interp((begin_ns, end_ns), list(at), list(total))
                spent_ns[who] = float(last - first)
                while len(at) > 2 and at[1] < begin_ns:
                    at.popleft()
                    total.popleft()
        return spent_ns
