"""Recording of a live cell: what is published is recorded or dropped, and that is counted."""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from dwell.dash.observer import ObservedWindow
from dwell.dash.recorder import CellRecorder
from dwell.model import evolve
from dwell.record.mcap_file import McapFile
from tests.cells.small import make_problem
from tests.dash.stand_in import PERIOD_NS, StandIn
from tests.record.test_mcap_file import metadata, read

ROOT = Path(__file__).parents[2]
JOB = {
    "cycle": 0,
    "task": "perception",
    "node": "R1",
    "ready_ns": 1_000,
    "start_ns": 2_000,
    "end_ns": None,
    "outcome": "replaced",
    "shadow": False,
    "cpu_ns": None,
    "others_ns": None,
    "handover_ns": None,
    "ending_ns": None,
}
WINDOW = {
    "number": 0,
    "last_cycle": 99,
    "cycles": 100,
    "placement": "LOC",
    "l95_ms": 31.5,
    "violation_rate": 0.1,
    "cost": 1.25,
    "reason": "hold",
    "estimates": {"LOC": 1.5, "SO": None, "HYB": 2.5},
    "predicted": {"LOC": {"l95_ms": 30.0, "violation_rate": 0.2}},
    "utilisation": {"R1": 0.5, "R2": 0.25, "E": None},
    "ages": {"age_l95_see": 80.0, "age_missed_see": 0.25, "reaction_l95_see": math.inf},
    "age_ms": 20.0,
}


def counted(file: Path) -> tuple[int, int, int]:
    found = metadata(file)
    return int(found["published"]), int(found["recorded"]), int(found["dropped"])


def of_topic(file: Path, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
    return ((at_ns, content) for name, at_ns, content in read(file) if name == topic)


def test_what_is_heard_is_in_the_file_at_the_time_of_day(tmp_path: Path) -> None:
    chain = {"from": "sensing", "to": "control"}
    cell = StandIn(evolve(make_problem(), {"chains": {"see": chain}}))
    file = tmp_path / "new" / "cell.mcap"
    before_ns = time.time_ns()
    with CellRecorder(cell.observer, file, print) as recorder:
        cell.cycle(0, 20, jobs=(JOB,))
        cell.cycle(1, None)
        cell.cycle(2, 31, outcome="stale")
        cell.windows.append(ObservedWindow(0, 0.09, WINDOW))
    after_ns = time.time_ns()
    assert (recorder.published, recorder.recorded, recorder.dropped) == (4, 4, 0)
    assert counted(file) == (4, 4, 0)
    cycles = list(of_topic(file, "/cycles"))
    assert [one["outcome"] for _, one in cycles] == ["done", "dropped", "done"]
    assert [one["actuated"] for _, one in cycles] == [True, False, False]
    assert [one.get("latency_ns") for _, one in cycles] == [20_000_000, None, 31_000_000]
    assert cycles[1][0] - cycles[0][0] == PERIOD_NS
    # The first release was `at_s` before the recording began to write.
    assert before_ns <= cycles[0][0] + round(cell.at_s * 1e9) <= after_ns
    ((at_ns, job),) = of_topic(file, "/jobs")
    assert at_ns == cycles[0][0] + 1_000
    assert job == {name: value for name, value in JOB.items() if value is not None}
    ((at_ns, window),) = of_topic(file, "/windows")
    assert at_ns == cycles[0][0] + 90_000_000
    assert (window["seen_l95_ms"], window["u_R1"], "u_E" in window) == (31.5, 0.5, False)
    assert (window["age_l95_see"], window["age_missed_see"]) == (80.0, 0.25)
    assert "reaction_l95_see" not in window
    ((_, decision),) = of_topic(file, "/decisions")
    assert (decision["reason"], decision["j_HYB"], "j_SO" in decision) == ("hold", 2.5, False)
    assert (decision["est_l95_ms_LOC"], "est_l95_ms_SO" in decision) == (30.0, False)


def test_what_it_is_too_late_for_is_dropped_and_counted(tmp_path: Path) -> None:
    cell, file = StandIn(most_cycles=10), tmp_path / "cell.mcap"
    cell.cycle(0, 20)
    with CellRecorder(cell.observer, file, print):
        # More than are kept until it looks; what came before it is none of its.
        for number in range(1, 36):
            cell.cycle(number, 20)
    assert counted(file) == (35, 10, 25)
    assert [one["cycle"] for _, one in of_topic(file, "/cycles")] == list(range(26, 36))


def test_a_cell_of_which_nothing_is_heard_gives_a_file_without_messages(tmp_path: Path) -> None:
    cell, file = StandIn(status={"health": "absent"}, at_s=0.0), tmp_path / "cell.mcap"
    with CellRecorder(cell.observer, file, print):
        pass
    assert counted(file) == (0, 0, 0)
    assert not list(read(file))


def test_a_file_that_is_there_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "cell.mcap"
    file.write_text("somebody's")
    with pytest.raises(FileExistsError):
        CellRecorder(StandIn().observer, file, print)
    assert file.read_text() == "somebody's"


def test_where_there_is_no_room_at_all_no_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*cell\.mcap'"):
        CellRecorder(StandIn().observer, tmp_path / "cell.mcap", print)
    assert not list(tmp_path.iterdir())


def test_where_the_disk_has_room_again_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add, said = McapFile.add, list[str]()

    def full(file: McapFile, *messages: Any) -> None:
        if 2 <= messages[0][2]["cycle"] < 5:
            raise OSError(28, "No space left on device")
        add(file, *messages)

    monkeypatch.setattr(McapFile, "add", full)
    cell, file = StandIn(), tmp_path / "cell.mcap"
    with CellRecorder(cell.observer, file, said.append):
        for number in range(8):
            cell.cycle(number, 20)
    assert counted(file) == (8, 5, 3)
    assert [one["cycle"] for _, one in of_topic(file, "/cycles")] == [0, 1, 5, 6, 7]
    assert said == [
        f"error: {file}: cannot be written (No space left on device); new rows are dropped",
        f"{file}: can be written again; 3 cycles and windows were dropped",
        f"{file}: 5 cycles and windows recorded + 3 dropped = 8 published",
    ]


FULL = """
import resource, sys
from pathlib import Path
from dwell.dash.recorder import CellRecorder
from tests.dash.stand_in import StandIn
resource.setrlimit(resource.RLIMIT_FSIZE, (3 << 20,) * 2)
cell = StandIn(most_cycles=100_000)
with CellRecorder(cell.observer, Path(sys.argv[1]), print):
    for number in range(50_000):
        cell.cycle(number, 20 + number % 97 / 7, run=number * 7_919 % 104_729)
"""


def test_a_disk_that_is_full_leaves_all_before_readable(tmp_path: Path) -> None:
    """A limit on the size of files stands in for the disk's."""
    file = tmp_path / "cell.mcap"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(file)],
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"error: {file}: cannot be written (File too large)")
    published, recorded, dropped = counted(file)
    assert published == 50_000 == recorded + dropped
    assert 0 < recorded < published
    assert [one["cycle"] for _, one in of_topic(file, "/cycles")] == list(range(recorded))
