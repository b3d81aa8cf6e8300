"""Faults of real processes over real Zenoh: each once, seeded, seen by an observer at the actuator.

Two cells live through them side by side, one whose controller wants to be on the edge and one whose
controller wants to be on the robots. `make faults` has many of each, and says what they cost.
"""

from __future__ import annotations

import os
import random
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import zip_longest
from pathlib import Path

import pytest

from dwell.errors import LiveError
from tests.live.real_cell import (
    FAULTS,
    HOMES,
    PERIOD_MS,
    Fault,
    RealCell,
    StallDetector,
    mixed,
    strike,
)

pytestmark = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2,
    reason="forty processes that must keep to a period of 40 ms need two CPUs",
)
SEED = 1
#: Without these the sink gets nothing, for longer than a command may be old.
WITHOUT_COMMANDS = ("control@R2", "control@R2.1")
ROUNDS = [
    tuple(fault for fault in pair if fault is not None)
    for pair in zip_longest(*(mixed(home) for home in HOMES))
]


class Cells:
    """The cells that are up, one for each home; another one where one has failed."""

    def __init__(self, folder: Path, stalls: StallDetector) -> None:
        self.folder, self.stalls = folder, stalls
        self.cells: dict[str, RealCell] = {}
        self._count = 0
        # Two that start at once would take the same ports for free.
        self._starts = threading.Lock()

    def at(self, home: str) -> RealCell:
        """Return the cell of a home, and start it where there is none."""
        with self._starts:
            if home not in self.cells:
                self._count += 1
                cell = RealCell(home, self.folder / f"{home}-{self._count}", seed=SEED)
                cell.__enter__()
                self.cells[home] = cell
            return self.cells[home]

    def close(self, home: str) -> list[str]:
        """End a cell; returns what is wrong with the record of its run."""
        cell = self.cells.pop(home, None)
        if cell is None:
            return []
        cell.stop_controller()
        wrong = cell.check_run()
        if not (cell.runs[0] / "run.json").exists():
            wrong.append("no run.json, though the controller was told to end")
        cell.close()
        return wrong

    def survive(self, fault: Fault) -> str:
        """Have a fault befall the cell of its home; returns what was wrong."""
        drawn = random.Random(f"{SEED} {fault.name}")
        phase, lasts = drawn.random(), drawn.randint(12, 15)
        for attempt in (1, 2):
            begin_ns = time.monotonic_ns()
            try:
                cell = self.at(fault.home)
                begin_ns = time.monotonic_ns()
                struck = strike(cell, fault, self.stalls, phase=phase, seed=SEED, lasts=lasts)
                wrong = [*struck.wrong, *cell.check_run()]
                if fault.whom == WITHOUT_COMMANDS and not struck.silences:
                    wrong.append("the actuator was never told that no command came")
            except LiveError as error:
                wrong = [str(error)]
            if not wrong:
                break
            # What went wrong once may do so for the rest of the cell's life.
            self.close(fault.home)
            stall_ms = self.stalls.worst_ms(begin_ns, time.monotonic_ns())
            # A machine that has kept a thread that only sleeps from running for a whole period has
            # kept the cell's processes, too: no bound in cycles can hold, and it is tried again.
            if attempt == 2 or stall_ms < PERIOD_MS:
                said = "; ".join(wrong)
                return f"{fault.name}, phase {phase:.2f}: {said} (stall {stall_ms:.0f} ms)"
        return ""


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cells]:
    with StallDetector() as stalls:
        made = Cells(tmp_path_factory.mktemp("cells"), stalls)
        yield made
        assert not [wrong for home in HOMES for wrong in made.close(home)]


@pytest.mark.parametrize("faults", ROUNDS, ids=lambda pair: ", ".join(f.name for f in pair))
def test_cells_survive(faults: tuple[Fault, ...], cells: Cells) -> None:
    with ThreadPoolExecutor(len(faults)) as side_by_side:
        wrong = list(side_by_side.map(cells.survive, faults))
    assert not any(wrong), "\n".join(filter(None, wrong))


def test_every_fault_has_its_turn() -> None:
    assert {fault.name for pair in ROUNDS for fault in pair} == FAULTS.keys()
