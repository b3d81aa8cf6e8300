"""Transport with emulated links.

The sending transport emulates the link of a message for a single node, which its key names
(`target_of`). Other messages reach several nodes with one put: each receiving transport emulates
the link from the sending node, whose name precedes the header. A put always returns at once, and a
thread forwards delayed messages at their arrival time.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from dwell.live.failures import start_thread
from dwell.live.local.message_links import HELD, LOST, LinkEnds, Way
from dwell.live.wire.transport import Arrival, Lane, Receive, Transport

#: First byte of a header with the source node; MessagePack never uses this byte.
_SOURCE = b"\xc1"
#: Kinds of keys whose fifth part is the target node (see `Keys`).
_FOR_ONE_NODE = frozenset({"in", "state", "value", "snapshot"})
#: Period of the checks whether a cut that holds messages has ended.
LOOK_NS = 2_000_000
MOST_STREAMS = 4_096

_LOG = logging.getLogger(__name__)


def target_of(key: str) -> str | None:
    """Return the target node of a key; None for keys with several receiving nodes.

    Keys with a target are ``dwell/CELL/in/TASK/NODE/KIND``, ``state/TASK/NODE/SOURCE`` and
    ``snapshot/TASK/NODE``.
    """
    chunks = key.split("/")
    return chunks[4] if len(chunks) > 4 and chunks[2] in _FOR_ONE_NODE else None


def without_source(header: bytes) -> tuple[str, bytes]:
    """Return the source node in a header (empty if it has none) and the rest of the header."""
    if not header.startswith(_SOURCE):
        return "", header
    end = len(_SOURCE) + 1 + header[len(_SOURCE)]
    return header[len(_SOURCE) + 1 : end].decode(), header[end:]


@dataclass(slots=True)
class _Stream:
    """Messages of a sender, key and lane, which stay in order."""

    way: Way
    latest_ns: int = 0
    # Number of messages on their way; and messages that wait for the end of a cut (size, action).
    moving: int = 0
    held: deque[tuple[int, Callable[[], None]]] | None = None


class LinkedTransport:
    """Transport with emulated links from and to the process's node; see `Transport`."""

    def __init__(self, transport: Transport, ends: LinkEnds) -> None:
        self._transport, self._ends = transport, ends
        node = ends.node.encode()
        self._source = _SOURCE + bytes([len(node)]) + node
        self._changed = threading.Condition()
        self._waiting: list[tuple[int, int, _Stream, Callable[[], None] | None]] = []
        self._streams: dict[tuple[str, str, str], _Stream] = {}
        self._number = itertools.count()
        self._closed = False
        start_thread("links", self._hand_on)

    def put(
        self, key: str, payload: bytes | memoryview, header: bytes = b"", *, lane: Lane = "control"
    ) -> None:
        """Send a message without waiting for its link."""
        target = target_of(key)
        if target is None:
            self._transport.put(key, payload, self._source + header, lane=lane)
            return
        way = self._ends.to.get(target)
        if way is None:
            self._transport.put(key, payload, header, lane=lane)
            return
        data = bytes(payload)

        def send() -> None:
            self._transport.put(key, data, header, lane=lane)

        self._begin(way, (key, lane, ""), len(data) + len(header), send)

    def subscribe(self, key: str, receive: Receive) -> None:
        """Call `receive` for each message that matches a key expression, at its arrival time."""

        def met(sample: Arrival) -> None:
            source, header = without_source(sample.header)
            message = Arrival(sample.key, sample.payload, header) if source else sample
            way = self._ends.since.get(source)
            if way is None or target_of(sample.key) is not None:
                receive(message)
                return
            size = len(sample.payload) + len(header)
            self._begin(way, (sample.key, key, source), size, lambda: receive(message))

        self._transport.subscribe(key, met)

    def close(self) -> None:
        """Stop sending and delivering messages; may be called twice."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify()
        self._transport.close()

    def _begin(
        self, way: Way, name: tuple[str, str, str], size: int, act: Callable[[], None]
    ) -> None:
        """Start a message on its link, and call `act` at its arrival."""
        with self._changed:
            if self._closed:
                return
            stream = self._streams.get(name)
            if stream is None:
                stream = self._streams[name] = _Stream(way)
                self._forget_some()
            now_ns = time.monotonic_ns()
            if stream.held is not None:
                stream.held.append((size, act))
                return
            arrival_ns = way.begin(size, now_ns)
            if arrival_ns == HELD:
                stream.held = deque([(size, act)])
                self._wait(now_ns + LOOK_NS, stream, None)
                return
            if arrival_ns == LOST:
                return
            stream.latest_ns = max(arrival_ns, stream.latest_ns)
            if stream.moving or stream.latest_ns > now_ns:
                self._wait(stream.latest_ns, stream, act)
                return
        act()

    def _forget_some(self) -> None:
        """Remove idle streams if there are many, as each answer has its own key."""
        if len(self._streams) > MOST_STREAMS:
            busy = {name: one for name, one in self._streams.items() if one.moving or one.held}
            self._streams = busy

    def _wait(self, at_ns: int, stream: _Stream, act: Callable[[], None] | None) -> None:
        if act is not None:
            stream.moving += 1
        heapq.heappush(self._waiting, (at_ns, next(self._number), stream, act))
        if self._waiting[0][0] == at_ns:
            self._changed.notify()

    def _hand_on(self) -> None:
        """Forward messages at their arrival time until the transport is closed."""
        while True:
            with self._changed:
                if self._closed:
                    return
                now_ns = time.monotonic_ns()
                if not self._waiting:
                    self._changed.wait()
                    continue
                if self._waiting[0][0] > now_ns:
                    self._changed.wait((self._waiting[0][0] - now_ns) / 1e9)
                    continue
                _, _, stream, act = heapq.heappop(self._waiting)
                if act is None:
                    self._release(stream, now_ns)
                    continue
            try:
                act()
            except Exception:
                _LOG.exception("what a link handed on could not be handled")
            with self._changed:
                stream.moving -= 1

    def _release(self, stream: _Stream, now_ns: int) -> None:
        """Start the held messages of a stream if the cut has ended."""
        held = stream.held
        while held:
            size, act = held[0]
            arrival_ns = stream.way.begin(size, now_ns)
            if arrival_ns == HELD:
                self._wait(now_ns + LOOK_NS, stream, None)
                return
            held.popleft()
            if arrival_ns != LOST:
                stream.latest_ns = max(arrival_ns, stream.latest_ns)
                self._wait(stream.latest_ns, stream, act)
        stream.held = None
