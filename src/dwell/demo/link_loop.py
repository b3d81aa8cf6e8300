"""The process of a link: one thread that reads batches, and sends each at its instant.

It waits with `select`, whose timeouts are exact to microseconds; those of `epoll` are rounded to
milliseconds, so that `epoll` is only asked which of many connections are ready.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import heapq
import os
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Protocol, TypeAlias, TypedDict, cast

import numpy as np

from dwell.demo.link_batches import LENGTH_BYTES, Sifter, is_session
from dwell.errors import DwellError, LiveError
from dwell.testbed.child import PARENT_CHECK_S, Json, Parent
from dwell.testbed.conditions import Conditions, Scheduling, changed, delays_ns

__all__ = ["main"]

LISTEN_ON = "127.0.0.1"
READ_BYTES = 65_536
# What one direction of one connection may have on its way: as TCP's window, at 25 ms and 1 Gbit/s.
WINDOW_BYTES = 4 << 20
# The kernel's own buffers, which a bottleneck must not have a lot of (Linux doubles them).
SOCKET_BYTES = 131_072
# Of Ethernet. With loopback's 64 kB, ten of which TCP takes for a modest beginning, a sender's
# kernel would buffer megabytes in front of a slow link.
SEGMENT_BYTES = 1448
# Linux lets timers of ordinary processes be 50 µs late to save power.
TIMER_SLACK = "/proc/self/timerslack_ns"
# The shortest time slice that Linux grants; the shorter it is, the sooner a process gets the CPU.
SLICE_NS = 100_000
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}

Action: TypeAlias = Callable[[int], None]


class _Change(TypedDict):
    source: str
    changes: dict[str, object]


class _Settings(TypedDict):
    nodes: list[str]
    forwards: list[tuple[str, str, int, int]]
    sets: list[_Change]
    seed: int
    queue_bytes: int
    cpus: list[int] | None


class _Watched(Protocol):
    """What a descriptor belongs to."""

    served_ns: int

    def ready(self, events: int) -> None: ...


class _Loop:
    """Descriptors to watch, and actions to take at their instants."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._watched: dict[int, _Watched] = {}
        self._masks: dict[int, int] = {}
        self._actions: list[tuple[int, int, Action]] = []
        self._order = count()

    def at(self, instant_ns: int, action: Action) -> None:
        """Have something done at an instant."""
        heapq.heappush(self._actions, (instant_ns, next(self._order), action))

    def watch(self, descriptor: int, mask: int, owner: _Watched) -> None:
        """Watch for the events of a mask; one that is 0 watches for nothing, errors included."""
        before = self._masks.get(descriptor, 0)
        if mask == before:
            return
        if mask == 0:
            self._epoll.unregister(descriptor)
            del self._masks[descriptor], self._watched[descriptor]
            return
        if before == 0:
            self._epoll.register(descriptor, mask)
        else:
            self._epoll.modify(descriptor, mask)
        self._masks[descriptor] = mask
        self._watched[descriptor] = owner

    def turn(self) -> None:
        """Do what is due, wait for the next event or instant, and serve what is ready.

        Who was served longest ago goes first, so that nobody starves at a full queue.
        """
        actions = self._actions
        while actions and actions[0][0] <= time.monotonic_ns():
            instant_ns, _, action = heapq.heappop(actions)
            action(instant_ns)
        wait_s = PARENT_CHECK_S
        if actions:
            wait_s = min(wait_s, max(0, actions[0][0] - time.monotonic_ns()) / 1e9)
        select.select([self._epoll], [], [], wait_s)
        events = self._epoll.poll(0)
        if len(events) > 1:
            events.sort(key=lambda event: self._watched[event[0]].served_ns)
        for descriptor, mask in events:
            owner = self._watched.get(descriptor)
            if owner is not None:  # not closed by one before it
                owner.ready(mask)


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

    def __init__(self, loop: _Loop, seed: tuple[int, int], queue_bytes: int) -> None:
        self.conditions = Conditions()
        self.counts = _Counts()
        self.streams: set[_Stream] = set()
        self.full = False
        self._free_ns = 0
        self._loop = loop
        self._queue_bytes = queue_bytes
        delays, added, losses = np.random.default_rng(seed).spawn(3)
        self._rngs = {"delay_ms": delays, "add_delay_ms": added}
        self._delays = {name: self._drawn(name) for name in self._rngs}
        self._losses = losses

    def _drawn(self, name: str) -> Iterator[int]:
        return delays_ns(getattr(self.conditions, name), self._rngs[name])

    def apply(self, changes: dict[str, object]) -> None:
        """Change conditions."""
        before = self.conditions
        self.conditions = changed(before, changes)
        for name in self._rngs:
            if getattr(before, name) != getattr(self.conditions, name):
                self._delays[name] = self._drawn(name)
        if before.cut != self.conditions.cut:
            for stream in list(self.streams):
                stream.cut_changed()

    def lose(self) -> bool:
        """Decide whether the next message is lost."""
        return self.conditions.loss > 0 and self._losses.random() < self.conditions.loss

    def draw_ns(self) -> int:
        """Draw a delay."""
        return sum(map(next, self._delays.values()))

    def serialise(self, size_bytes: int, now_ns: int) -> int:
        """Put bytes behind those that wait at the rate; return when they have passed."""
        ns_per_byte = 8e3 / self.conditions.rate_mbps
        self._free_ns = max(now_ns, self._free_ns) + round(size_bytes * ns_per_byte)
        resume_ns = self._free_ns - round(self._queue_bytes * ns_per_byte)
        if resume_ns > now_ns and not self.full:
            self.full = True
            self._loop.at(resume_ns, self._resume)
            for stream in self.streams:
                stream.source.watch()
        return self._free_ns

    def _resume(self, _instant_ns: int) -> None:
        self.full = False
        for stream in self.streams:
            stream.source.watch()


