"""The process of a link: one thread that reads batches, and sends each at its instant."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias, TypedDict, cast

from dwell.demo.link_batches import LENGTH_BYTES, Sifter, is_session
from dwell.demo.link_rate import SEGMENT_BYTES, Fair, InOrder, Rate, Sharing
from dwell.errors import DwellError, LiveError
from dwell.testbed.child import Json, Parent
from dwell.testbed.conditions import Conditions
from dwell.testbed.draws import Draws
from dwell.testbed.event_loop import Loop
from dwell.testbed.orders import Orders, Set
from dwell.testbed.realtime import come_first

__all__ = ["main"]

LISTEN_ON = "127.0.0.1"
# What one direction of one connection may have on its way: as TCP's window, at 25 ms and 1 Gbit/s.
WINDOW_BYTES = 4 << 20
# The kernel's own buffers, which a bottleneck must not have a lot of (Linux doubles them).
SOCKET_BYTES = 131_072


class _Settings(TypedDict):
    nodes: list[str]
    forwards: list[tuple[str, str, int, int]]
    sets: list[Set]
    seed: int
    queue_bytes: int
    sharing: Sharing
    cpus: list[int] | None


@dataclass(slots=True)
class _Counts:
    messages: int = 0
    dropped: int = 0
    bytes: int = 0
    unknown_bytes: int = 0
    delay_ms: float = 0.0
    squares: float = 0.0
    late_ms: float = 0.0
    late_max_ms: float = 0.0

    def passed(self, messages: int, delay_ns: int, late_ns: int) -> None:
        delay_ms, late_ms = delay_ns / 1e6, late_ns / 1e6
        self.messages += messages
        self.delay_ms += messages * delay_ms
        self.squares += messages * delay_ms * delay_ms
        self.late_ms += messages * late_ms
        self.late_max_ms = max(self.late_max_ms, late_ms)

    def as_traffic(self) -> dict[str, float]:
        n = max(self.messages, 1)
        mean = self.delay_ms / n
        return {
            "messages": self.messages,
            "dropped": self.dropped,
            "bytes": self.bytes,
            "unknown_bytes": self.unknown_bytes,
            "delay_mean_ms": mean,
            "delay_std_ms": max(self.squares / n - mean * mean, 0.0) ** 0.5,
            "late_mean_ms": self.late_ms / n,
            "late_max_ms": self.late_max_ms,
            "cpu_s": time.process_time(),
        }


class _Direction:
    """What all connections from one node to the other share."""

    def __init__(
        self, loop: Loop, seed: tuple[int, int], queue_bytes: int, sharing: Sharing
    ) -> None:
        self.counts = _Counts()
        self.streams: set[_Stream] = set()
        kind = Fair[_Stream] if sharing == "fair" else InOrder[_Stream]
        self.rate: Rate[_Stream] = kind(loop, queue_bytes, self._room_changed)
        self._draws = Draws(seed)
        self.lose = self._draws.lose
        self.draw_ns = self._draws.delay_ns

    @property
    def conditions(self) -> Conditions:
        """Those of now."""
        return self._draws.conditions

    def apply(self, changes: dict[str, object]) -> None:
        """Change conditions."""
        before = self.conditions
        self._draws.apply(changes)
        if before.rate_mbps != self.conditions.rate_mbps:
            self.rate.change(self.conditions.rate_mbps, time.monotonic_ns())
        if before.cut != self.conditions.cut:
            for stream in list(self.streams):
                stream.cut_changed()

    def _room_changed(self, stream: _Stream | None) -> None:
        """Watch for what there is room for now."""
        for each in self.streams if stream is None else (stream,):
            each.source.watch()


@dataclass(slots=True)
class _Departure:
    """Bytes that leave at an instant; none at all end the stream."""

    due_ns: int
    rest: memoryview
    messages: int = 0
    since_ns: int = 0


class _Stream:
    """One direction of one connection."""

    def __init__(self, loop: Loop, direction: _Direction, source: _Side, target: _Side) -> None:
        self.source, self.target, self.direction = source, target, direction
        self.blocked = False
        self.ended = False
        self.done = False
        self._loop = loop
        self._known: bool | None = None
        self._sifter = Sifter()
        self._buffer = bytearray()
        # Of the buffer's beginning: bytes that have taken their share of the rate already.
        self._paid = 0
        self._queue: deque[_Departure] = deque()
        self._waiting_bytes = 0
        self._last_ns = 0
        self._scheduled = False
        self._held: list[bytes | None] = []
        direction.streams.add(self)

    @property
    def reads(self) -> bool:
        """Whether there is room for more, and the link is whole."""
        cut = self.direction.conditions.cut
        passes = cut is None or (cut == "drop" and self._known is not False)
        room = self._waiting_bytes < WINDOW_BYTES and not self.direction.rate.full(self)
        return passes and room and not self.ended

    def read(self) -> None:
        """Read what there is, and put its batches on their way."""
        received = b""
        try:
            received = self.source.socket.recv(self.direction.rate.chunk_bytes)
        except BlockingIOError:
            return
        except OSError:  # reset: what was read before still goes on
            pass
        now_ns = time.monotonic_ns()
        if not received:
            self.ended = True
            self._take(None, now_ns, 0)
            return
        buffer = self._buffer
        buffer += received
        if self._known is None:
            self._known = is_session(buffer)
        if self._known is False:
            self._take(bytes(buffer), now_ns, len(buffer))
            buffer.clear()
        begin = 0
        while self._known and len(buffer) >= begin + LENGTH_BYTES:
            head = begin + LENGTH_BYTES
            end = head + int.from_bytes(buffer[begin:head], "little")
            if end > len(buffer):
                break
            self._take(bytes(buffer[head:end]), now_ns, max(end - max(begin, self._paid), 0))
            begin = end
        del buffer[:begin]
        self._paid = max(self._paid - begin, 0)
        if self._known and self.direction.conditions.cut is None:
            self.direction.rate.put(self, len(buffer) - self._paid, now_ns)
            self._paid = len(buffer)

    def _take(self, batch: bytes | None, now_ns: int, unpaid_bytes: int) -> None:
        """Lose, hold or queue a batch, or the end of the stream.

        Of a batch whose beginning came before, only the rest has yet to take its share of the rate.
        """
        direction = self.direction
        if direction.conditions.cut is not None:
            self._hold(batch)
        elif batch is None:
            self._pass(_Departure(0, memoryview(b"")), now_ns, 0)
        elif not self._known:
            direction.counts.unknown_bytes += len(batch)
            departure = _Departure(direction.draw_ns(), memoryview(batch))
            self._pass(departure, now_ns, unpaid_bytes)
        else:
            self._send_on(batch, now_ns, unpaid_bytes)

    def _pass(self, departure: _Departure, now_ns: int, size_bytes: int) -> None:
        """Queue what is due so long after it has passed at the rate."""

        def passed(at_ns: int) -> None:
            departure.due_ns += at_ns
            self._queue_up(departure)

        self.direction.rate.put(self, size_bytes, now_ns, passed)

    def _hold(self, batch: bytes | None) -> None:
        if batch is None or not self._known:
            self._held.append(batch)
            return
        sifted = self._sifter.sift(batch, lambda: True)
        self.direction.counts.dropped += sifted.lost
        chain = sifted.chain
        if chain is not None and chain.data and not chain.lost:
            # It had begun before the cut.
            chain.lost = True
            self.direction.counts.dropped += sifted.data
        elif sifted.batch:
            self._held.append(sifted.batch)

    def _send_on(self, batch: bytes, now_ns: int, unpaid_bytes: int) -> None:
        direction = self.direction
        sifted = self._sifter.sift(batch, direction.lose)
        direction.counts.dropped += sifted.lost
        since_ns, chain = now_ns, sifted.chain
        if chain is None:
            delay_ns = direction.draw_ns()
        else:
            if chain.delay_ns is None or chain.since_ns is None:
                chain.delay_ns, chain.since_ns = direction.draw_ns(), now_ns
            delay_ns, since_ns = chain.delay_ns, chain.since_ns
        if sifted.batch:
            framed = len(sifted.batch).to_bytes(LENGTH_BYTES, "little") + sifted.batch
            departure = _Departure(delay_ns, memoryview(framed), sifted.data, since_ns)
            self._pass(departure, now_ns, unpaid_bytes)
        else:  # what is lost takes its share of the rate all the same, as in the simulator
            direction.rate.put(self, unpaid_bytes, now_ns)

    def cut_changed(self) -> None:
        """Put what was held on its way, if the direction is whole again."""
        if self.direction.conditions.cut is None:
            held, self._held = self._held, []
            now_ns = time.monotonic_ns()
            for batch in held:
                self._take(batch, now_ns, LENGTH_BYTES + len(batch) if batch is not None else 0)
        self.source.watch()

    # ------------------------------------------------------------------------------ leaving

    def _queue_up(self, departure: _Departure) -> None:
        # A stream of bytes cannot overtake itself.
        self._last_ns = departure.due_ns = max(departure.due_ns, self._last_ns)
        self._queue.append(departure)
        self._waiting_bytes += len(departure.rest)
        if not self._scheduled and not self.blocked:
            self.send()

    def _due(self, _instant_ns: int) -> None:
        self._scheduled = False
        if not self.done:
            self.send()

    def send(self) -> None:
        """Send what is due, and see to the rest in time."""
        queue = self._queue
        while queue and not self.blocked and not self.done:
            first = queue[0]
            now_ns = time.monotonic_ns()
            if first.due_ns > now_ns:
                if not self._scheduled:
                    self._scheduled = True
                    self._loop.at(first.due_ns, self._due)
                break
            if len(first.rest) == 0:
                self.done = True
                self.target.end()
                return
            self._push(first, now_ns)
        self.source.watch()

    def _push(self, departure: _Departure, now_ns: int) -> None:
        try:
            sent = self.target.socket.send(departure.rest)
        except BlockingIOError:
            sent = 0
        except OSError:
            self.target.connection.broke()
            return
        counts = self.direction.counts
        counts.bytes += sent
        self._waiting_bytes -= sent
        if sent < len(departure.rest):
            departure.rest = departure.rest[sent:]
            self.blocked = True
            self.target.watch()
            return
        self._queue.popleft()
        if departure.messages:
            counts.passed(
                departure.messages, now_ns - departure.since_ns, now_ns - departure.due_ns
            )


class _Side:
    """One of the two sockets of a connection."""

    def __init__(self, loop: Loop, connection: _Connection, sock: socket.socket) -> None:
        self.socket = sock
        self.connection = connection
        self.connected = True
        self.served_ns = 0
        self.closed = False
        self._loop = loop
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)

    @property
    def outgoing(self) -> _Stream:
        """What is read from it."""
        return self.connection.streams[self]

    @property
    def incoming(self) -> _Stream:
        """What is written to it."""
        return self.connection.streams[self.connection.other(self)]

    def watch(self) -> None:
        """Watch for what it can be served with."""
        if self.closed:
            return
        mask = select.EPOLLIN if self.connected and self.outgoing.reads else 0
        if not self.connected or self.incoming.blocked:
            mask |= select.EPOLLOUT
        self._loop.watch(self.socket.fileno(), mask, self)

    def ready(self, events: int) -> None:
        """Serve it."""
        self.served_ns = time.monotonic_ns()
        if not self.connected:
            if self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                self.connection.close()
                return
            self.connected = True
        if self.incoming.blocked and events & ~select.EPOLLIN:
            self.incoming.blocked = False
            self.incoming.send()
        if not self.closed and self.outgoing.reads and events & ~select.EPOLLOUT:
            self.outgoing.read()
        self.watch()

    def end(self) -> None:
        """Write nothing more to it."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)
        if self.outgoing.done:
            self.connection.close()

    def close(self) -> None:
        """Close it."""
        if not self.closed:
            self._loop.watch(self.socket.fileno(), 0, self)
            self.closed = True
            self.socket.close()


