"""Finds connections that Zenoh has accepted, whose peer has gone, and that it does not get rid of.

Over TLS, Zenoh closes a connection that has failed before its handshake, and then takes no other
one for 100 ms; out of descriptors, it closes none, and takes none, until somebody gives one back.
So after many bare connections nobody could connect for minutes. There is no setting for either.
"""

from __future__ import annotations

import errno
import os
import resource
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from dwell.live.failures import start_thread
from dwell.live.transport.no_linger import EVERY_S, OPEN

#: So many on one port keep others waiting for five seconds.
MOST_ABANDONED = 50
#: Fewer open files need no look.
CROWD = 2 * MOST_ABANDONED
#: State of a TCP connection whose peer has ended it, as the first byte of TCP_INFO.
_CLOSE_WAIT = b"\x08"
OUT_OF_FILES = frozenset({errno.EMFILE, errno.ENFILE})


class AbandonedConnections:
    """Calls what gets rid of them where they are too many.

    Parameters
    ----------
    ports : iterable of int
        Where this process listens.
    renew : callable
        Takes a port; closes all connections that were accepted there.
    """

    def __init__(self, ports: Iterable[int], renew: Callable[[int], None]) -> None:
        self._ports, self._renew = frozenset(ports), renew
        self._stopped = threading.Event()

    def start(self) -> None:
        """Look for them from now on."""
        if self._ports:
            start_thread("dwell-abandoned", self._run)

    def stop(self) -> None:
        """Look no more."""
        self._stopped.set()

    def _run(self) -> None:
        before: set[int] = set()
        while not self._stopped.wait(EVERY_S):
            # Zenoh needs a moment for each that ends.
            many = {port for port, n in self.count().items() if n >= MOST_ABANDONED}
            for port in many & before:
                self._renew(port)
            before = many - before

    def count(self) -> Counter[int]:
        """Count them by port; none where few files are open."""
        try:
            numbers: Sequence[int] = [int(name) for name in os.listdir(OPEN)]
            if len(numbers) < CROWD:
                return Counter()
        except OSError as error:
            if error.errno not in OUT_OF_FILES:
                raise
            # None is left to look with.
            numbers = range(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        ports = (_abandoned_on(number) for number in numbers)
        return Counter(port for port in ports if port in self._ports)


def _abandoned_on(number: int) -> int | None:
    """Return the local port of a connection whose peer has ended it; None for anything else."""
    try:
        # No copy of it: that would be one more descriptor.
        connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, number)
    except OSError:
        return None
    try:
        if connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1) != _CLOSE_WAIT:
            return None
        return int(connection.getsockname()[1])
    except (OSError, IndexError, TypeError):
        return None
    finally:
        connection.detach()
