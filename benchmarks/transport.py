"""One-way latency between two processes: raw TCP, bare Zenoh, a live cell's transport and workers.

The receiver notes the instant at which it holds the payload as bytes, and sends it back; both
processes read one clock. Each kind has a process of its own that answers; they take turns. Between
workers it is the time from the end of a stage to the call of the next (see `hop`).
"""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from statistics import median
from typing import Any

from benchmarks.figures import Figure, Goal, Section
from benchmarks.hop import PAUSE_S, SIZES, hops
from benchmarks.timing import ROOT
from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import SESSIONS, Locator, Role, WiringEntry

#: What each message begins with, and each answer is: a number and an instant.
MARK = struct.Struct("<qq")
HEADER = bytes(300)
HERE, THERE, NEAR = "here@R1", "there@E", "near@R1"

Put = Callable[[bytes], None]
Arrived = Callable[[bytes], None]
Burst = Callable[[int, int], float]


def measure(quick: bool) -> Section:
    """Median one-way latency of each kind and size, and what ours adds to bare Zenoh."""
    rounds = 3 if quick else 11
    _unpin()
    found: dict[tuple[str, int], list[float]] = {}
    with ExitStack() as stack:
        kinds = {
            name: stack.enter_context(_partner(name)) for name in ("tcp", "zenoh", "ours", "shared")
        }
        workers = stack.enter_context(hops())
        bursts: dict[str, Burst] = {
            **{name: kind.burst for name, kind in kinds.items()},
            "far": partial(workers.burst, "THERE"),
            "near": partial(workers.burst, "HERE"),
        }
        names = list(bursts)
        for turn in range(-1, rounds):
            for size, count in SIZES.items():
                begin = turn % len(names)
                for name in names[begin:] + names[:begin]:
                    latency_ms = bursts[name](size, count)
                    if turn >= 0:  # a round that does not count goes ahead
                        found.setdefault((name, size), []).append(latency_ms)
    labels = {
        "tcp": "raw TCP",
        "zenoh": "bare Zenoh",
        "ours": "ours, to another node",
        "shared": "ours, on one node",
        "far": "stage to stage, another node",
        "near": "stage to stage, one node",
    }
    figures = [
        Figure(f"{label}, {_text(size)}", found[name, size], "ms")
        for size in SIZES
        for name, label in labels.items()
    ]
    for name in ("ours", "far", "near"):
        for size in SIZES:
            pairs = zip(found[name, size], found["zenoh", size], strict=True)
            goal = Goal(high=0.15) if size == 100_000 else None
            what = f"{labels[name]}, over bare Zenoh, {_text(size)}"
            figures.append(Figure(what, [one - other for one, other in pairs], "ms", goal))
    return Section(
        "One-way latency between two processes on loopback, median of a burst",
        figures,
        [
            f"elapsed time, on all cores; {rounds} rounds in turns, pauses of {PAUSE_S * 1e3:g} ms",
            "ours: our transport with a header of 300 bytes; on one node 100 kB go through shared "
            "memory",
            "stage to stage: everything between the end of a stage and the call of the next",
        ],
    )


