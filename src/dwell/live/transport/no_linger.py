"""Disables SO_LINGER on the TCP sockets of this process: closing a connection never blocks.

Zenoh asks for ten seconds of SO_LINGER on every TCP and TLS connection
(https://github.com/eclipse-zenoh/zenoh/issues/1101). Closing one whose peer is out of reach then
waits for confirmations that do not come, in one of the few threads that read the messages of all
other peers: a cable pulled at E would deafen R2 to R1. There is no setting for it.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
import threading
from contextlib import suppress

from dwell.live.failures import start_thread

#: Open files of this process, by number.
OPEN = "/dev/fd"
_ON_FOR = "ii"
_OFF = struct.pack(_ON_FOR, 0, 0)
#: A connection is given up after a session's lease of silence, which is longer. Looking whenever
#: Zenoh reports one cost several cycles when E came back after a freeze, and all were made at once.
EVERY_S = 0.5


class Connections:
    """Disables SO_LINGER on every TCP socket of this process, soon after it was opened."""

    def __init__(self) -> None:
        self._known: set[int] = set()
        self._stopped = threading.Event()

    def start(self) -> None:
        """Look for connections from now on."""
        start_thread("dwell-lingering", self._run)

    def stop(self) -> None:
        """Look no more."""
        self._stopped.set()

    def _run(self) -> None:
        while not self._stopped.wait(EVERY_S):
            # To look takes a file of its own, and there may be none left for a moment.
            with suppress(OSError):
                self.wait_for_nobody()

    def wait_for_nobody(self) -> None:
        """Disable the lingering of all present connections."""
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
    """Return a copy of a TCP socket by its descriptor; None where it is another one, or gone."""
    try:
        # A number of our own: the other may be closed at any time, and mean something else then.
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
    """Disable a connection's lingering; return whether it need not be looked at again.

    A connection that is still being made lingers only once it is there, which takes as long as its
    peer is out of reach.
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
