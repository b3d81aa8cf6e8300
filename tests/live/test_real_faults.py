"""Faults of real processes over real Zenoh, seeded, seen by an observer at the actuator.

One cell at a time lives through them: first one whose controller wants to be on the edge, then one
whose controller wants to be on the robots. `make faults` has many of each, and says what they cost.
Each fault takes seconds of the whole machine, so a process is killed or frozen here, and not both.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell_lab.chaos.light_cell import EXEC_MS, MAX_AGE_MS, PERIOD_MS
from dwell_lab.chaos.stalls import StallDetector
from dwell_lab.chaos.strike import Outcome
from tests.live.real_cell import FAULTS, HomeFault, RealCell, mixed, strike

pytestmark = pytest.mark.skipif(
    len(os.sched_getaffinity(0)) < 2,
    reason="twenty processes that must keep to a period of 40 ms need two CPUs",
)
SEED = 1
#: Without these the sink gets nothing.
WITHOUT_COMMANDS = ("control@R2", "control@R2.1")
#: Faults that `make faults` alone has: each is of a kind that another fault here has, and strikes a
#: process or a link that another fault here strikes.
ELSEWHERE = {
    *("freeze perception@E", "freeze controller@E", "freeze agent@R1", "freeze sensing@R1"),
    *("kill planning@E", "kill agent@E", "kill agent@R2", "kill control@R2", "freeze all of E"),
    *("kill perception@R1", "freeze planning@R2", "freeze sensing@R1 and its standby"),
    *("kill control@R2 and its standby", "freeze stamper@R1", "kill sink.control@R2"),
    *("kill all of R2", "cut R1->E", "cut E->R2", "cut R2->E", "cut R2->R1"),
}
IN_TURN = [fault for home in EXEC_MS for fault in mixed(home) if fault.name not in ELSEWHERE]


def told_nothing(struck: Outcome) -> bool:
    """Whether no command came for longer than one may be old, and the actuator was not told.

    A process that was killed may be there again before that; one that is frozen is not.
    """
    longest_ms = max(struck.gap_ms, struck.gap_after_ms)
    silent = struck.fault.startswith("freeze") or longest_ms > MAX_AGE_MS + PERIOD_MS
    return silent and not struck.silences


class Standing:
    """The cell that is up; another one where it has failed, or where another home is wanted."""

    def __init__(self, folder: Path, stalls: StallDetector) -> None:
        self.folder, self.stalls = folder, stalls
        self._cell: RealCell | None = None
        self._count = 0

    def at(self, home: str) -> RealCell:
        """Return the cell of a home, and start it where there is none."""
        if self._cell is not None and self._cell.home != home:
            wrong = self.close()
            assert not wrong, wrong
        if self._cell is None:
            self._count += 1
            cell = RealCell(home, self.folder / f"{home}-{self._count}", seed=SEED)
            cell.start()
            self._cell = cell
        return self._cell

    def close(self) -> list[str]:
        """End the cell; returns what is wrong with the record of its run."""
        cell, self._cell = self._cell, None
        if cell is None:
            return []
        cell.testbed.processes.stop_controller()
        wrong = cell.check_run()
        if not (cell.runs[0] / "run.json").exists():
            wrong.append("no run.json, though the controller was told to end")
        cell.stop()
        return wrong

    def survive(self, fault: HomeFault) -> str:
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
                if fault.whom == WITHOUT_COMMANDS and told_nothing(struck):
                    wrong.append("the actuator was never told that no command came")
            except LiveError as error:
                wrong = [str(error)]
            if not wrong:
                break
            # What went wrong once may do so for the rest of the cell's life.
            self.close()
            stall_ms = self.stalls.worst_ms(begin_ns, time.monotonic_ns())
            # A machine that has kept a thread that only sleeps from running for a whole period has
            # kept the cell's processes, too: no bound in cycles can hold, and it is tried again.
            if attempt == 2 or stall_ms < PERIOD_MS:
                said = "; ".join(wrong)
                return f"{fault.name}, phase {phase:.2f}: {said} (stall {stall_ms:.0f} ms)"
        return ""


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Standing]:
    with StallDetector() as stalls:
        made = Standing(tmp_path_factory.mktemp("cells"), stalls)
        yield made
        wrong = made.close()
        assert not wrong, wrong


@pytest.mark.parametrize("fault", IN_TURN, ids=lambda fault: fault.name)
def test_cell_survives(fault: HomeFault, standing: Standing) -> None:
    wrong = standing.survive(fault)
    assert not wrong, wrong


def test_every_kind_process_and_link_has_its_turn() -> None:
    assert FAULTS.keys() == {fault.name for fault in IN_TURN} | ELSEWHERE
    assert {fault.kind for fault in IN_TURN} == {fault.kind for fault in FAULTS.values()}
    struck = {who for fault in IN_TURN for who in fault.whom}
    assert struck == {who for fault in FAULTS.values() for who in fault.whom}
