"""Process ends: wakes an agent as soon as a process of its node has ended."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Callable, Iterable

from dwell.live.failures import start_thread


class ProcessEnds:
    """Waits in a thread for the end of processes (`os.pidfd_open`), and calls `wake` there.

    The thread ends with the last process that it watches.
    """

    def __init__(self) -> None:
        self.wake: Callable[[], object] = str
        self._ended: set[int] = set()
        self._lock = threading.Lock()
        #: Watched processes by descriptor, and the epoll of the thread; guarded by the lock.
        self._pids: dict[int, int] = {}
        self._epoll: select.epoll | None = None

    def watch(self, pid: int) -> None:
        """Watch a running process."""
        self._ended.discard(pid)
        try:
            descriptor = os.pidfd_open(pid)
        except OSError:
            # The process has ended, descriptors are used up, or the kernel is old: the supervisor
            # has to check the process itself.
            self._ended.add(pid)
            return
        with self._lock:
            self._pids[descriptor] = pid
            if self._epoll is None:
                self._epoll = select.epoll()
                start_thread("process ends", self._run, self._epoll)
            self._epoll.register(descriptor, select.EPOLLIN)

    def pending(self, pids: Iterable[int | None]) -> bool:
        """Return whether any of these processes has ended, or cannot be watched."""
        return not self._ended.isdisjoint(pids)

    def forget(self, pid: int) -> None:
        """Remove a process whose end the supervisor has noticed."""
        self._ended.discard(pid)

    def _run(self, epoll: select.epoll) -> None:
        while True:
            for descriptor, _ in epoll.poll():
                with self._lock:
                    epoll.unregister(descriptor)
                    os.close(descriptor)
                    self._ended.add(self._pids.pop(descriptor))
            self.wake()
            with self._lock:
                if not self._pids:
                    epoll.close()
                    self._epoll = None
                    return
