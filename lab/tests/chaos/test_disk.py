from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.host.state_files import make_folder
from dwell_lab.chaos.disk import DiskHog, SmallDisk, limit_file_size, may_mount

WRITER = """
import sys
for line in sys.stdin:
    try:
        with open(sys.argv[1], "ab", buffering=0) as file:
            file.write(bytes(10_000))
        print("written", flush=True)
    except OSError as error:
        print(error.strerror, flush=True)
"""


def test_a_process_whose_files_may_not_grow(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-S", "-c", WRITER, str(tmp_path / "file")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    ) as writer:
        assert writer.stdin is not None
        assert writer.stdout is not None

        def write() -> str:
            writer.stdin.write("go\n")  # type: ignore[union-attr]
            return writer.stdout.readline().strip()  # type: ignore[union-attr]

        assert write() == "written"
        limit_file_size(writer.pid, 10_000)
        assert write() == "File too large"
        limit_file_size(writer.pid, None)
        assert write() == "written"
        writer.stdin.close()
    with pytest.raises(LiveError, match="cannot be limited"):
        limit_file_size(writer.pid, 0)


@pytest.mark.skipif(not may_mount(), reason="nobody but root mounts a disk")
def test_a_small_disk_is_full_until_it_is_cleared(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    with SmallDisk(folder) as disk:
        assert make_folder(folder) == folder
        (folder / "kept").write_bytes(b"x" * 10_000)
        disk.fill()
        with pytest.raises(OSError, match="No space left"), (folder / "more").open("wb") as file:
            file.write(b"x" * 100_000)
        disk.clear()
        (folder / "more").write_bytes(b"y" * 100_000)
    assert (folder / "kept").read_bytes() == b"x" * 10_000
    assert (folder / "more").read_bytes() == b"y" * 100_000
    assert not (folder / "filler").exists()


def test_a_hog_leaves_nothing_behind(tmp_path: Path) -> None:
    with DiskHog(tmp_path, writers=1) as hog:
        while not hog.waits_ms:
            pass
    assert hog.wait_ms > 0
    assert hog.usual_ms > 0
    assert not list(tmp_path.iterdir())
