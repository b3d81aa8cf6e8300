"""A stage that forks, in the processes of a real agent: its helper holds nothing of the cell's."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from dwell.live.host.supervision import survivor
from dwell.live.local.processes import without_keys
from tests.cli.live_cell import RealCell
from tests.processes import lives
from tests.waiting import PATIENCE_S, wait_until

WORKER = "planning@R2"
#: A stage that starts a helper when it starts, and writes down which process of its has started it.
PLANNER = """
import os
import sys
import time
from pathlib import Path

class Planner:
    def start(self):
        helper = os.fork()
        if not helper:
            time.sleep(1_000)
            os._exit(0)
        who = sys.argv[sys.argv.index("--who") + 1]
        with Path(__file__).with_name("helpers").open("a") as helpers:
            helpers.write(f"{who} {helper}\\n")

    def process(self, inputs):
        return next(iter(inputs.values()))
"""


class Forking:
    """An agent of a cell with that stage."""

    def __init__(self, folder: Path) -> None:
        made = RealCell(folder)
        document = made.document
        document["tasks"]["planning"]["run"] = "forking_planner:Planner"
        made.file.write_text(yaml.safe_dump(document, sort_keys=False))
        made.file.with_name("forking_planner.py").write_text(PLANNER)
        self._started, self._state = made.file.with_name("helpers"), made.state("R2")
        words = "agent", "--node", "R2", "--state", self._state, "--cell", made.file
        self.agent = subprocess.Popen(
            [sys.executable, "-m", "dwell", *map(str, words), "--owner", str(os.getpid())],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=without_keys(),
        )

    def helpers(self, who: str = WORKER) -> list[int]:
        """Helpers that a process has started, in order."""
        lines = self._started.read_text().splitlines() if self._started.exists() else []
        return [int(pid) for name, pid in map(str.split, lines) if name == who]

    def kill_worker(self) -> None:
        process = survivor(self._state / f"{WORKER}.pid")
        assert process is not None
        process.kill()


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Forking]:
    made = Forking(tmp_path)
    yield made
    made.agent.send_signal(signal.SIGTERM)
    made.agent.wait(PATIENCE_S)


def test_a_worker_whose_stage_forks_is_started_again_and_its_helpers_end(cell: Forking) -> None:
    wait_until(lambda: len(cell.helpers()) == 1)
    cell.kill_worker()
    # The stage starts when the session is open: the port is free again.
    wait_until(lambda: len(cell.helpers()) == 2)
    first, second = cell.helpers()
    assert not lives(first)
    assert lives(second)
    others = cell.helpers(f"{WORKER}.shadow")
    cell.agent.send_signal(signal.SIGTERM)
    assert cell.agent.wait(PATIENCE_S) == 0
    wait_until(lambda: not any(lives(pid) for pid in (second, *others)))
