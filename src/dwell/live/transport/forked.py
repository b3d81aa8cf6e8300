"""Closes a session's descriptors in children of this process: a stage may fork.

A child that kept them would keep the port of a process that has died, and the connections that
tell its peers of that, and the locks of its shared memory. What a stage has opened stays.
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
    """Those of a process's sessions: what listens, is accepted there, or connects to a peer.

    Parameters
    ----------
    entry : WiringEntry
        Where the sessions listen, and to whom they connect.
    """

    def __init__(self, entry: WiringEntry) -> None:
        self._ports = {end.port for end in entry.listen.values()}
        self._peers: set[tuple[str, int]] = set()
        self._closed = False
        ends = [end for ends in entry.connect.values() for end in ends]
        # A name may take long to be resolved.
        start_thread("dwell-addresses", self._resolve, ends)
        close = weakref.WeakMethod(self._close)

        def in_child() -> None:
            if (method := close()) is not None:
                method()

        os.register_at_fork(after_in_child=in_child)

    def stop(self) -> None:
        """Have children keep what they inherit from now on."""
        self._closed = True

    def _resolve(self, ends: Iterable[Locator]) -> None:
        for end in ends:
            with suppress(OSError):
                found = socket.getaddrinfo(end.address, end.port, type=socket.SOCK_STREAM)
                self._peers |= {(str(address[0]), end.port) for *_, address in found}

    def _close(self) -> None:
        """Close them; called in a child, which has this thread alone."""
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
