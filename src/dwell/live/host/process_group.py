"""Process groups: each process of a cell leads one, and what it leaves there is ended after it.

A group is the process's as long as nobody else can have its number: the kernel gives the id of a
process away again only when its group is empty, too. Helpers that have made a session, or a group,
of their own are not found.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import psutil

#: Two readings of one start differ by less, s.
SAME_S = 0.05


@dataclass(frozen=True, slots=True)
class ProcessGroup:
    """Group of a process that was started.

    Parameters
    ----------
    pid : int
        Of the process that leads it, and of the group.
    started : float
        When that process was started, s since 1970.
    session : int
        Session of all of the group; -1 where nobody has noted it.
    """

    pid: int
    started: float
    session: int

    @classmethod
    def of(cls, pid: int) -> ProcessGroup | None:
        """Return the group of a process that runs; None where it has ended."""
        try:
            return cls(pid, psutil.Process(pid).create_time(), os.getsid(pid))
        except (psutil.Error, OSError):
            return None

    def leader(self) -> psutil.Process | None:
        """Return the process that leads it, if it runs."""
        with suppress(psutil.Error):
            process = psutil.Process(self.pid)
            same = abs(process.create_time() - self.started) < SAME_S
            if same and process.status() != psutil.STATUS_ZOMBIE:
                return process
        return None

    def kill(self) -> int:
        """Kill the members, but for this process; returns how many there were.

        Call it again until there is none: they may have started others meanwhile, and take their
        time.
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
                    return  # the id is somebody else's, and so is the group
                same = os.getsid(pid) == self.session and process.uids().real == os.getuid()
                later = started > self.started - SAME_S
                if same and later and process.status() != psutil.STATUS_ZOMBIE:
                    yield process


def end_helpers() -> None:
    """End what else is in the group that this process leads; nothing where it leads none."""
    own = ProcessGroup.of(os.getpid())
    if own is not None and os.getpgrp() == own.pid:
        own.kill()
