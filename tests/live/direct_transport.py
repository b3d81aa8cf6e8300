"""A transport without a network, which hands every message to all subscribers at once."""

from __future__ import annotations

from dwell.live.wire.transport import Arrival, Lane, Receive


class DirectTransport:
    """Carries every message to all who have subscribed, whatever its key."""

    def __init__(self) -> None:
        self.receivers: list[Receive] = []
        self.closed = False

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        for receive in self.receivers:
            receive(Arrival(key, bytes(payload), header))

    def subscribe(self, key: str, receive: Receive) -> None:
        self.receivers.append(receive)

    def close(self) -> None:
        self.closed = True
