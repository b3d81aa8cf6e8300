"""The record of a live run: killed, torn, damaged; what is left, and that the loss is told."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

import dwell
from dwell.cli.commands import app
from dwell.record.journal import JOURNAL, MARK

#: A cell in memory, at full speed; its controller records as that of real processes does.
RECORDER = """
import sys
from dataclasses import replace
from pathlib import Path
import dwell
from dwell.live.cell import Cell
from dwell.live.recording import RunRecorder
from tests.live.small_world import World

class Telling(RunRecorder):
    def append(self, rows, **meta):
        super().append(rows, **meta)
        for row in rows.get("windows", ()):
            print(row[0], flush=True)

problem = dwell.load("examples/canonical.yaml")
problem = replace(problem, window_cycles=10, warmup_windows=0)
exec_ms = {"sensing": 3.0, "perception": 10.0, "planning": 6.0, "control": 0.5}
world = World(problem, exec_ms=exec_ms, policy="dtp")
cell = next(role for role in world.roles.values() if isinstance(role, Cell))
cell._recorder = Telling(Path(sys.argv[1]), world.problem, cell.controller, lambda line: None)
for _ in range(400):
    world.run(100)
"""


def report(folder: Path) -> str:
    """What `dwell report` says; the page says the same."""
    page = folder.parent / f"{folder.name}.html"
    result = CliRunner().invoke(app, ["report", str(folder), "--out", str(page)])
    assert result.exit_code == 0, result.output
    text = " ".join(page.read_text().replace("&#x27;", "'").split())
    for line in result.output.splitlines():
        if line.startswith("note: "):
            assert line.removeprefix("note: ").partition(";")[0] in text
    return result.output


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The folder of a run whose recorder was killed, and the last window that it spoke of."""
    out = tmp_path_factory.mktemp("runs")
    draw = random.Random(os.urandom(8))
    with subprocess.Popen(
        [sys.executable, "-c", RECORDER, str(out)], stdout=subprocess.PIPE, text=True
    ) as recorder:
        assert recorder.stdout is not None
        said = -1
        while said < 5:
            line = recorder.stdout.readline()
            assert line, "it ended before it was killed"
            said = max(said, int(line))
        time.sleep(draw.random() * 30e-3)
        recorder.send_signal(signal.SIGKILL)
        said = max([said, *map(int, recorder.stdout.read().split())])
    (folder,) = out.iterdir()
    return folder, said


def test_a_recorder_that_is_killed_loses_no_window_that_was_closed(
    killed: tuple[Path, int],
) -> None:
    folder, said = killed
    run = dwell.open_run(folder)
    numbers = run.windows["window"].to_list()
    assert numbers == list(range(len(numbers)))
    # The last one may have been written without having been said.
    assert numbers[-1] - said in {0, 1}
    assert run.cycles.height >= 10 * len(numbers)
    assert not run.meta["recovered"]["sealed"]
    assert "note: The run was not closed" in report(folder)


def copied(killed: Path, to: Path, data: bytes) -> Path:
    folder = to / killed.name
    folder.mkdir()
    (folder / JOURNAL).write_bytes(data)
    return folder


def test_a_torn_end_costs_a_window_and_is_told(killed: tuple[Path, int], tmp_path: Path) -> None:
    whole = (killed[0] / JOURNAL).read_bytes()
    cut = whole.rfind(MARK) + 20
    folder = copied(killed[0], tmp_path, whole[:cut])
    windows = dwell.open_run(killed[0]).windows.height
    assert windows - dwell.open_run(folder).windows.height in {0, 1}
    said = report(folder)
    assert "note: 20 bytes at the journal's end were torn by a kill" in said


def test_damage_is_found_by_its_checksum_and_told(killed: tuple[Path, int], tmp_path: Path) -> None:
    whole = bytearray((killed[0] / JOURNAL).read_bytes())
    begin = whole.rfind(MARK, 0, whole.rfind(MARK))
    whole[begin + 15] ^= 1
    folder = copied(killed[0], tmp_path, bytes(whole))
    windows = dwell.open_run(killed[0]).windows.height
    assert windows - dwell.open_run(folder).windows.height in {0, 1}
    assert "bytes within the journal were damaged; what they said is not here" in report(folder)
    page = tmp_path / "page.html"
    words = ["report", str(folder), "--out", str(page), "--json"]
    found = json.loads(CliRunner().invoke(app, words).stdout)
    assert found["recovered"]["damaged_places"] == 1
    assert len(found["lost"]) >= 2
