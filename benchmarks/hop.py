"""From the end of a stage to the beginning of the next, in two workers' processes.

A cell of three tasks, of which this process plays the stamper and the last: it stamps cycles that
go to the second task on the first one's node, or on another, and hears when its stage was called.
The instants are those that a live run records: the hop's end, and one that the stage itself notes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

from benchmarks.live_cell import document, problem_of
from benchmarks.timing import ROOT
from dwell.live.stage import Message
from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.wire import channels
from dwell.live.wire.keys import MAIN, Keys
from dwell.live.wire.messages import Header, Stamp, decode, encode
from dwell.live.wire.routing import STAMPER
from dwell.live.wire.transport import Arrival
from dwell.live.wire.wiring import wire

#: Bytes, and messages of a burst of that size.
SIZES = {1_000: 100, 100_000: 100, 1_000_000: 30}
PAUSE_S = 0.003
#: Where the second task runs.
PLACES = {"HERE": {"second": "R1"}, "THERE": {"second": "E"}}
TASKS = {"first": ["R1"], "second": ["R1", "E"], "last": ["R1"]}
FLOWS = (("first", "second"), ("second", "last"))


class First:
    """Hands out a payload; its size goes by the number of the cycle."""

    def __init__(self) -> None:
        self._payloads = [bytes(size) for size in SIZES]

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the payload."""
        (message,) = inputs.values()
        return Message(self._payloads[message.cycle % len(self._payloads)])


class Second:
    """Says when it was called."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the instant."""
        return Message(time.monotonic_ns().to_bytes(8, "little"))


class Hops:
    """Stamps cycles, and hears of them."""

    def __init__(self, stamper: ZenohTransport, last: ZenohTransport, keys: Keys) -> None:
        self._stamper, self._key = stamper, keys.of(channels.INPUT, "first", "R1", MAIN)
        self._cycle = 0
        self._latency_ns = 0
        self._answered = threading.Event()
        last.subscribe(keys.of(channels.INPUT, "last", "R1", MAIN), self._arrived)

    def _arrived(self, sample: Arrival) -> None:
        header = decode(sample.header, Header)
        if header.stamp.cycle == self._cycle:
            ended_ns = {hop.task: hop.ended_ns for hop in header.hops}["first"]
            self._latency_ns = int.from_bytes(sample.payload, "little") - ended_ns
            self._answered.set()

    def ask(self, place: str, size: int, patience_s: float) -> float | None:
        """Nanoseconds from stage to stage; None where nothing arrives."""
        self._cycle += 1
        while self._cycle % len(SIZES) != list(SIZES).index(size):
            self._cycle += 1
        self._answered.clear()
        stamp = Stamp(1, self._cycle, 1, place, time.monotonic_ns())
        self._stamper.put(self._key, b"", encode(Header(stamp, STAMPER, "R1", "none")))
        return self._latency_ns if self._answered.wait(patience_s) else None

    def burst(self, place: str, size: int, count: int) -> float:
        """Median of several, milliseconds."""
        latencies: list[float] = []
        while len(latencies) < count:
            latency_ns = self.ask(place, size, 1.0)
            if latency_ns is None:
                raise RuntimeError(f"{size} bytes did not get to {place} within a second")
            latencies.append(latency_ns / 1e6)
            time.sleep(PAUSE_S)
        return median(latencies)


@contextmanager
def hops() -> Iterator[Hops]:
    """Start the workers; returns when they work."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        found = document("hop", tasks=TASKS, candidates=PLACES, flows=FLOWS, fallbacks=())
        found["tasks"]["first"]["run"] = "benchmarks.hop:First"
        found["tasks"]["second"]["run"] = "benchmarks.hop:Second"
        found["flows"][0]["bytes"] = max(SIZES)
        problem = problem_of(found, folder, links=False)
        wiring = wire(problem)
        stamper = ZenohTransport(wiring.entry("stamper@R1"))
        stack.callback(stamper.close)
        last = ZenohTransport(wiring.entry("last@R1"))
        stack.callback(last.close)
        for who in ("first@R1", "second@R1", "second@E"):
            command = [sys.executable, "-m", "dwell.live.host.role_command", "--who", who]
            child = subprocess.Popen(
                [
                    *command,
                    "--cell",
                    str(folder / "written.yaml"),
                    "--state",
                    str(folder / "state"),
                ],
                cwd=ROOT,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )
            stack.callback(child.wait)
            stack.callback(child.terminate)
        found_hops = Hops(stamper, last, Keys(problem.name))
        for place in PLACES:
            if all(found_hops.ask(place, 1_000, 0.05) is None for _ in range(400)):
                raise RuntimeError(f"no cycle gets to {place}")
        yield found_hops
