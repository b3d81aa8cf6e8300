"""A transport whose messages meet emulated links on their way.

A message that is for one node, which its key names (`target_of`), meets the link in the transport
that sends it. All others go to several nodes by one put; they meet their links in each process that
receives them, from the node that sent them, which they carry before their header. Either way a put
returns at once: a thread hands on what has to wait, at its instant.
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

#: Begins a header that says where its message comes from; MessagePack never uses this byte.
_SOURCE = b"\xc1"
#: Keys whose fifth chunk is the one node that a message is for (see `Keys`).
_FOR_ONE_NODE = frozenset({"in", "state", "snapshot"})
#: Between two looks whether a cut that holds messages has ended.
LOOK_NS = 2_000_000
MOST_STREAMS = 4_096

_LOG = logging.getLogger(__name__)


def target_of(key: str) -> str | None:
    """Return the node that a message is for, by its key; None where several nodes hear it.

    ``dwell/CELL/in/TASK/NODE/KIND``, ``state/TASK/NODE/SOURCE`` and ``snapshot/TASK/NODE`` are for
    one.
    """
    chunks = key.split("/")
    return chunks[4] if len(chunks) > 4 and chunks[2] in _FOR_ONE_NODE else None


def without_source(header: bytes) -> tuple[str, bytes]:
    """Return the node that a message comes from and its own header; no node where none is said."""
    if not header.startswith(_SOURCE):
        return "", header
    end = len(_SOURCE) + 1 + header[len(_SOURCE)]
    return header[len(_SOURCE) + 1 : end].decode(), header[end:]


@dataclass(slots=True)
class _Stream:
    """Messages of one sender, key and lane, which keep their order."""

    way: Way
    latest_ns: int = 0
    # On their way, and of them those that wait for the end of a cut: size and what hands it on.
    moving: int = 0
    held: deque[tuple[int, Callable[[], None]]] | None = None


class LinkedTransport:
    """A transport with emulated links, those that end at the process's node; see `Transport`."""

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
        """Send a message; returns at once, however long its link takes."""
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
        """Have `receive` called with every message under a key expression, when it is there."""

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
        """Send and deliver nothing more; safe to call twice."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify()
        self._transport.close()

    def _begin(
        self, way: Way, name: tuple[str, str, str], size: int, act: Callable[[], None]
    ) -> None:
        """Let a message begin its way, and hand it on when it is there."""
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
        """Forget streams on which nothing is on its way, where there are many: keys of answers."""
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
        """Hand on messages at their arrival, as long as the transport is open."""
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
        """Let messages that wait for the end of a cut begin their way, if it has come."""
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
