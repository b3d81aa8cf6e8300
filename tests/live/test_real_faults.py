"""Faults of real processes over real Zenoh: each once, seeded, seen by an observer at the actuator.

`python -m tests.live.faults` has many of each, and says what they cost.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.errors import LiveError
from tests.live.real_cell import FAULTS, HOMES, PERIOD_MS, RealCell, StallDetector, mixed, strike

pytestmark = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2,
    reason="twenty processes that must keep to a period of 40 ms need two CPUs",
)
SEED = 1


class Cells:
    """The cell that is up; another one when it is asked for, or has failed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cell: RealCell | None = None
        self._count = 0

    def at(self, home: str) -> RealCell:
        if self.cell is None or self.cell.home != home:
            self.close()
            self._count += 1
            self.cell = RealCell(home, self.folder / str(self._count), seed=SEED)
            self.cell.__enter__()
        return self.cell

    def close(self) -> None:
        cell, self.cell = self.cell, None
        if cell is not None:
            cell.close()


@pytest.fixture(scope="module")
def stalls() -> Iterator[StallDetector]:
    with StallDetector() as detector:
        yield detector


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cells]:
    made = Cells(tmp_path_factory.mktemp("cells"))
    yield made
    made.close()


@pytest.mark.parametrize("name", [fault.name for home in HOMES for fault in mixed(home)])
def test_a_cell_survives(name: str, cells: Cells, stalls: StallDetector) -> None:
    fault = FAULTS[name]
    drawn = random.Random(f"{SEED} {name}")
    phase, lasts = drawn.random(), drawn.randint(12, 20)
    for attempt in (1, 2):
        cell = cells.at(fault.home)
        try:
            outcome = strike(cell, fault, stalls, phase=phase, seed=SEED, lasts=lasts)
            wrong = [*outcome.wrong, *cell.check_run()]
        except LiveError as error:
            wrong = [str(error)]
        if not wrong:
            return
        # What went wrong once may do so for the rest of the cell's life.
        cells.close()
        stall_ms = stalls.worst_ms(0, 1 << 62)
        stalls.stalls.clear()
        # A machine that has kept a thread that only sleeps from running for a whole period has kept
        # the cell's processes, too: no bound in cycles can hold then, and it is tried once more.
        if attempt == 2 or stall_ms < PERIOD_MS:
            pytest.fail(f"{name}, phase {phase:.2f}: {'; '.join(wrong)} (stall {stall_ms:.0f} ms)")


@pytest.mark.parametrize("home", HOMES)
def test_the_run_is_whole_after_all_of_it(home: str, tmp_path: Path, stalls: StallDetector) -> None:
    with RealCell(home, tmp_path, seed=SEED) as cell:
        strike(cell, FAULTS["kill controller@E"], stalls, phase=0.5, seed=SEED, lasts=12)
        cell.stop_controller()
        assert not cell.check_run()
        assert (cell.runs[0] / "run.json").exists()
