"""One end of an emulated link: sends messages that tell when they were sent, or notes their ages.

``python -m benchmarks.link_end SPECIFICATION``, in the network namespace of a host.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from dwell.live.local.linked_transport import LinkedTransport
from dwell.live.local.message_links import LinkEnds
from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.wire.transport import Arrival, Lane, Transport
from dwell.live.wire.wiring import SESSIONS, Locator, Role, Session, WiringEntry

STAMP_BYTES = 8
# What comes later than that after the last was sent has been lost.
PATIENCE_S = 1.5
# Windows of TCP grow with what they carry; messages of that time do not count.
WARM_S = 2.0

Receive = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class Specification:
    """What an end does.

    Parameters
    ----------
    side : {"send", "receive"}
    kind : {"udp", "tcp", "zenoh"}
    address : str
        Of the receiver.
    port : int
        First of its ports; every flow has one (with Zenoh, one a session).
    size_bytes : int
        Of a message.
    flows : int
        5-tuples that take turns.
    hertz : float
        Messages a second of one flow.
    seconds : float
    links : str
        File of the links that a sender over Zenoh has; without any where empty.
    """

    side: Literal["send", "receive"]
    kind: Literal["udp", "tcp", "zenoh"]
    address: str
    port: int
    size_bytes: int
    flows: int
    hertz: float
    seconds: float
    links: str = ""

    @property
    def count(self) -> int:
        """Messages that are sent."""
        return round(self.flows * self.hertz * self.seconds)

    @property
    def lane(self) -> Lane:
        """Of a message this large, as a cell would have it."""
        return "images" if self.size_bytes >= 16_384 else "control"

    def words(self) -> list[str]:
        """Command that runs it."""
        return [sys.executable, "-m", "benchmarks.link_end", json.dumps(asdict(self))]


def paced(hertz: float) -> Iterator[None]:
    """Yield at even instants."""
    begin, number = time.monotonic(), 0
    while True:
        time.sleep(max(0.0, begin + number / hertz - time.monotonic()))
        yield
        number += 1


def main() -> None:
    """Do what the command line says; a receiver writes ``ready``, then the ages in ms."""
    asked = Specification(**json.loads(sys.argv[1]))
    sys.setswitchinterval(0.0005)
    with ExitStack() as stack:
        if asked.side == "receive":
            _receive(asked, stack)
        else:
            _send(asked, stack)


def _send(asked: Specification, stack: ExitStack) -> None:
    put = {"udp": _udp_sender, "tcp": _tcp_sender, "zenoh": _zenoh_sender}[asked.kind](asked, stack)
    filling = bytes(asked.size_bytes - STAMP_BYTES)
    for number in range(round(asked.flows * asked.hertz * WARM_S)):
        put(number % asked.flows, bytes(asked.size_bytes))
        time.sleep(1 / asked.flows / asked.hertz)
    for number, _ in zip(range(asked.count), paced(asked.hertz * asked.flows), strict=False):
        put(number % asked.flows, time.monotonic_ns().to_bytes(STAMP_BYTES, "little") + filling)
    time.sleep(PATIENCE_S)


def _receive(asked: Specification, stack: ExitStack) -> None:
    ages_ms: list[float] = []

    def receive(sent_ns: int) -> None:
        if sent_ns:
            ages_ms.append((time.monotonic_ns() - sent_ns) / 1e6)

    start = {"udp": _udp_receiver, "tcp": _tcp_receiver, "zenoh": _zenoh_receiver}[asked.kind]
    start(asked, receive, stack)
    print("ready", flush=True)
    sys.stdin.readline()
    print(json.dumps(ages_ms), flush=True)
    # Threads still wait at their sockets.
    os._exit(0)


def _sent_ns(message: bytes | bytearray) -> int:
    return int.from_bytes(message[:STAMP_BYTES], "little")


# ---------------------------------------------------------------------------------- sockets


def _udp_sender(asked: Specification, stack: ExitStack) -> Callable[[int, bytes], object]:
    socks = [
        stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        for _ in range(asked.flows)
    ]
    for number, sock in enumerate(socks):
        sock.connect((asked.address, asked.port + number))
    return lambda flow, message: socks[flow].send(message)


def _udp_receiver(asked: Specification, receive: Receive, stack: ExitStack) -> None:
    for number in range(asked.flows):
        sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sock.bind((asked.address, asked.port + number))
        _thread(partial(_hear, asked, receive, sock))


def _hear(asked: Specification, receive: Receive, sock: socket.socket) -> None:
    receive(_sent_ns(sock.recv(asked.size_bytes)))


def _tcp_sender(asked: Specification, stack: ExitStack) -> Callable[[int, bytes], object]:
    socks = []
    for number in range(asked.flows):
        where = asked.address, asked.port + number
        socks.append(stack.enter_context(socket.create_connection(where)))
        socks[-1].setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return lambda flow, message: socks[flow].sendall(message)


def _tcp_receiver(asked: Specification, receive: Receive, stack: ExitStack) -> None:
    for number in range(asked.flows):
        server = stack.enter_context(socket.create_server((asked.address, asked.port + number)))
        _thread(partial(_accept, asked, receive, server))


def _accept(asked: Specification, receive: Receive, server: socket.socket) -> None:
    sock, _ = server.accept()
    message = bytearray(asked.size_bytes)
    with sock:
        while sock.recv_into(message, asked.size_bytes, socket.MSG_WAITALL) == asked.size_bytes:
            receive(_sent_ns(message))


def _thread(repeat: Callable[[], object]) -> None:
    def run() -> None:
        while True:
            repeat()

    threading.Thread(target=run, daemon=True).start()


# ------------------------------------------------------------------------------------ Zenoh


def _entry(asked: Specification, flow: int) -> WiringEntry:
    first = asked.port + len(SESSIONS) * flow
    names: dict[Session, int] = {"control": first, "images": first + 1}
    ends = {name: Locator(asked.address, port) for name, port in names.items()}
    if asked.side == "receive":
        return WiringEntry(Role(f"receiver{flow}@B", "B", "worker"), ends, {})
    return WiringEntry(
        Role(f"sender{flow}@A", "A", "worker"), {}, {name: (end,) for name, end in ends.items()}
    )


def _key(flow: int) -> str:
    return f"dwell/link/in/task{flow}/B/main"


def _zenoh_sender(asked: Specification, stack: ExitStack) -> Callable[[int, bytes], object]:
    ways = [ZenohTransport(_entry(asked, flow)) for flow in range(asked.flows)]
    for way in ways:
        stack.callback(way.close)
    while any(way.peers[asked.lane] == 0 for way in ways):
        time.sleep(0.01)
    senders: list[Transport] = [*ways]
    if asked.links:
        path = Path(asked.links)
        senders = [
            LinkedTransport(way, LinkEnds(path, way.entry.role.who, way.entry.role.node))
            for way in ways
        ]
    return lambda flow, message: senders[flow].put(_key(flow), message, lane=asked.lane)


def _zenoh_receiver(asked: Specification, receive: Receive, stack: ExitStack) -> None:
    def taken(sample: Arrival) -> None:
        receive(_sent_ns(sample.payload))

    for flow in range(asked.flows):
        way = ZenohTransport(_entry(asked, flow))
        stack.callback(way.close)
        way.subscribe(_key(flow), taken)


if __name__ == "__main__":
    main()