@dataclass(slots=True)
class _Departure:
    """Bytes that leave at an instant; none at all end the stream."""

    due_ns: int
    rest: memoryview
    messages: int = 0
    since_ns: int = 0


class _Stream:
    """One direction of one connection."""

    def __init__(self, loop: _Loop, direction: _Direction, source: _Side, target: _Side) -> None:
        self.source, self.target, self.direction = source, target, direction
        self.blocked = False
        self.ended = False
        self.done = False
        self._loop = loop
        self._known: bool | None = None
        self._sifter = Sifter()
        self._buffer = bytearray()
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
        room = self._waiting_bytes < WINDOW_BYTES and not self.direction.full
        return passes and room and not self.ended

    def read(self) -> None:
        """Read what there is, and put its batches on their way."""
        received = b""
        try:
            received = self.source.socket.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:  # reset: what was read before still goes on
            pass
        now_ns = time.monotonic_ns()
        if not received:
            self.ended = True
            self._take(None, now_ns)
            return
        buffer = self._buffer
        buffer += received
        if self._known is None:
            self._known = is_session(buffer)
        if self._known is False:
            self._take(bytes(buffer), now_ns)
            buffer.clear()
        begin = 0
        while self._known and len(buffer) >= begin + LENGTH_BYTES:
            head = begin + LENGTH_BYTES
            end = head + int.from_bytes(buffer[begin:head], "little")
            if end > len(buffer):
                break
            self._take(bytes(buffer[head:end]), now_ns)
            begin = end
        del buffer[:begin]

    def _take(self, batch: bytes | None, now_ns: int) -> None:
        """Lose, hold or queue a batch, or the end of the stream."""
        direction = self.direction
        if direction.conditions.cut is not None:
            self._hold(batch)
        elif batch is None:
            self._queue_up(_Departure(now_ns, memoryview(b"")))
        elif not self._known:
            direction.counts.unknown_bytes += len(batch)
            passed_ns = direction.serialise(len(batch), now_ns)
            self._queue_up(_Departure(passed_ns + direction.draw_ns(), memoryview(batch)))
        else:
            self._send_on(batch, now_ns)

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

    def _send_on(self, batch: bytes, now_ns: int) -> None:
        direction = self.direction
        sifted = self._sifter.sift(batch, direction.lose)
        direction.counts.dropped += sifted.lost
        # A message that is lost takes its share of the rate, as in the simulator.
        passed_ns = direction.serialise(LENGTH_BYTES + len(batch), now_ns)
        since_ns, chain = now_ns, sifted.chain
        if chain is None:
            delay_ns = direction.draw_ns()
        else:
            if chain.delay_ns is None or chain.since_ns is None:
                chain.delay_ns, chain.since_ns = direction.draw_ns(), now_ns
            delay_ns, since_ns = chain.delay_ns, chain.since_ns
        if sifted.batch:
            framed = len(sifted.batch).to_bytes(LENGTH_BYTES, "little") + sifted.batch
            self._queue_up(
                _Departure(passed_ns + delay_ns, memoryview(framed), sifted.data, since_ns)
            )

    def cut_changed(self) -> None:
        """Put what was held on its way, if the direction is whole again."""
        if self.direction.conditions.cut is None:
            held, self._held = self._held, []
            now_ns = time.monotonic_ns()
            for batch in held:
                self._take(batch, now_ns)
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

    def __init__(self, loop: _Loop, connection: _Connection, sock: socket.socket) -> None:
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

    loop: _Loop
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

    def when_whole(self, action: Callable[[], None]) -> None:
        """Have something done when nothing is cut any more."""
        self._when_whole.append(action)

    def apply(self, sets: list[_Change]) -> None:
        """Change conditions."""
        for item in sets:
            self.directions[item["source"]].apply(item["changes"])
        for listener in self.listeners:
            listener.watch()
        if not self.cut:
            actions, self._when_whole = self._when_whole, []
            for action in actions:
                action()


