"""Links of messages: what they add by themselves, how late they are, and the CPU they take."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from benchmarks.figures import Figure, Goal, Section
from dwell.live.local.linked_transport import LinkedTransport
from dwell.live.local.message_links import LinkEnds, LinkFile
from dwell.live.wire.transport import Arrival
from dwell.model import Constant
from tests.live.direct_transport import DirectTransport

NODES = ("R1", "E")
SIZES = {"200 bytes": 200, "300 kB": 300_000}
#: Keys of a message that meets its link at the sender, and of one that meets it at the receiver.
KEYS = {"at the sender": "dwell/cell/in/perception/E/work", "at the receiver": "dwell/cell/stamped"}
DELAY_MS, HERTZ = 25.0, 200
LATE_MS, ADDED_MS = 0.3, 0.1


def measure(quick: bool) -> Section:
    """Time of a put through a link without a delay; lateness and CPU at 25 ms."""
    runs, count = (1, 400) if quick else (5, 2_000)
    figures = []
    for where, key in KEYS.items():
        for name, size in SIZES.items():
            added = [_added_ms(key, size, count) for _ in range(runs)]
            figures.append(Figure(f"{where}, {name}: added p50", added, "ms", Goal(high=ADDED_MS)))
    found = [_late(count) for _ in range(runs)]
    figures += [
        Figure("25 ms at 200/s: late, p50", [one[0] for one in found], "ms", Goal(high=LATE_MS)),
        Figure("  late, p95", [one[1] for one in found], "ms"),
        Figure("  CPU", [one[2] for one in found], "%"),
    ]
    notes = ["in one process, without Zenoh: what the decorator itself takes"]
    return Section("Links of messages", figures, notes)


@contextmanager
def _pair() -> Iterator[tuple[LinkFile, LinkedTransport, LinkedTransport]]:
    with tempfile.TemporaryDirectory() as folder:
        carrier = DirectTransport()
        with closing(LinkFile(Path(folder) / "links", NODES, seed=1)) as file:
            sender = LinkedTransport(carrier, LinkEnds(file.path, "camera@R1", "R1"))
            receiver = LinkedTransport(carrier, LinkEnds(file.path, "perception@E", "E"))
            yield file, sender, receiver
            sender.close()
            receiver.close()


def _added_ms(key: str, size: int, count: int) -> float:
    """Median time from a put until it is received, over that of the carrier alone."""
    payload, times = bytes(size), []
    with _pair() as (_, sender, receiver):
        receiver.subscribe("**", lambda sample: times.append(time.perf_counter_ns()))
        begun = []
        for _ in range(count):
            begun.append(time.perf_counter_ns())
            sender.put(key, payload)
    pairs = zip(begun, times, strict=True)
    through = statistics.median(end - begin for begin, end in pairs)
    carrier, times = DirectTransport(), []
    carrier.subscribe("**", lambda sample: times.append(time.perf_counter_ns()))
    begun = []
    for _ in range(count):
        begun.append(time.perf_counter_ns())
        carrier.put(key, payload)
    direct = statistics.median(end - begin for begin, end in zip(begun, times, strict=True))
    return (through - direct) / 1e6


def _late(count: int) -> tuple[float, float, float]:
    """Return by how much messages are late, median and 95 %, and the CPU that this takes."""
    late: list[float] = []
    with _pair() as (file, sender, receiver):
        file.set("R1", "E", delay_ms=Constant(DELAY_MS))

        def receive(sample: Arrival) -> None:
            sent_ns = int.from_bytes(sample.payload, "little")
            late.append((time.monotonic_ns() - sent_ns) / 1e6 - DELAY_MS)

        receiver.subscribe("**", receive)
        begun_s, used = time.monotonic(), os.times()
        for number in range(count):
            time.sleep(max(begun_s + number / HERTZ - time.monotonic(), 0))
            sender.put(KEYS["at the sender"], time.monotonic_ns().to_bytes(8, "little"))
        time.sleep(2 * DELAY_MS / 1e3)
        took = os.times()
    cpu_s = took.user + took.system - used.user - used.system
    late.sort()
    share = 100 * cpu_s / (time.monotonic() - begun_s)
    return statistics.median(late), late[int(0.95 * len(late))], share
