"""The record of a live run: killed, torn, damaged; what is left, and that the loss is told."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

import dwell
from dwell.cli.commands import app
from dwell.errors import LiveError
from dwell.live.host.hosting import PLAIN
from dwell.live.host.node import run_controller
from dwell.model import Problem
from dwell.record import open_run
from dwell.record.journal import JOURNAL, MARK
from dwell.report.run_page import run_page
from dwell_lab.chaos.disk import limit_file_size
from tests.live.small_world import EXEC_MS, Recorded, canonical
from tests.reference.derivation import require_derived
from tests.report.pages import table_of

#: A cell in memory, at full speed; its controller records as that of real processes does.
RECORDER = """
import sys
from pathlib import Path
from dwell.live.roles.recording import RunRecorder
from tests.live.small_world import World, canonical

class Telling(RunRecorder):
    def append(self, rows, **meta):
        super().append(rows, **meta)
        for row in rows.get("windows", ()):
            print(row[0], flush=True)

world = World(canonical(10), policy="dtp")
cell = world.cell
cell._recorder = Telling(Path(sys.argv[1]), world.problem, cell.controller, lambda line: None)
for _ in range(400):
    world.run(100)
"""

#: The same, where Polars is not installed; it ends its run.
WITHOUT_POLARS = (
    "import sys\nsys.modules['polars'] = None\n"
    + RECORDER.replace("lambda line: None", "lambda line: print(line, file=sys.stderr)").replace(
        "range(400)", "range(100)"
    )
    + "cell._recorder.finish()\n"
)


@pytest.fixture
def problem() -> Problem:
    return canonical(10)


@pytest.fixture
def limits() -> Iterator[Callable[[int | None], None]]:
    """Lets no file of this process grow beyond a length, as on a disk that is full."""
    yield lambda longest: limit_file_size(os.getpid(), longest)
    limit_file_size(os.getpid(), None)


Limits = Callable[[int | None], None]


@pytest.mark.parametrize("room", [0, 100_000], ids=["from the start", "later"])
def test_a_full_disk_costs_no_decision_and_once_it_has_room_no_row(
    problem: Problem, tmp_path: Path, limits: Limits, room: int
) -> None:
    world = Recorded(problem, tmp_path)
    limits(room)
    world.run(30_000)
    assert world.windows > 50
    world.pin("SO")
    world.run(2_000)
    assert world.status["placement"] == "SO"
    assert "cannot be written (File too large)" in world.status["record"]
    assert "the run is not kept: " in world.status["headline"]
    assert sum("cannot be written (File too large)" in line for line in world.log) == 1
    limits(None)
    world.run(1_000)
    assert world.status["record"] is None
    assert world.log[-1].endswith("canonical-1: can be written again")
    # Before anything is sealed, and afterwards.
    (folder,) = tmp_path.iterdir()
    assert open_run(folder).windows["window"].to_list() == list(range(world.windows))
    run = open_run(world.finish())
    assert run.windows["window"].to_list() == list(range(world.windows))
    assert run.cycles["cycle"].to_list() == list(range(run.cycles.height))
    assert run.meta["recovered"]["missing_windows"] == 0
    assert run.decisions["placement"][-1] == "SO"


@pytest.mark.parametrize("policy", ["dtp", "cusum"])
def test_every_decision_of_a_live_run_follows_from_its_tables(
    problem: Problem, tmp_path: Path, policy: str
) -> None:
    # The placement that holds looks worse than the profiles of the others.
    slow = {**EXEC_MS, "perception": 30.0}
    world = Recorded(problem, tmp_path, policy=policy, exec_ms=slow)
    world.run(20_000)
    rows = require_derived(world.finish(), policy)
    assert len(rows) > 20
    assert sum(row["migrated"] for row in rows) > 1


def test_rows_that_have_waited_for_too_long_are_dropped_and_counted(
    problem: Problem, tmp_path: Path, limits: Limits
) -> None:
    world = Recorded(problem, tmp_path, most_waiting=200)
    limits(0)
    world.run(30_000)
    full = world.windows
    limits(None)
    world.run(5_000)
    assert "rows found no room, and are missing" in world.log[-1]
    run = open_run(world.finish())
    missing = run.meta["recovered"]["missing_windows"]
    assert full - 20 <= missing < full
    # From then on the run is complete.
    assert run.windows["window"].to_list() == list(range(missing, world.windows))
    told = report(next(tmp_path.iterdir()))
    assert f"note: Windows missing from the run: {missing}." in told


def test_a_folder_that_cannot_be_made_yet_is_made_later(problem: Problem, tmp_path: Path) -> None:
    out = tmp_path / "runs"
    out.symlink_to(tmp_path / "disk" / "not mounted" / "yet")
    world = Recorded(problem, out)
    world.run(10_000)
    assert world.windows > 10
    assert "cannot be written (" in world.status["record"]
    (tmp_path / "disk" / "not mounted" / "yet").mkdir(parents=True)
    world.run(1_000)
    assert open_run(world.finish()).windows.height == world.windows


def test_a_controller_that_starts_while_the_disk_is_full_goes_on_where_the_run_was(
    problem: Problem, tmp_path: Path, limits: Limits
) -> None:
    world = Recorded(problem, tmp_path)
    world.run(10_000)
    before = world.windows
    (folder,) = tmp_path.iterdir()
    limits((folder / JOURNAL).stat().st_size)
    who = "controller@E"
    world.kill(who)
    world.kept._journal.close()  # type: ignore[union-attr]  # as the kernel does
    world.start(who)
    world.run(10_000)
    limits(None)
    world.run(2_000)
    run = open_run(world.finish())
    assert run.windows["window"].to_list() == list(range(world.windows))
    assert world.windows > before + 10
    assert run.meta["recovered"]["opened"] == 2


def test_a_run_that_another_controller_writes_is_kept_in_a_folder_of_its_own(
    problem: Problem, tmp_path: Path
) -> None:
    first = Recorded(problem, tmp_path)
    first.run(5_000)
    second = Recorded(problem, tmp_path)
    second.run(5_000)
    folders = {first.finish(), second.finish()}
    assert len(folders) == 2
    assert all(open_run(folder).windows.height > 5 for folder in folders)


def test_runs_that_can_go_nowhere_end_the_controller_before_it_begins(
    problem: Problem, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LiveError, match=r"file/runs: cannot be made \(Not a directory\)"):
        run_controller(
            *([problem], tmp_path / "file" / "runs", threading.Event()),
            keepers={},
            continues={},
            policy=None,
            name=None,
            jobs=False,
            environment={},
            platform=PLAIN,
            say=print,
        )


def report(folder: Path) -> str:
    """What `dwell report` says; the page's table has the same numbers."""
    page = folder.parent / f"{folder.name}.html"
    result = CliRunner().invoke(app, ["report", str(folder), "--out", str(page)])
    assert result.exit_code == 0, result.output
    assert page.is_file()
    run = dwell.open_run(folder)
    shown = {row["what"]: row["value"] for row in table_of(run_page(run), "known").rows}
    lost = run.meta["recovered"]
    assert shown["bytes torn off the journal’s end by a kill"] == str(lost["torn_bytes"])
    assert shown["bytes damaged within the journal"] == str(lost["damaged_bytes"])
    assert shown["windows missing from the run"] == str(lost["missing_windows"])
    assert shown["closed"] == ("yes" if lost["sealed"] else "no")
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


def test_without_polars_a_run_stays_a_journal_that_is_read_elsewhere(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_POLARS, tmp_path],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("stays a journal") == 1
    assert "pip install 'dwell-placement[sim]'" in done.stderr
    (folder,) = tmp_path.iterdir()
    assert [path.name for path in folder.iterdir()] == [JOURNAL]
    run = open_run(folder)
    assert run.windows.height == len(done.stdout.split()) > 0
