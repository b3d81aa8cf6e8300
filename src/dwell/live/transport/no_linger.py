"""Disables SO_LINGER on the TCP sockets of this process: closing a connection never blocks.

Zenoh sets ten seconds of SO_LINGER on every TCP and TLS connection
(https://github.com/eclipse-zenoh/zenoh/issues/1101). If a peer is unreachable, closing its
connection waits in vain for confirmations. This blocks one of the few threads that read the
messages of all other peers: after the cable of E is pulled, R2 receives no messages from R1. Zenoh
has no setting for this.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
import threading
from contextlib import suppress

from dwell.live.failures import start_repeating

#: Folder with the descriptors of this process.
OPEN = "/dev/fd"
_ON_FOR = "ii"
_OFF = struct.pack(_ON_FOR, 0, 0)
#: Period of the search, shorter than the lease after which Zenoh closes a silent connection. A
#: search at each connection that Zenoh reports cost several cycles when E returned after a freeze,
#: and all connections opened at once.
EVERY_S = 0.5


class Connections:
    """Disables SO_LINGER on every TCP socket of this process, soon after it was opened."""

    def __init__(self) -> None:
        self._known: set[int] = set()
        self._stopped = threading.Event()

    def start(self) -> None:
        """Start the periodic search in a thread."""
        start_repeating("dwell-lingering", EVERY_S, self._stopped, self._search)

    def stop(self) -> None:
        """Stop the search."""
        self._stopped.set()

    def _search(self) -> None:
        # The search needs a descriptor, and may fail while none is free.
        with suppress(OSError):
            self.wait_for_nobody()

    def wait_for_nobody(self) -> None:
        """Disable SO_LINGER on all present connections."""
        known = set()
        for number in map(int, os.listdir(OPEN)):
            try:
                about = os.fstat(number)
            except OSError:
                continue
            if not stat.S_ISSOCK(about.st_mode):
                continue
            if about.st_ino in self._known or _released(number):
                known.add(about.st_ino)
        self._known = known


def internet_stream(number: int) -> socket.socket | None:
    """Return a copy of a TCP socket by its descriptor; None for other or closed files."""
    try:
        # Work on a copy: Zenoh may close the descriptor at any time, and reuse its number.
        copy = os.dup(number)
    except OSError:
        return None
    try:
        connection = socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        return None
    internet = connection.family in {socket.AF_INET, socket.AF_INET6}
    if internet and connection.type == socket.SOCK_STREAM:
        return connection
    connection.close()
    return None


def _released(number: int) -> bool:
    """Disable SO_LINGER on a connection; return whether the connection is done.

    Zenoh sets SO_LINGER only after a connection is established, which takes as long as the peer is
    unreachable.
    """
    connection = internet_stream(number)
    if connection is None:
        return True
    with connection:
        asked = connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(_OFF))
        waits = bool(struct.unpack(_ON_FOR, asked)[0])
        if waits:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _OFF)
        return waits
