"""Disks that are full, or slow because somebody else writes to them, too."""

from __future__ import annotations

import io
import os
import resource
import shutil
import statistics
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from dwell.errors import LiveError
from dwell.live.local.child import Started, run_command

NAME = "dwell-chaos"
#: Of a small disk while it is not full.
ROOMY_BYTES = 512 << 20
PAGE_BYTES = 4096
HOG_BYTES = 4 << 20
PROBE_S = 0.02


def may_mount() -> bool:
    """Whether this process may mount file systems."""
    return os.geteuid() == 0 and shutil.which("mount") is not None


class SmallDisk(Started):
    """A file system of its own in place of a folder, which can be made full; a context manager.

    When it is taken away, what was on it is in the folder.

    Raises
    ------
    LiveError
        If it cannot be mounted.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _start(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        options = f"size={ROOMY_BYTES},mode=700"
        run_command("mount", "-t", "tmpfs", "-o", options, NAME, str(self.folder))
        self._stack.callback(self._unmount)

    def fill(self) -> None:
        """Leave no room: not by filling it, but by making it as small as what is on it."""
        used = os.statvfs(self.folder)
        size = max((used.f_blocks - used.f_bfree) * used.f_frsize, PAGE_BYTES)
        # What grows in between is beyond the size, which is then refused.
        for spare in (0, 1, 4, 16, 64):
            with suppress(LiveError):
                self._resize(size + spare * PAGE_BYTES)
                break
        else:
            raise LiveError(f"{self.folder}: cannot be made full")
        # The rest of the last pages is room, too.
        with suppress(OSError), (self.folder / "filler").open("wb", buffering=0) as file:
            while True:
                file.write(bytes(PAGE_BYTES))

    def clear(self) -> None:
        """Make room again."""
        self._resize(ROOMY_BYTES)
        (self.folder / "filler").unlink(missing_ok=True)

    def _resize(self, size: int) -> None:
        run_command("mount", "-o", f"remount,size={size}", str(self.folder))

    def _unmount(self) -> None:
        """Take it away; its files stay."""
        kept = self.folder.with_name(f"{self.folder.name}.kept")
        shutil.copytree(self.folder, kept, dirs_exist_ok=True)
        run_command("umount", "--lazy", str(self.folder))
        shutil.copytree(kept, self.folder, dirs_exist_ok=True)
        shutil.rmtree(kept)


def unmount_leftovers(folder: Path) -> None:
    """Take away the small disks that somebody who was killed has left below a folder."""
    with suppress(OSError):
        mounts = Path("/proc/self/mounts").read_text(encoding="utf-8").splitlines()
        ours = f"{folder.resolve()}/"
        for kind, where, *_ in (line.split() for line in mounts):
            if kind == NAME and where.startswith(ours):
                run_command("umount", "--lazy", where)


def limit_file_size(pid: int, longest: int | None) -> None:
    """Let a process write no file beyond a length, as on a disk that is full; None: any.

    Raises
    ------
    LiveError
        If it is not ours, or has ended.
    """
    try:
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        soft = hard if longest is None else longest
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))
    except (OSError, ValueError) as error:
        raise LiveError(f"process {pid}: its files cannot be limited ({error})") from None


class DiskHog(Started):
    """Writes to a folder's disk as fast as it takes it, beside everybody else; a context manager.

    A disk that is slow by itself cannot be had without a device of its own. What is slowed down is
    whoever waits for this disk; by how much is measured.

    Attributes
    ----------
    usual_ms : float
        How long a page took to be on the disk before.
    waits_ms : list of float
        And while it wrote.
    """

    def __init__(self, folder: Path, writers: int = 4) -> None:
        super().__init__()
        self._folder, self._count = folder, writers
        self._writers: list[subprocess.Popen[bytes]] = []
        self._path = folder / "hog-probe"
        self._stopped = threading.Event()
        self.waits_ms: list[float] = []
        self.usual_ms = 0.0

    def _start(self) -> None:
        with self._path.open("wb", buffering=0) as file:
            self.usual_ms = statistics.median(_page_ms(file) for _ in range(5))
        for number in range(self._count):
            words = [sys.executable, "-S", "-c", _HOG, str(self._folder / f"hog-{number}")]
            self._writers.append(subprocess.Popen(words, stdin=subprocess.PIPE))  # noqa: S603 - ours
        probe = threading.Thread(target=self._measure, daemon=True)
        probe.start()
        self._stack.callback(probe.join, timeout=30.0)

    def stop(self) -> None:
        """End, and remove what it has written."""
        self._stopped.set()
        for writer in self._writers:
            writer.kill()
            writer.communicate()  # closes its standard input, too
        super().stop()
        for path in self._folder.glob("hog-*"):
            path.unlink(missing_ok=True)

    @property
    def wait_ms(self) -> float:
        """Median wait for a page; 0 if there was none."""
        return statistics.median(self.waits_ms) if self.waits_ms else 0.0

    def _measure(self) -> None:
        with self._path.open("wb", buffering=0) as file:
            while not self._stopped.wait(PROBE_S):
                self.waits_ms.append(_page_ms(file))


def _page_ms(file: io.FileIO) -> float:
    begin = time.monotonic()
    file.write(bytes(PAGE_BYTES))
    os.fsync(file.fileno())
    return (time.monotonic() - begin) * 1e3


# Ends with its parent, at the latest after the next write.
_HOG = f"""
import os, select, sys
file = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT, 0o600)
data = os.urandom({HOG_BYTES})
while not select.select([0], [], [], 0)[0]:
    os.pwrite(file, data, 0)
    os.fsync(file)
"""
