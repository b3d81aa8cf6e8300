"""What outlives a process of a live cell."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import LiveError
from dwell.live.host.state_files import (
    BeatFiles,
    BookFile,
    HighestFile,
    InFlight,
    boot_id,
    make_folder,
)
from dwell.live.roles.stamper import StamperState
from dwell_lab.chaos.disk import SmallDisk, may_mount


def test_a_book_is_read_as_it_was_written(tmp_path: Path) -> None:
    book = BookFile(tmp_path / "stamper.book")
    assert book.read() is None
    for term in range(1, 4):
        entry = StamperState(
            run=7, reserved=1024 * term, term=term, placement="SO", on_fallback=term == 2
        )
        book.write(entry)
        assert BookFile(tmp_path / "stamper.book").read() == entry


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"run": 1}', '{"run": -1, "reserved": 0, "term": 1}', '{"run": "x"}']
)
def test_a_book_that_cannot_be_read_is_none(tmp_path: Path, text: str) -> None:
    path = tmp_path / "stamper.book"
    path.write_text(text)
    assert BookFile(path).read() is None


def test_the_highest_cycle_outlives_its_process(tmp_path: Path) -> None:
    path = tmp_path / "sink.highest"
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from dwell.live.host.state_files import HighestFile\n"
        "kept = HighestFile(Path(sys.argv[1]))\n"
        "for cycle in range(1, 1000): kept.store(5, cycle)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert HighestFile(path).load() == (5, 999)


@given(spoilt=st.integers(0, 63), value=st.integers(0, 255))
def test_a_spoilt_slot_costs_one_cycle_at_most(
    tmp_path_factory: pytest.TempPathFactory, spoilt: int, value: int
) -> None:
    path = tmp_path_factory.mktemp("sink") / "sink.highest"
    kept = HighestFile(path)
    assert kept.load() == (-1, -1)
    for cycle in range(10):
        kept.store(3, cycle)
    data = bytearray(path.read_bytes())
    data[spoilt] = value
    path.write_bytes(data)
    assert HighestFile(path).load() in ((3, 9), (3, 8))


def test_a_job_in_flight_is_what_a_dead_worker_was_at(tmp_path: Path) -> None:
    path = tmp_path / "worker.inflight"
    assert InFlight.read(path) is None
    inflight = InFlight(path)
    inflight.begin(b"first")
    assert InFlight.read(path) == b"first"
    inflight.end()
    assert InFlight.read(path) is None
    large = os.urandom(300_000)
    inflight.begin(large)
    assert InFlight.read(path) == large
    inflight.begin(b"small")
    assert InFlight.read(path) == b"small"


@given(st.binary(max_size=64))
def test_no_content_of_the_file_is_more_than_no_job(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("worker") / "worker.inflight"
    path.write_bytes(data)
    found = InFlight.read(path)
    assert found is None or len(found) <= len(data)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(LiveError, match="file/inside: cannot be made"):
        make_folder(tmp_path / "file" / "inside")
    with pytest.raises(LiveError, match="file: cannot be made"):
        make_folder(tmp_path / "file")


def test_a_folder_and_those_above_that_are_made_for_it_are_the_user_s_own(tmp_path: Path) -> None:
    before = os.umask(0o002)
    try:
        make_folder(tmp_path / "dwell" / "cell" / "R1")
    finally:
        os.umask(before)
    for folder in ("dwell", "dwell/cell", "dwell/cell/R1"):
        assert make_folder(tmp_path / folder).stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770])
def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path, mode: int) -> None:
    folder = make_folder(tmp_path / "state")
    folder.chmod(mode)
    with pytest.raises(LiveError, match=f"state: others may write to it .*{mode:o}.*chmod go-w"):
        make_folder(folder)
    folder.chmod(0o755)
    make_folder(folder)


@pytest.mark.skipif(os.geteuid() != 0, reason="nobody but root gives folders away")
def test_a_folder_of_another_user_is_refused(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "state")
    os.chown(folder, 12_345, -1)
    with pytest.raises(LiveError, match="state: belongs to user 12345"):
        make_folder(folder)


@pytest.mark.parametrize("kind", [BookFile, HighestFile])
def test_a_link_does_not_stand_for_a_file(tmp_path: Path, kind: Callable[[Path], object]) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("of somebody else")
    link.symlink_to(target)
    with pytest.raises(LiveError, match="link: is a symbolic link; remove it"):
        kind(link)
    inflight = InFlight(link)
    inflight.begin(b"a job")
    inflight.end()
    assert target.read_text() == "of somebody else"


def test_a_book_that_is_spoilt_is_that_of_the_time_before(tmp_path: Path) -> None:
    path = tmp_path / "stamper.book"
    book = BookFile(path)
    entries = [StamperState(7, 1024 * term, term, "SO", False) for term in range(1, 4)]
    for entry in entries:
        book.write(entry)
    content = bytearray(path.read_bytes())
    content[content.index(b'"term":3')] ^= 1
    path.write_bytes(content)
    assert BookFile(path).read() == entries[1]


@pytest.mark.skipif(not may_mount(), reason="nobody but root mounts a disk")
def test_a_full_disk_keeps_nobody_from_remembering(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    with SmallDisk(folder) as disk:
        book, highest = BookFile(folder / "book"), HighestFile(folder / "highest")
        inflight = InFlight(folder / "inflight")
        disk.fill()
        entry = StamperState(7, 1024, 3, "SO", True)
        book.write(entry)
        highest.store(7, 12)
        inflight.begin(b"x" * 100_000)
        inflight.end()
        assert BookFile(folder / "book").read() == entry
        assert HighestFile(folder / "highest").load() == (7, 12)
        assert InFlight.read(folder / "inflight") is None
        with pytest.raises(LiveError, match="No space left"):
            BookFile(folder / "another")


def test_a_file_that_was_removed_is_there_again_after_the_next_write(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "R1")
    book, highest = BookFile(folder / "book"), HighestFile(folder / "highest")
    entries = [StamperState(7, 1024, term, "SO", False, "boot") for term in range(1, 4)]
    book.write(entries[0])
    highest.store(7, 1)
    shutil.rmtree(folder)
    # Until the agent has made the folder again, nothing fails.
    book.write(entries[1])
    highest.store(7, 2)
    make_folder(folder)
    book.write(entries[2])
    highest.store(7, 3)
    assert BookFile(folder / "book").read() == entries[2]
    assert HighestFile(folder / "highest").load() == (7, 3)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the kernel tells no boot")
def test_the_boot_has_an_id() -> None:
    assert boot_id() == boot_id() != ""


def test_processes_of_a_node_read_each_others_beats(tmp_path: Path) -> None:
    agent, worker = BeatFiles(tmp_path, "agent@E"), BeatFiles(tmp_path, "planning@E")
    assert agent.read("planning@E") == b""
    for beat in (b"first", b"second", b"a longer third"):
        worker.write(beat)
        assert agent.read("planning@E") == beat
    # It outlives its process.
    assert BeatFiles(tmp_path, "planning@E").read("planning@E") == b"a longer third"
    worker.write(bytes(100_000))
    assert agent.read("planning@E") == b"a longer third"


def test_beats_find_each_other_after_their_folder_was_removed(tmp_path: Path) -> None:
    folder = tmp_path / "state"
    folder.mkdir()
    agent, worker = BeatFiles(folder, "agent@E"), BeatFiles(folder, "planning@E")
    worker.write(b"before")
    assert agent.read("planning@E") == b"before"
    shutil.rmtree(folder)
    worker.write(b"without a folder")
    folder.mkdir()
    worker.write(b"after")
    assert agent.read("planning@E") == b"after"
