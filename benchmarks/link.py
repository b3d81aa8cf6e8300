"""The emulated link: what it adds by itself, how exact its delays are, and the CPU it takes."""

from __future__ import annotations

import json
import os
import select
import socket
import statistics
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.figures import Figure, Goal, Section
from dwell.demo.link import Forward, LinkProcess, Traffic
from dwell.model import Normal

if TYPE_CHECKING:
    import zenoh

__all__ = ["measure"]

DELAY = Normal(25.0, 5.0)
IMAGE_BYTES = 300_000
IMAGE_HZ, SMALL_HZ = 25, 300
SMALL_BYTES = 200
# Messages of one connection a second, and connections: the delay's error is that of all of them.
RATES = {30: 20, 100: 6}
TOLERANCE_MS = 0.3
FLOOR_MS = 0.3
ECHOES = 200

INIT = bytes([0x03, 0x00, 0x01, 0x09, 0x00])


def measure(quick: bool) -> Section:
    """Floor over raw TCP, delays against those asked for, CPU under the load of a camera."""
    runs, seconds = (1, 3.0) if quick else (3, 10.0)
    # The link has a process of its own, and is not to compete with this one for a core.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    floors = [_floor_ms() for _ in range(runs)]
    figures = [
        Figure("one way through it, over raw TCP, p50", [one[0] for one in floors], "ms"),
        Figure("  added p50", [one[1] for one in floors], "ms", Goal(high=FLOOR_MS)),
        Figure("  added p95", [one[2] for one in floors], "ms"),
    ]
    tolerance = Goal(-TOLERANCE_MS, TOLERANCE_MS)
    lateness: list[Traffic] = []
    for hertz, connections in RATES.items():
        found = [_delays(hertz, connections, seconds) for _ in range(runs)]
        lateness += [traffic for _, traffic in found]
        mean, std = _in_order(hertz)
        means = [statistics.mean(ages) - mean for ages, _ in found]
        stds = [statistics.pstdev(ages) - std for ages, _ in found]
        figures += [
            Figure(f"25±5 ms at {hertz}/s: mean − {mean:.2f}", means, "ms", tolerance),
            Figure(f"  standard deviation − {std:.2f}", stds, "ms", tolerance),
            Figure("  its own lateness", [one.late_mean_ms for _, one in found], "ms"),
        ]
    loads = [_load(seconds) for _ in range(runs)]
    figures += [
        Figure("Zenoh, 25 images of 300 kB and 300 small/s: CPU", [one[0] for one in loads], "%"),
        Figure("  its own lateness", [one[1] for one in loads], "ms"),
    ]
    samples = [hertz * connections * int(seconds) for hertz, connections in RATES.items()]
    worst = max(one.late_max_ms for one in lateness)
    notes = [
        f"delays: {samples} messages a run, so that the error of a mean is "
        f"{DELAY.std / min(samples) ** 0.5:.2f} ms; latest departure {worst:.1f} ms",
        "elapsed times of unpinned processes: other work on the machine is part of them",
        "what is subtracted: 25±5 ms drawn independently, of which order within a connection makes "
        "a little more and a little less",
    ]
    return Section("Emulated link", figures, notes)


def _framed(number: int, payload: bytes) -> bytes:
    """Return a put in a frame in a batch, as Zenoh writes it."""
    sn = bytes([number & 0x7F | 0x80, number >> 7 & 0x7F | 0x80, number >> 14 & 0x7F])
    size = bytes([len(payload) & 0x7F | 0x80, len(payload) >> 7])
    batch = b"\x25" + sn + b"\x3d\x00\x01k\x01" + size + payload
    return len(batch).to_bytes(2, "little") + batch


def _floor_ms() -> tuple[float, float, float]:
    """Return half a round trip through the link, and what that is over one without it."""
    with ExitStack() as stack:
        server, port = stack.enter_context(_server())
        link = stack.enter_context(LinkProcess(*_one(port)))
        threading.Thread(target=_echo, args=(server, 2), daemon=True).start()
        direct, through = _dial(port, stack), _dial(link.ports[0], stack)
        times: dict[socket.socket, list[float]] = {direct: [], through: []}
        for sock in times:
            sock.sendall(INIT)
            sock.recv(len(INIT), socket.MSG_WAITALL)
        for number in range(ECHOES):
            for sock, found in times.items():
                found.append(_echo_ms(sock, _framed(number, bytes(SMALL_BYTES))))
                time.sleep(0.002)
    pairs = zip(times[through], times[direct], strict=True)
    added = sorted((one - other) / 2 for one, other in pairs)
    half = [one / 2 for one in times[through]]
    return statistics.median(half), statistics.median(added), added[int(0.95 * len(added))]


