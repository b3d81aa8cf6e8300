"""Closes a session's descriptors in children of this process, as a stage may fork.

With open descriptors, a child of a dead process would keep its port, its connections (whose end
informs the peers) and the locks of its shared memory. Descriptors of the stage stay open.
"""

from __future__ import annotations

import os
import socket
import stat
import weakref
from collections.abc import Iterable
from contextlib import suppress

from dwell.live.failures import start_thread
from dwell.live.transport.no_linger import OPEN, internet_stream
from dwell.live.transport.orphans import is_shared_memory
from dwell.live.wire.wiring import Locator, WiringEntry


class SessionDescriptors:
    """Descriptors of a process's sessions: listening sockets, connections and shared memory."""

    def __init__(self, entry: WiringEntry) -> None:
        self._ports = {end.port for end in entry.listen.values()}
        self._peers: set[tuple[str, int]] = set()
        self._closed = False
        ends = [end for ends in entry.connect.values() for end in ends]
        # Resolving a host name may take long.
        start_thread("dwell-addresses", self._resolve, ends)
        close = weakref.WeakMethod(self._close)

        def in_child() -> None:
            if (method := close()) is not None:
                method()

        os.register_at_fork(after_in_child=in_child)

    def stop(self) -> None:
        """Stop closing descriptors: later children keep all that they inherit."""
        self._closed = True

    def _resolve(self, ends: Iterable[Locator]) -> None:
        for end in ends:
            with suppress(OSError):
                found = socket.getaddrinfo(end.address, end.port, type=socket.SOCK_STREAM)
                self._peers |= {(str(address[0]), end.port) for *_, address in found}

    def _close(self) -> None:
        """Close the descriptors in a child, whose only thread this is."""
        if self._closed:
            return
        for number in map(int, os.listdir(OPEN)):
            with suppress(OSError):
                if self._is_session(number):
                    os.close(number)

    def _is_session(self, number: int) -> bool:
        mode = os.fstat(number).st_mode
        if stat.S_ISREG(mode):
            return is_shared_memory(os.readlink(f"{OPEN}/{number}"))
        if not stat.S_ISSOCK(mode) or (connection := internet_stream(number)) is None:
            return False
        with connection:
            if connection.getsockname()[1] in self._ports:
                return True
            address, port = connection.getpeername()[:2]
            return (address, port) in self._peers
