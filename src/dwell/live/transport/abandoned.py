"""Search for abandoned connections: accepted by Zenoh, closed by the peer, but not by Zenoh.

Over TLS, Zenoh closes a connection that fails before its handshake, and then accepts no connection
for 100 ms. Without free descriptors, it closes and accepts none until a descriptor is free. So
after many bare connections, no peer could connect for minutes. Zenoh has no setting for this.
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

#: Number of abandoned connections on a port that delays new connections by five seconds.
MOST_ABANDONED = 50
#: Least number of open files for a search.
CROWD = 2 * MOST_ABANDONED
#: State of a TCP connection whose peer has ended it, as the first byte of TCP_INFO.
_CLOSE_WAIT = b"\x08"
OUT_OF_FILES = frozenset({errno.EMFILE, errno.ENFILE})


class AbandonedConnections:
    """Closes the connections of a listening port if too many are abandoned.

    `renew` gets the port, and closes all connections that were accepted there.
    """

    def __init__(self, ports: Iterable[int], renew: Callable[[int], None]) -> None:
        self._ports, self._renew = frozenset(ports), renew
        self._stopped = threading.Event()

    def start(self) -> None:
        """Start the periodic search in a thread, if this process listens."""
        if self._ports:
            start_thread("dwell-abandoned", self._run)

    def stop(self) -> None:
        """Stop the search."""
        self._stopped.set()

    def _run(self) -> None:
        before: set[int] = set()
        while not self._stopped.wait(EVERY_S):
            # Renew a port at its second count in succession, as Zenoh closes connections slowly.
            many = {port for port, n in self.count().items() if n >= MOST_ABANDONED}
            for port in many & before:
                self._renew(port)
            before = many - before

    def count(self) -> Counter[int]:
        """Return the number of abandoned connections by port; empty if few files are open."""
        try:
            numbers: Sequence[int] = [int(name) for name in os.listdir(OPEN)]
            if len(numbers) < CROWD:
                return Counter()
        except OSError as error:
            if error.errno not in OUT_OF_FILES:
                raise
            # No descriptor is left for listing the folder.
            numbers = range(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        ports = (_abandoned_on(number) for number in numbers)
        return Counter(port for port in ports if port in self._ports)


def _abandoned_on(number: int) -> int | None:
    """Return the local port of a connection that the peer has closed; None for other files."""
    try:
        # Use the descriptor itself: a copy would need another descriptor.
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
