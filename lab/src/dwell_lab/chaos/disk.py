"""Disks that are full, or slow because other processes write to them."""

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
#: Size of a small disk while it is not full.
ROOMY_BYTES = 512 << 20
PAGE_BYTES = 4096
HOG_BYTES = 4 << 20
PROBE_S = 0.02


def may_mount() -> bool:
    """Whether this process may mount file systems."""
    return os.geteuid() == 0 and shutil.which("mount") is not None


class SmallDisk(Started):
    """Context manager that mounts a tmpfs on a folder; `fill` and `clear` set its free space.

    At the end the files remain in the folder.

    Raises
    ------
    LiveError
        If the tmpfs cannot be mounted.
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
        """Make the disk full: reduce its size to the used space, then fill the last pages."""
        used = os.statvfs(self.folder)
        size = max((used.f_blocks - used.f_bfree) * used.f_frsize, PAGE_BYTES)
        # If the files have grown since then, mount refuses the new size: try a larger size.
        for spare in (0, 1, 4, 16, 64):
            with suppress(LiveError):
                self._resize(size + spare * PAGE_BYTES)
                break
        else:
            raise LiveError(f"{self.folder}: cannot be made full")
        # The last pages may still have free space.
        with suppress(OSError), (self.folder / "filler").open("wb", buffering=0) as file:
            while True:
                file.write(bytes(PAGE_BYTES))

    def clear(self) -> None:
        """Restore the free space."""
        self._resize(ROOMY_BYTES)
        (self.folder / "filler").unlink(missing_ok=True)

    def _resize(self, size: int) -> None:
        run_command("mount", "-o", f"remount,size={size}", str(self.folder))

    def _unmount(self) -> None:
        """Unmount the disk; its files stay in the folder."""
        kept = self.folder.with_name(f"{self.folder.name}.kept")
        shutil.copytree(self.folder, kept, dirs_exist_ok=True)
        run_command("umount", "--lazy", str(self.folder))
        shutil.copytree(kept, self.folder, dirs_exist_ok=True)
        shutil.rmtree(kept)


def unmount_leftovers(folder: Path) -> None:
    """Unmount the small disks below a folder that a killed process left mounted."""
    with suppress(OSError):
        mounts = Path("/proc/self/mounts").read_text(encoding="utf-8").splitlines()
        ours = f"{folder.resolve()}/"
        for kind, where, *_ in (line.split() for line in mounts):
            if kind == NAME and where.startswith(ours):
                run_command("umount", "--lazy", where)


def limit_file_size(pid: int, longest: int | None) -> None:
    """Limit the length of a process's files, as if its disk were full; None removes the limit.

    Raises
    ------
    LiveError
        If the process belongs to another user, or has ended.
    """
    try:
        _, hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        soft = hard if longest is None else longest
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (soft, hard))
    except (OSError, ValueError) as error:
        raise LiveError(f"process {pid}: its files cannot be limited ({error})") from None


class DiskHog(Started):
    """Context manager that writes to a folder's disk at full speed, in several processes.

    It replaces a slow disk, which would need a separate device. All processes that wait for this
    disk become slower; a probe measures how much.

    Attributes
    ----------
    usual_ms : float
        Median time to write and sync a page before the writers start.
    waits_ms : list of float
        Times to write and sync a page while they write.
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
        """Stop the writers, and remove their files."""
        self._stopped.set()
        for writer in self._writers:
            writer.kill()
            writer.communicate()  # also closes its standard input
        super().stop()
        for path in self._folder.glob("hog-*"):
            path.unlink(missing_ok=True)

    @property
    def wait_ms(self) -> float:
        """Median wait for a page in ms; 0 before the first page."""
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


# Ends after the next write at the latest when its parent ends.
_HOG = f"""
import os, select, sys
file = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT, 0o600)
data = os.urandom({HOG_BYTES})
while not select.select([0], [], [], 0)[0]:
    os.pwrite(file, data, 0)
    os.fsync(file)
"""
