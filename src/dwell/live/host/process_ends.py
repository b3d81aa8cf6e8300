"""Process ends: wakes an agent at once when a process of its node has ended."""

from __future__ import annotations

import os
import select
from collections.abc import Callable, Iterable

from dwell.live.failures import start_thread


class ProcessEnds:
    """Waits in a thread for the descriptors of processes (see `os.pidfd_open`).

    Attributes
    ----------
    wake : callable
        Called in that thread after a process has ended.
    """

    def __init__(self) -> None:
        self.wake: Callable[[], object] = str
        self._pids: dict[int, int] = {}
        self._ended: set[int] = set()
        self._epoll = select.epoll()
        start_thread("process ends", self._run)

    def watch(self, pid: int) -> None:
        """Wait for the end of a process that runs."""
        self._ended.discard(pid)
        try:
            descriptor = os.pidfd_open(pid)
        except OSError:
            # No such process, no free descriptor, or an old kernel: its supervisor has to look.
            self._ended.add(pid)
            return
        self._pids[descriptor] = pid
        self._epoll.register(descriptor, select.EPOLLIN)

    def pending(self, pids: Iterable[int | None]) -> bool:
        """Whether one of these processes has ended, or cannot be watched."""
        return not self._ended.isdisjoint(pids)

    def forget(self, pid: int) -> None:
        """Drop an end that its supervisor has seen."""
        self._ended.discard(pid)

    def _run(self) -> None:
        while True:
            for descriptor, _ in self._epoll.poll():
                self._epoll.unregister(descriptor)
                os.close(descriptor)
                self._ended.add(self._pids.pop(descriptor))
            self.wake()
