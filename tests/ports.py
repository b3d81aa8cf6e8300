"""Ports for tests, of which those that run at the same time find different ones."""

from __future__ import annotations

import fcntl
import os
import socket
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path
from tempfile import gettempdir

#: How many a process that runs tests has; all are below those that the kernel gives out.
PORTS = 600


@cache
def own_ports() -> range:
    """Return the ports of this process. A lock on a file keeps other processes out to its end."""
    for first in range(20_000, 32_000, PORTS):
        with suppress(OSError):
            lock = os.open(Path(gettempdir(), f"dwell-tests-{first}.lock"), os.O_RDWR | os.O_CREAT)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
    # With more processes than there are locks, the last range is shared.
    return range(first, first + PORTS)


def free_ports(count: int) -> int:
    """Return the first of `count` ports in a row that are free."""
    for first in own_ports()[: PORTS - count + 1 : 20]:
        with ExitStack() as stack, suppress(OSError):
            for port in range(first, first + count):
                stack.enter_context(socket.create_server(("127.0.0.1", port)))
            return first
    raise AssertionError("no ports")
