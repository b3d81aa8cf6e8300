"""Small messages beside images that would fill the link by themselves, and raw TCP's beside them.

On a link that queues all connections together, as a simple bottleneck does, and on one that queues
each by itself, as Linux does on a network card.
"""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from benchmarks.figures import Figure, Goal, Section
from dwell.demo.link import Forward, LinkProcess
from dwell.demo.link_rate import Sharing
from dwell.live.transport.transport import Arrival, Lane
from dwell.live.transport.zenoh import ZenohSettings, ZenohTransport
from dwell.live.wiring import Locator, Role, Session, WiringEntry
from dwell.model import Constant
from dwell.testbed.conditions import Conditions

__all__ = ["measure"]

RATE_MBPS = 20.0
IMAGE_BYTES, IMAGE_HZ = 100_000, 30
SMALL_BYTES, SMALL_HZ = 1_000, 100
#: Over raw TCP, where connections queue together; over a link without images, where they do not.
MOST_ADDED_MS = 1.0
FIRST_PORT = 29_500
BOTH: tuple[Session, ...] = ("control", "images")


@dataclass(frozen=True, slots=True)
class _Case:
    sharing: Sharing = "fifo"
    images: bool = True
    protocol: str = "tcp"
    sessions: tuple[Session, ...] = BOTH
    bare: bool = False


CASES: Mapping[str, _Case] = {
    "alone": _Case(images=False),
    "one queue": _Case(),
    "one queue, raw TCP": _Case(bare=True),
    "one queue, in one session": _Case(sessions=("control",)),
    "a queue each": _Case("fair"),
    "a queue each, raw TCP": _Case("fair", bare=True),
    "alone, tls": _Case(images=False, protocol="tls"),
    "one queue, tls": _Case(protocol="tls"),
    "a queue each, tls": _Case("fair", protocol="tls"),
}
#: What a case is compared with, and at which share of the messages.
AGAINST = {
    "one queue": ("one queue, raw TCP", "p50"),
    "one queue, tls": ("one queue, raw TCP", "p50"),
    "a queue each": ("alone", "p95"),
    "a queue each, tls": ("alone, tls", "p95"),
}