class _Connection:
    """A connection that was accepted, and the one behind it."""

    def __init__(
        self,
        link: _Link,
        dialled: socket.socket,
        address: _Address,
        there: _Direction,
        back: _Direction,
    ) -> None:
        self._link = link
        behind = socket.socket(address[0])
        _as_ethernet(behind)
        self._sides = _Side(link.loop, self, dialled), _Side(link.loop, self, behind)
        first, second = self._sides
        self.streams = {
            first: _Stream(link.loop, there, first, second),
            second: _Stream(link.loop, back, second, first),
        }
        second.connected = False
        self.streams[first].blocked = True
        if behind.connect_ex(address[1]) not in {0, errno.EINPROGRESS}:
            self.close()
            return
        first.watch()
        second.watch()

    def other(self, side: _Side) -> _Side:
        """The other socket."""
        first, second = self._sides
        return second if side is first else first

    def broke(self) -> None:
        """One side is gone: so is the other, or as soon as the link is whole."""
        if self._link.cut:
            for stream in self.streams.values():
                stream.done = stream.ended = True
            for side in self._sides:
                side.watch()
            self._link.when_whole(self.close)
        else:
            self.close()

    def close(self) -> None:
        """Close both sides."""
        for stream in self.streams.values():
            stream.done = True
            stream.direction.streams.discard(stream)
            stream.direction.rate.leave(stream)
        for side in self._sides:
            side.close()