class _Orders:
    """Requests of the parent."""

    served_ns = 0

    def __init__(self, parent: Parent, link: _Link) -> None:
        self._parent, self._link = parent, link
        link.loop.watch(parent.fileno(), select.EPOLLIN, self)

    def ready(self, _events: int) -> None:
        """Carry out a request; an `EOFError` ends the process."""
        request = self._parent.receive()
        try:
            self._parent.answer(self._answer(request))
        except DwellError as error:
            self._parent.answer({"error": str(error)})

    def _answer(self, request: Json) -> Json:
        link = self._link
        if request["do"] == "stats":
            counted = {name: item.counts.as_traffic() for name, item in link.directions.items()}
            if request["reset"]:
                for direction in link.directions.values():
                    direction.counts = _Counts()
            return {"stats": counted}
        sets = cast("list[_Change]", request["sets"])
        for item in sets:  # all faults before anything has changed
            changed(link.directions[item["source"]].conditions, item["changes"])
        at_ns = cast("int | None", request["at_ns"]) or 0
        now_ns = time.monotonic_ns()
        if at_ns <= now_ns:
            link.apply(sets)
            return {"at_ns": now_ns}
        link.loop.at(at_ns, lambda _: link.apply(sets))
        return {"at_ns": at_ns}


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
        _Orders(parent, link)
        ports = [listener.port for listener in link.listeners]
        parent.answer({"ports": ports, "scheduling": _come_first()})
        gc.freeze()
        while parent.alive:
            link.loop.turn()


def _come_first() -> Scheduling:
    """Get the CPU as soon as something is due, as far as the system lets this process.

    A real link does not wait for the CPU of a node that it connects; and foreign work is there to
    slow nodes, not links. Real-time priority does it, where the process may have it. Anybody may
    ask for short time slices (Linux 6.12), which halve the lateness beside busy threads.
    """
    with contextlib.suppress(OSError), open(TIMER_SLACK, "w") as slack:
        slack.write("1")
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        return "fifo"
    number = SCHED_SETATTR.get(os.uname().machine)
    # struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period.
    usual = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, 0, 0, SLICE_NS, 0, 0)
    done = number is not None and ctypes.CDLL(None).syscall(number, 0, usual, 0) == 0
    return "short slices" if done else "usual"


def _link(settings: _Settings) -> _Link:
    if settings["cpus"] is not None:
        os.sched_setaffinity(0, settings["cpus"])
    loop = _Loop()
    seed, queue_bytes = settings["seed"], settings["queue_bytes"]
    link = _Link(
        loop,
        {
            name: _Direction(loop, (seed, index), queue_bytes)
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
