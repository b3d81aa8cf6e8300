"""Process groups: each process of a cell leads a group, whose other members are ended after it.

The id of the group stays unique: the kernel reuses the id of a process only after its group is
empty. Helper processes that have made their own session or group are not found.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass

import psutil

#: Largest difference between two readings of one start time, s.
SAME_S = 0.05
#: Period of the checks of processes that are ending.
LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class ProcessGroup:
    """Group of a started process, whose id is also the group's id.

    `started` is the start of the leader in s since 1970; `session` is -1 if unknown.
    """

    pid: int
    started: float
    session: int

    @classmethod
    def of(cls, pid: int) -> ProcessGroup | None:
        """Return the group of a process; None if the process has ended."""
        try:
            return cls(pid, psutil.Process(pid).create_time(), os.getsid(pid))
        except (psutil.Error, OSError):
            return None

    def leader(self) -> psutil.Process | None:
        """Return the process that leads the group; None if it has ended."""
        with suppress(psutil.Error):
            process = psutil.Process(self.pid)
            same = abs(process.create_time() - self.started) < SAME_S
            if same and process.status() != psutil.STATUS_ZOMBIE:
                return process
        return None

    def kill(self) -> int:
        """Send SIGKILL to all members except this process; return their number.

        Call it again until it returns 0: members may start others, and take time to end.
        """
        try:
            os.killpg(self.pid, 0)
        except OSError:
            return 0
        count = 0
        for process in self._members():
            with suppress(psutil.Error):
                process.send_signal(signal.SIGKILL)
                count += 1
        return count

    def _members(self) -> Iterator[psutil.Process]:
        for pid in psutil.pids():
            with suppress(psutil.Error, OSError):
                if pid == os.getpid() or os.getpgid(pid) != self.pid:
                    continue
                process = psutil.Process(pid)
                started = process.create_time()
                if pid == self.pid and abs(started - self.started) >= SAME_S:
                    return  # another process has the id now, so the group is another, too
                same = os.getsid(pid) == self.session and process.uids().real == os.getuid()
                later = started > self.started - SAME_S
                if same and later and process.status() != psutil.STATUS_ZOMBIE:
                    yield process


def end_processes(
    processes: Collection[psutil.Process],
    patience_s: float,
    *,
    hurried: threading.Event | None = None,
) -> list[psutil.Process]:
    """Send SIGTERM to processes, even to stopped ones; kill and return those that do not end.

    They are killed after `patience_s`, or when `hurried` is set.
    """
    for process in processes:
        for number in (signal.SIGTERM, signal.SIGCONT):
            with suppress(psutil.Error):
                process.send_signal(number)
    deadline_s = time.monotonic() + patience_s
    alive = list(processes)
    while alive and time.monotonic() < deadline_s and not (hurried and hurried.is_set()):
        _, alive = psutil.wait_procs(alive, timeout=min(LOOK_S, patience_s))
    for process in alive:
        with suppress(psutil.Error):
            process.kill()
    psutil.wait_procs(alive, timeout=patience_s)
    return alive


def end_helpers() -> None:
    """Kill the other processes of the group that this process leads, if it leads a group."""
    own = ProcessGroup.of(os.getpid())
    if own is not None and os.getpgrp() == own.pid:
        own.kill()