def _as_ethernet(sock: socket.socket) -> None:
    """Bound what the other side sends ahead; for a port, of all connections that it accepts."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SEGMENT_BYTES)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BYTES)


_Address: TypeAlias = tuple[int, tuple[str, int]]


class _Listener:
    """A port of the link."""

    served_ns = 0

    def __init__(self, link: _Link, source: str, address: _Address, port: int) -> None:
        self._link, self._source, self._address = link, source, address
        self._socket = socket.socket()
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        _as_ethernet(self._socket)
        self._socket.setblocking(False)
        try:
            self._socket.bind((LISTEN_ON, port))
        except OSError as error:
            reason = os.strerror(error.errno or 0)
            raise LiveError(f"{LISTEN_ON}:{port}: cannot listen there ({reason})") from None
        self._socket.listen(64)
        self.port: int = self._socket.getsockname()[1]
        self.watch()

    def watch(self) -> None:
        """Accept connections while the link is whole; a dial needs both directions."""
        mask = 0 if self._link.cut else select.EPOLLIN
        self._link.loop.watch(self._socket.fileno(), mask, self)

    def ready(self, _events: int) -> None:
        """Accept a connection, and dial the one behind it."""
        with contextlib.suppress(OSError):
            dialled, _ = self._socket.accept()
            there, back = self._link.both_from(self._source)
            _Connection(self._link, dialled, self._address, there, back)


@dataclass(slots=True)
class _Link:
    """The two directions, and the ports."""

    loop: Loop
    directions: dict[str, _Direction]
    listeners: list[_Listener] = field(default_factory=list)
    _when_whole: list[Callable[[], None]] = field(default_factory=list)

    @property
    def cut(self) -> bool:
        """Whether any direction is."""
        return any(item.conditions.cut is not None for item in self.directions.values())

    def both_from(self, source: str) -> tuple[_Direction, _Direction]:
        """Return the direction from a node, and the one to it."""
        (back,) = (item for name, item in self.directions.items() if name != source)
        return self.directions[source], back

    def conditions_from(self, source: str) -> Conditions:
        """Those of the direction from a node."""
        return self.directions[source].conditions

    def stats(self, *, reset: bool) -> Json:
        """Return what has passed each direction."""
        counted: Json = {name: item.counts.as_traffic() for name, item in self.directions.items()}
        if reset:
            for direction in self.directions.values():
                direction.counts = _Counts()
        return counted

    def when_whole(self, action: Callable[[], None]) -> None:
        """Have something done when nothing is cut any more."""
        self._when_whole.append(action)

    def apply(self, sets: Sequence[Set]) -> None:
        """Change conditions."""
        for item in sets:
            self.directions[item["source"]].apply(item["changes"])
        for listener in self.listeners:
            listener.watch()
        if not self.cut:
            actions, self._when_whole = self._when_whole, []
            for action in actions:
                action()


def main() -> None:
    """Forward until the parent ends, or wants it to."""
    parent = Parent()
    with contextlib.suppress(EOFError):
        settings = cast("_Settings", parent.receive())
        try:
            link = _link(settings)
        except (DwellError, OSError) as error:
            parent.answer({"error": str(error)})
            return
        Orders(parent, link)
        ports = [listener.port for listener in link.listeners]
        parent.answer({"ports": ports, "scheduling": come_first()})
        gc.freeze()
        while parent.alive:
            link.loop.turn()


def _link(settings: _Settings) -> _Link:
    if settings["cpus"] is not None:
        os.sched_setaffinity(0, settings["cpus"])
    loop = Loop()
    seed, queueing = settings["seed"], (settings["queue_bytes"], settings["sharing"])
    link = _Link(
        loop,
        {
            name: _Direction(loop, (seed, index), *queueing)
            for index, name in enumerate(settings["nodes"])
        },
    )
    link.apply(settings["sets"])
    for source, host, port, listen in settings["forwards"]:
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        except OSError as error:
            raise LiveError(f"{host}:{port}: no such address ({error.strerror})") from None
        address = found[0], (str(found[4][0]), port)
        link.listeners.append(_Listener(link, source, address, listen))
    return link


if __name__ == "__main__":
    main()
