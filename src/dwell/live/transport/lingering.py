"""Lingering: closing a connection waits for nobody.

Zenoh asks for ten seconds of SO_LINGER on every TCP and TLS connection
(https://github.com/eclipse-zenoh/zenoh/issues/1101). Closing one whose peer is out of reach then
waits for confirmations that do not come, in one of the few threads that read the messages of all
other peers: a cable pulled at E would deafen R2 to R1. There is no setting for it.
"""

from __future__ import annotations

import os
import socket
import struct

__all__ = ["waits_for_nobody"]

#: Open files of this process, by number.
_OPEN = "/dev/fd"
_OFF = struct.pack("ii", 0, 0)


def waits_for_nobody() -> int:
    """Have no connection of this process wait when it is closed; returns how many would have."""
    return sum(_released(int(number)) for number in os.listdir(_OPEN))


def _released(number: int) -> bool:
    try:
        # A number of our own: the other may be closed at any time, and mean something else then.
        copy = os.dup(number)
    except OSError:
        return False
    try:
        connection = socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        return False
    with connection:
        if connection.family not in {socket.AF_INET, socket.AF_INET6}:
            return False
        if connection.type != socket.SOCK_STREAM:
            return False
        lingers = connection.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, len(_OFF)) != _OFF
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _OFF)
        return lingers