def measure(quick: bool) -> Section:
    """Latency of small messages, and what arrives of them."""
    runs, seconds = (1, 4.0) if quick else (3, 8.0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    found: dict[tuple[str, str], list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        secured = ZenohSettings(more=_certified(Path(folder)))
        for turn in range(runs):
            for name, case in CASES.items():
                ages = _Ages()
                settings = secured if case.protocol == "tls" else ZenohSettings()
                with _link(case, turn) as link:
                    run = _raw if case.bare else _through_zenoh
                    run(case, link, ages, seconds, settings)
                for what, value in ages.told(seconds, images=case.images).items():
                    found.setdefault((name, what), []).append(value)
    figures = []
    for (name, what), values in found.items():
        goal = Goal(low=100) if what == "delivered" and len(CASES[name].sessions) > 1 else None
        figures.append(Figure(f"{name}: {what}", values, "%" if "deliv" in what else "ms", goal))
        other, at = AGAINST.get(name, ("", ""))
        if what == at:
            added = [a - b for a, b in zip(values, found[other, at], strict=True)]
            goal = Goal(high=MOST_ADDED_MS)
            figures.append(Figure(f"  more than {other}: {at}", added, "ms", goal))
    return Section(
        f"{SMALL_HZ} small messages a second on a link of {RATE_MBPS:g} Mbit/s, beside images",
        figures,
        [
            f"images of {IMAGE_BYTES // 1000} kB, {IMAGE_HZ} a second: "
            f"{8e-6 * IMAGE_BYTES * IMAGE_HZ:g} Mbit/s",
            "one queue: of 64 kB, which takes 26 ms to drain; two sessions is what a cell has",
        ],
    )


class _Ages:
    """Ages of messages on arrival."""

    def __init__(self) -> None:
        self.of: dict[Lane, list[float]] = {"control": [], "images": []}

    def take(self, lane: Lane, message: bytes) -> None:
        """Take a message in, which begins with when it was sent."""
        sent_ns = int.from_bytes(message[:8], "little")
        self.of[lane].append((time.monotonic_ns() - sent_ns) / 1e6)

    def told(self, seconds: float, *, images: bool) -> dict[str, float]:
        """Return what is to be told of a run."""
        small = sorted(self.of["control"])
        told = {
            "p50": median(small),
            "p95": small[int(0.95 * len(small))],
            "delivered": 100 * len(small) / (SMALL_HZ * seconds),
        }
        if images:
            told["images delivered"] = 100 * len(self.of["images"]) / (IMAGE_HZ * seconds)
        return told


def _ports(case: _Case) -> list[int]:
    return [FIRST_PORT + number for number in range(len(case.sessions))]


@contextmanager
def _link(case: _Case, seed: int) -> Iterator[LinkProcess]:
    conditions = Conditions(delay_ms=Constant(1.0), rate_mbps=RATE_MBPS)
    both = {("A", "B"): conditions, ("B", "A"): conditions}
    forwards = [Forward("A", "127.0.0.1", port) for port in _ports(case)]
    with LinkProcess(("A", "B"), forwards, both, seed=seed, sharing=case.sharing) as link:
        yield link


def _through_zenoh(
    case: _Case, link: LinkProcess, ages: _Ages, seconds: float, settings: ZenohSettings
) -> None:
    """Send through the transport of a cell."""

    def locators(ports: tuple[int, ...] | list[int]) -> dict[Session, Locator]:
        pairs = zip(case.sessions, ports, strict=True)
        return {name: Locator("127.0.0.1", port, case.protocol) for name, port in pairs}

    there = WiringEntry(Role("there@B", "B", "worker"), locators(_ports(case)), {})
    ends = {name: (end,) for name, end in locators(link.ports).items()}
    with ExitStack() as stack:
        receiver = ZenohTransport(there, settings)
        stack.callback(receiver.close)
        sender = ZenohTransport(WiringEntry(Role("here@A", "A", "worker"), {}, ends), settings)
        stack.callback(sender.close)

        def arrived(sample: Arrival) -> None:
            ages.take("images" if "/image/" in sample.key else "control", sample.payload)

        receiver.subscribe("dwell/bench/in/**", arrived)
        while any(count == 0 for count in sender.peers.values()):
            time.sleep(0.01)
        time.sleep(0.5)
        _send(
            lambda message: sender.put("dwell/bench/in/small/B/main", message),
            lambda message: sender.put("dwell/bench/in/image/B/main", message, lane="images"),
            seconds,
            images=case.images,
        )


def _raw(
    case: _Case, link: LinkProcess, ages: _Ages, seconds: float, _settings: ZenohSettings
) -> None:
    """Send over two connections, one for small messages and one for images."""
    lanes: tuple[tuple[Lane, int], ...] = (("control", SMALL_BYTES), ("images", IMAGE_BYTES))

    def read(end: socket.socket, lane: Lane, size: int) -> None:
        while len(message := end.recv(size, socket.MSG_WAITALL)) == size:
            ages.take(lane, message)

    with ExitStack() as stack:
        senders, threads = [], []
        for port, seen, (lane, size) in zip(_ports(case), link.ports, lanes, strict=True):
            server = stack.enter_context(socket.create_server(("127.0.0.1", port)))
            sender = stack.enter_context(socket.create_connection(("127.0.0.1", seen)))
            sender.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            end = stack.enter_context(server.accept()[0])
            senders.append(sender)
            threads.append(threading.Thread(target=read, args=(end, lane, size)))
        for thread in threads:
            thread.start()
        _send(senders[0].sendall, senders[1].sendall, seconds, images=case.images)
        for sender in senders:
            sender.shutdown(socket.SHUT_WR)
        for thread in threads:
            thread.join()


def _send(
    small: Callable[[bytes], None],
    image: Callable[[bytes], None],
    seconds: float,
    *,
    images: bool,
) -> None:
    """Send small messages and images for a while, each from a thread of its own."""
    begin = time.monotonic() + 0.2
    streams = [_Stream(small, SMALL_BYTES, SMALL_HZ, begin, seconds)]
    if images:
        streams.append(_Stream(image, IMAGE_BYTES, IMAGE_HZ, begin, seconds))
    threads = [threading.Thread(target=stream.run) for stream in streams]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    time.sleep(0.5)


@dataclass(slots=True)
class _Stream:
    put: Callable[[bytes], None]
    size: int
    hertz: int
    begin: float
    seconds: float
    waiting: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Send in time; what blocks does not make it longer."""
        padding = bytes(self.size - 8)
        for number in range(int(self.hertz * self.seconds)):
            self.waiting.wait(max(self.begin + number / self.hertz - time.monotonic(), 0.0))
            if time.monotonic() > self.begin + self.seconds:
                break
            self.put(time.monotonic_ns().to_bytes(8, "little") + padding)


def _certified(folder: Path) -> dict[str, object]:
    """Return Zenoh's settings for an authority, and a certificate by it, that nobody else knows."""
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1")
    san = ("-addext", "subjectAltName=IP:127.0.0.1", "-addext", "basicConstraints=CA:FALSE")
    by = ("-CA", "ca.pem", "-CAkey", "ca.key")
    for name, more in (("ca", ()), ("node", (*by, *san))):
        made = ("-keyout", f"{name}.key", "-out", f"{name}.pem", "-subj", f"/CN={name}")
        words = ["openssl", "req", "-x509", *key, *made, *more]
        subprocess.run(words, cwd=folder, check=True, capture_output=True)
    tls = "transport/link/tls"
    return {
        f"{tls}/root_ca_certificate": str(folder / "ca.pem"),
        f"{tls}/listen_private_key": str(folder / "node.key"),
        f"{tls}/listen_certificate": str(folder / "node.pem"),
    }