def _unpin() -> None:
    """Undo the pinning of the parent: two processes talk to each other, each on its own core."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, range(os.cpu_count() or 1))


def _text(size: int) -> str:
    return f"{size // 1_000} kB" if size < 1_000_000 else f"{size // 1_000_000} MB"


class _Partner:
    """The other end of one kind of connection: what is put there comes back as an instant."""

    def __init__(self) -> None:
        self.put: Put = lambda payload: None
        self._answered = threading.Event()
        self._number = 0
        self._arrived_ns = 0

    def answer(self, data: bytes) -> None:
        number, arrived_ns = MARK.unpack(data)
        if number == self._number:
            self._arrived_ns = arrived_ns
            self._answered.set()

    def ask(self, padding: bytes, patience_s: float) -> float | None:
        """Latency of one message, nanoseconds; None where no answer comes."""
        self._number += 1
        self._answered.clear()
        payload = self._number.to_bytes(8, "little") + padding
        sent_ns = time.monotonic_ns()
        self.put(payload)
        if not self._answered.wait(patience_s):
            return None
        return self._arrived_ns - sent_ns

    def burst(self, size: int, count: int) -> float:
        """Median latency of several messages, milliseconds."""
        padding = bytes(size - 8)
        latencies: list[float] = []
        while len(latencies) < count:
            latency_ns = self.ask(padding, 1.0)
            if latency_ns is None:
                raise RuntimeError(f"no answer to {size} bytes within a second")
            latencies.append(latency_ns / 1e6)
            time.sleep(PAUSE_S)
        return median(latencies)


@contextmanager
def _partner(kind: str) -> Iterator[_Partner]:
    """Open a connection of a kind to a process of its own."""
    partner = _Partner()
    port = _free_ports(9)
    command = [sys.executable, "-m", "benchmarks.transport", json.dumps([kind, port])]
    with ExitStack() as stack:
        if kind == "tcp":
            listener = stack.enter_context(socket.create_server(("127.0.0.1", port)))
        else:
            partner.put = stack.enter_context(_open(kind, port, HERE, partner.answer))
        child = subprocess.Popen(command, cwd=ROOT)
        stack.callback(child.wait)
        stack.callback(child.kill)
        if kind == "tcp":
            connection = stack.enter_context(listener.accept()[0])
            partner.put = _framed(connection, partner.answer)
        if all(partner.ask(b"", 0.05) is None for _ in range(400)):
            raise RuntimeError(f"{' '.join(command)} does not answer")
        yield partner


def _answer(kind: str, port: int) -> None:
    """Answer every message with its number and the present instant, for as long as it lives."""
    opened = threading.Event()
    put: Put

    def arrived(payload: bytes) -> None:
        now_ns = time.monotonic_ns()
        opened.wait()
        put(MARK.pack(int.from_bytes(payload[:8], "little"), now_ns))

    with ExitStack() as stack:
        if kind == "tcp":
            put = _framed(socket.create_connection(("127.0.0.1", port)), arrived)
        else:
            who = NEAR if kind == "shared" else THERE
            put = stack.enter_context(_open(kind, port, who, arrived))
        opened.set()
        threading.Event().wait()


def _framed(connection: socket.socket, arrived: Arrived) -> Put:
    """Messages with their length in front, read by a thread."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def exactly(count: int) -> bytes:
        buffer = bytearray(count)
        view = memoryview(buffer)
        while view:
            read = connection.recv_into(view)
            if read == 0:
                raise EOFError
            view = view[read:]
        return bytes(buffer)

    def read() -> None:
        try:
            while True:
                arrived(exactly(int.from_bytes(exactly(4), "little")))
        except (EOFError, OSError):
            return

    threading.Thread(target=read, daemon=True).start()
    return lambda payload: connection.sendall(len(payload).to_bytes(4, "little") + payload)


@contextmanager
def _open(kind: str, port: int, who: str, arrived: Arrived) -> Iterator[Put]:
    """One end of a connection over Zenoh: as it comes, or through our transport."""
    here = who == HERE
    if kind == "zenoh":
        import zenoh

        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "listen/endpoints": [f"tcp/127.0.0.1:{port}"] if here else [],
            "connect/endpoints": [] if here else [f"tcp/127.0.0.1:{port}"],
            "transport/shared_memory/enabled": False,
        }
        for path, value in settings.items():
            config.insert_json5(path, json.dumps(value))
        with zenoh.open(config) as session:
            block = zenoh.CongestionControl.BLOCK
            publisher = session.declare_publisher(
                "echo/ask" if here else "echo/answer", congestion_control=block
            )
            session.declare_subscriber(
                "echo/answer" if here else "echo/ask",
                lambda sample: arrived(sample.payload.to_bytes()),
            )
            yield publisher.put
        return
    transport = ZenohTransport(_entry(who, NEAR if kind == "shared" else THERE, port))
    node = ("E" if kind == "ours" else "R1") if here else "R1"
    key = f"dwell/bench/in/{'ask' if here else 'answer'}/{node}/main"

    def received(sample: Arrival) -> None:
        arrived(sample.payload)

    transport.subscribe(f"dwell/bench/in/{'answer' if here else 'ask'}/**", received)
    try:
        yield lambda payload: transport.put(
            key, payload, HEADER, lane="images" if len(payload) >= 16_384 else "control"
        )
    finally:
        transport.close()


def _entry(who: str, other: str, port: int) -> WiringEntry:
    ends = {name: Locator("127.0.0.1", port + i) for i, name in enumerate(SESSIONS)}
    role = Role(who, who.partition("@")[2], "worker")
    if who == HERE:
        return WiringEntry(role, ends, {})
    return WiringEntry(role, {}, {name: (end,) for name, end in ends.items()})


def _free_ports(count: int) -> int:
    """First of that many ports that nobody listens on."""
    for first in range(30_000, 32_000, count):
        try:
            for port in range(first, first + count):
                socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return first
    raise RuntimeError("no free ports")


if __name__ == "__main__":
    _answer(*json.loads(sys.argv[1]))
