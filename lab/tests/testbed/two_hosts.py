"""Hosts A and B, and sockets inside them that are all this process's."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

from dwell.errors import LiveError
from dwell_lab.testbed.hosts import Hosts, within
from tests.waiting import PATIENCE_S

NODES = "A", "B"

_numbers = count()


def why_not() -> str:
    """What keeps this machine from it; empty if nothing does."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    try:
        with two_hosts():
            return ""
    except (LiveError, OSError) as error:
        return str(error)


class TwoHosts:
    """The two, and the devices that lead to each other."""

    def __init__(self, hosts: Hosts) -> None:
        self.hosts = hosts
        self.tuns = {"A": hosts.tun("A", "B"), "B": hosts.tun("B", "A")}
        self._sockets: list[socket.socket] = []

    def hang_up(self) -> None:
        """Close every socket."""
        while self._sockets:
            self._sockets.pop().close()

    def udp(self, node: str) -> socket.socket:
        """A socket that is bound to a node's address."""

        def make() -> socket.socket:
            sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.bind((self.hosts.address(node), 0))
            sock.settimeout(PATIENCE_S)
            self._sockets.append(sock)
            return sock

        return within(self.hosts.namespace(node), make)

    def tcp(self, source: str, target: str) -> tuple[socket.socket, socket.socket]:
        """The two ends of a connection."""
        address = self.hosts.address(target)
        server = within(self.hosts.namespace(target), lambda: socket.create_server((address, 0)))
        with server:
            where = address, server.getsockname()[1]
            dialled = within(
                self.hosts.namespace(source), lambda: socket.create_connection(where, PATIENCE_S)
            )
            accepted, _ = server.accept()
        for sock in (dialled, accepted):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.settimeout(PATIENCE_S)
            self._sockets.append(sock)
        return dialled, accepted


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Make them, under a name that no other test has."""
    with Hosts(f"t{os.getpid()}l{next(_numbers)}", NODES, [("A", "B")]) as hosts:
        made = TwoHosts(hosts)
        try:
            yield made
        finally:
            made.hang_up()
