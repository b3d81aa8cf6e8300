"""Connections whose peer has gone, and that nobody closes, are found; out of descriptors, too."""

from __future__ import annotations

import resource
import socket
from contextlib import ExitStack, suppress
from queue import SimpleQueue

import pytest

from dwell.live.transport.abandoned import CROWD, AbandonedConnections
from tests.waiting import PATIENCE_S


@pytest.mark.parametrize("spare", [1_000, 0])
def test_abandoned_connections_are_found_by_their_port(spare: int) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=CROWD))
        port = server.getsockname()[1]
        renewed: SimpleQueue[int] = SimpleQueue()
        watch = AbandonedConnections([port], renewed.put)
        far = []
        for _ in range(CROWD):
            far.append(stack.enter_context(socket.create_connection(("127.0.0.1", port))))
            near, _ = server.accept()
            stack.enter_context(near)
        # Those that are alive do not count, nor do those that say nothing.
        assert watch.count() == {}
        for connection in far[: CROWD - 1]:
            connection.close()
        if not spare:
            resource.setrlimit(resource.RLIMIT_NOFILE, (near.fileno() + 1, limits[1]))
            stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
            with suppress(OSError):
                while True:
                    stack.enter_context(socket.socket())
        assert watch.count() == {port: CROWD - 1}
        stack.callback(watch.stop)
        watch.start()
        assert renewed.get(timeout=PATIENCE_S) == port