def _echo(server: socket.socket, connections: int) -> None:
    socks = [server.accept()[0] for _ in range(connections)]
    for sock in socks:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    while socks:
        for sock in select.select(socks, [], [])[0]:
            received = sock.recv(65_536)
            if received:
                sock.sendall(received)
            else:
                socks.remove(sock)
                sock.close()


def _echo_ms(sock: socket.socket, message: bytes) -> float:
    begin_ns = time.perf_counter_ns()
    sock.sendall(message)
    left = len(message)
    while left:
        left -= len(sock.recv(left))
    return (time.perf_counter_ns() - begin_ns) / 1e6


def _delays(hertz: int, connections: int, seconds: float) -> tuple[list[float], Traffic]:
    """Return the age of each message on arrival, ms, and what the link says of them."""
    with ExitStack() as stack:
        server, port = stack.enter_context(_server())
        link = stack.enter_context(LinkProcess(*_one(port)))
        senders, receivers = [], []
        for _ in range(connections):
            senders.append(_dial(link.ports[0], stack))
            receivers.append(stack.enter_context(server.accept()[0]))
            senders[-1].sendall(INIT)
            receivers[-1].recv(len(INIT), socket.MSG_WAITALL)
        link.set("A", "B", delay_ms=DELAY)
        count = int(hertz * connections * seconds)
        ages_ms: list[float] = []
        receiver = threading.Thread(target=_receive, args=(receivers, count, ages_ms))
        receiver.start()
        for number, _ in zip(range(count), _paced(hertz * connections), strict=False):
            now = time.monotonic_ns().to_bytes(8, "little")
            senders[number % connections].sendall(_framed(number, bytes(SMALL_BYTES) + now))
        receiver.join()
        return ages_ms, link.stats()["A", "B"]


def _in_order(hertz: int) -> tuple[float, float]:
    """Return mean and standard deviation of the delay where no message overtakes another."""
    release_ms = np.arange(200_000) * 1e3 / hertz
    arrival_ms = release_ms + DELAY.marginal(np.random.default_rng(0), len(release_ms))
    age_ms = np.maximum.accumulate(arrival_ms) - release_ms
    return float(age_ms.mean()), float(age_ms.std())


def _receive(socks: Sequence[socket.socket], count: int, ages_ms: list[float]) -> None:
    size = len(_framed(0, bytes(SMALL_BYTES + 8)))
    left = dict.fromkeys(socks, b"")
    while len(ages_ms) < count:
        for sock in select.select(socks, [], [])[0]:
            left[sock] += sock.recv(65_536)
            now_ns = time.monotonic_ns()
            while len(left[sock]) >= size:
                sent_ns = int.from_bytes(left[sock][size - 8 : size], "little")
                ages_ms.append((now_ns - sent_ns) / 1e6)
                left[sock] = left[sock][size:]


def _load(seconds: float) -> tuple[float, float]:
    """Return the share of a core that the link takes, percent, and its mean lateness, ms."""
    with _server() as (_, port):
        pass
    with ExitStack() as stack:
        received = stack.enter_context(_session(listen=port))
        received.declare_subscriber("t/*", lambda _sample: None)
        link = stack.enter_context(LinkProcess(*_one(port)))
        link.set("A", "B", delay_ms=DELAY)
        publishers: list[Any] = []
        for name in ("small", "image"):
            session = stack.enter_context(_session(connect=link.ports[0]))
            publishers.append(session.declare_publisher(f"t/{name}", express=True))
        while not all(item.matching_status.matching for item in publishers):
            time.sleep(0.01)
        small, image = publishers
        before_s = link.stats(reset=True)["A", "B"].cpu_s
        begin = time.monotonic()
        pictures = 0
        for number, _ in zip(range(int(SMALL_HZ * seconds)), _paced(SMALL_HZ), strict=False):
            small.put(bytes(SMALL_BYTES))
            if number * IMAGE_HZ >= pictures * SMALL_HZ:
                image.put(bytes(IMAGE_BYTES))
                pictures += 1
        traffic = link.stats()["A", "B"]
        return 100 * (traffic.cpu_s - before_s) / (time.monotonic() - begin), traffic.late_mean_ms


def _session(*, listen: int | None = None, connect: int | None = None) -> zenoh.Session:
    import zenoh

    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "listen/endpoints": [f"tcp/127.0.0.1:{listen}"] if listen else [],
        "connect/endpoints": [f"tcp/127.0.0.1:{connect}"] if connect else [],
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _paced(hertz: float) -> Iterator[None]:
    begin, number = time.monotonic(), 0
    while True:
        time.sleep(max(0.0, begin + number / hertz - time.monotonic()))
        yield
        number += 1


def _one(port: int) -> tuple[tuple[str, str], list[Forward]]:
    return ("A", "B"), [Forward("A", "127.0.0.1", port)]


@contextmanager
def _server() -> Iterator[tuple[socket.socket, int]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server, server.getsockname()[1]


def _dial(port: int, stack: ExitStack) -> socket.socket:
    sock = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return sock
