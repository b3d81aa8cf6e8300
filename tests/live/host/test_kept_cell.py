"""What a node keeps of its cell file, and of the modules next to it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from dwell.live.host import state_files
from dwell.live.host.kept_cell import CellKeeper, KeptCell, cell_here, change, forget
from dwell.version import __version__
from tests.waiting import wait_until

EXAMPLE = Path(__file__).parents[3] / "examples" / "live"


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    shutil.copytree(EXAMPLE, tmp_path / "cell", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "cell" / "cell.yaml"


def begin(cell: Path, folder: Path) -> KeptCell:
    kept = KeptCell.of(cell, [folder])
    if kept.folder is None:
        kept.write(folder)
    return KeptCell.of(cell, [folder])


def edit(file: Path) -> None:
    file.write_text(file.read_text().replace("window_cycles: ", "window_cycles: 1"))


def test_a_node_that_died_goes_on_with_the_bytes_that_it_began_with(
    cell: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "root" / "light" / "R1"
    before = begin(cell, folder)
    cell.write_text("dwell: [")
    again = KeptCell.of(cell, [folder])
    assert again == before
    assert again.folder == folder
    assert again.problem() == before.problem()
    assert again.problem().folder == str(cell.parent)
    assert cell_here(cell, tmp_path / "root") == before
    # Another cell file does not begin with it.
    assert KeptCell.of(tmp_path / "other.yaml", [folder]).folder is None


def test_a_start_after_an_orderly_end_reads_the_file_unless_the_computer_was_started_again(
    cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "R1"
    begin(cell, folder).end(folder)
    assert KeptCell.of(cell, [folder]).folder is None
    boot = tmp_path / "boot_id"
    boot.write_text("another")
    monkeypatch.setattr(state_files, "BOOT_ID", boot)
    assert KeptCell.of(cell, [folder]).folder == folder


def test_down_forgets_what_dead_nodes_have_kept(cell: Path, tmp_path: Path) -> None:
    begin(cell, tmp_path / "root" / "light" / "R1")
    begin(cell, tmp_path / "root" / "light" / "controller@E")
    forget(cell, tmp_path / "root")
    assert cell_here(cell, tmp_path / "root").folder is None


def test_files_that_have_changed_are_named(cell: Path, tmp_path: Path) -> None:
    kept = begin(cell, tmp_path / "R2")
    assert kept.told("R2") == ""
    edit(cell)
    assert kept.told("R2").startswith("cell.yaml on R2 has changed since ")
    assert kept.told("R2").endswith("; `dwell live up --again` takes it over")
    cell.with_name("stages.py").unlink()
    assert kept.told("R2").startswith("cell.yaml, stages.py on R2 have changed since ")
    (cell.parent / "new.py").write_text("")
    assert kept.changed() == ["cell.yaml", "stages.py"]


LOOK = """
import sys
from pathlib import Path
from dwell.live.host.kept_cell import KeptCell
KeptCell.of(Path(sys.argv[1]), [Path(sys.argv[2])]).install()
import own, bare.deep, whole.inner
print(own.WORD, own.DATA, bare.deep.WORD, whole.WORD, whole.inner.WORD, own.__file__)
"""


def test_modules_are_imported_as_they_were_and_find_the_files_next_to_them(
    cell: Path, tmp_path: Path
) -> None:
    home = cell.parent
    for folder in ("bare", "whole"):
        (home / folder).mkdir()
    (home / "data").write_text("d")
    text = "from pathlib import Path\nDATA = Path(__file__).with_name('data').read_text()\n"
    modules = ("own.py", "bare/deep.py", "whole/__init__.py", "whole/inner.py")
    for name in modules:
        (home / name).write_text(f"{text if name == 'own.py' else ''}WORD = 'old'\n")
    cell.write_text(cell.read_text().replace("stages:Camera", "bare.deep:Camera"))
    begin(cell, tmp_path / "R1")
    for name in modules:
        (home / name).write_text("WORD = 'new'\n")
    words = [sys.executable, "-c", LOOK, str(cell), str(tmp_path / "R1")]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    assert told == ["old", "d", "old", "old", "old", str(home / "own.py")]


def test_what_is_removed_while_the_node_runs_is_kept_again(cell: Path, tmp_path: Path) -> None:
    folder, stopped, said = tmp_path / "R1", threading.Event(), list[str]()
    keeper = CellKeeper(KeptCell.of(cell), folder, "R1", said.append)
    keeper.begin(stopped)
    edit(cell)
    shutil.rmtree(folder)
    wait_until(lambda: bool(keeper.told() and KeptCell.of(cell, [folder]).folder))
    assert KeptCell.of(cell, [folder]).contents == keeper.kept.contents
    assert len(said) == 1
    stopped.set()


def test_files_are_read_again_only_after_a_change(
    cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = CellKeeper(KeptCell.of(cell), tmp_path / "R1", "R1", list[str]().append)
    keeper.look()
    read_bytes, reads = Path.read_bytes, list[Path]()

    def read(path: Path) -> bytes:
        reads.append(path)
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", read)
    keeper.look()
    assert reads == []
    stages = cell.with_name("stages.py")
    text, times = stages.read_text(), stages.stat()
    for content, words in ((text.swapcase(), "stages.py on R1 has changed since "), (text, "")):
        # Neither length nor time of modification differs.
        changed_ns = stages.stat().st_ctime_ns
        while stages.stat().st_ctime_ns == changed_ns:  # the kernel counts in ticks
            stages.write_text(content)
            os.utime(stages, ns=(times.st_atime_ns, times.st_mtime_ns))
        keeper.look()
        assert keeper.told().startswith(words)
        assert bool(keeper.told()) == bool(words)
    stages.unlink()
    keeper.look()
    assert keeper.told().startswith("stages.py on R1 has changed since ")


def test_a_cell_that_cannot_be_kept_is_said_and_runs(cell: Path, tmp_path: Path) -> None:
    (tmp_path / "R1").write_text("no folder")
    said: list[str] = []
    keeper = CellKeeper(KeptCell.of(cell), tmp_path / "R1", "R1", said.append)
    keeper.look()
    assert "cell.yaml cannot be kept: " in keeper.told()
    assert said == [f"warning: {keeper.told()}"]


def test_a_change_asks_for_what_it_touches(cell: Path, tmp_path: Path) -> None:
    old, text = begin(cell, tmp_path / "R1"), cell.read_text()
    stages = cell.with_name("stages.py").read_text()

    def found(text: str, stages: str = stages) -> str:
        cell.write_text(text)
        cell.with_name("stages.py").write_text(stages)
        return change(old, KeptCell.of(cell))

    assert found(f"{text}# seen\n") == "text"
    assert (
        change(replace(old, version=f"{__version__.rpartition('.')[0]}.77"), KeptCell.of(cell))
        == "code"
    )
    assert change(replace(old, version="0.77.0"), KeptCell.of(cell)) == "wiring"
    assert found(text.replace("latency: 1,", "latency: 2,")) == "decision"
    assert found(text.replace("stages:perceive", "stages:Perceive")) == "code"
    assert found(text, f"{stages}# other\n") == "code"
    assert found(text.replace("port: 74", "port: 75")) == "wiring"
    assert found(text.replace("period_ms: ", "period_ms: 1")) == "wiring"


def test_what_cannot_be_taken_over_leaves_the_node_as_it_is(cell: Path, tmp_path: Path) -> None:
    folder, said = tmp_path / "R1", list[str]()
    keeper = CellKeeper(KeptCell.of(cell), folder, "R1", said.append)
    keeper.look()
    before, text = keeper.kept, cell.read_text()
    for wrong in (text.replace("period_ms: ", "period_ms: 1"), "dwell: ["):
        cell.write_text(wrong)
        assert keeper.take_over() is None
        assert "error: cell.yaml: is not taken over: " in said[-1]
        assert KeptCell.of(cell, [folder]) == before
    cell.write_text(text.replace("latency: 1,", "latency: 2,"))
    assert keeper.take_over() == "decision"
    assert keeper.told() == ""
    assert KeptCell.of(cell, [folder]) == keeper.kept != before
