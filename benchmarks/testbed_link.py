"""The link of a testbed: what it adds by itself, how exact delays and losses are, and its CPU.

Two network namespaces, a TUN link between, and a process in each: one puts messages that tell when
they were sent, the other notes how old they are. Both read one clock.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.figures import Figure, Goal, Section
from benchmarks.link_end import Specification
from dwell.live.local.message_links import LinkFile
from dwell.model import Constant, Normal
from dwell_lab.testbed.forwarder import Passed
from dwell_lab.testbed.hosts import Hosts
from dwell_lab.testbed.link import TunLink

ROOT = Path(__file__).resolve().parents[1]
NODES = "A", "B"
AB = "A", "B"
DELAY = Normal(25.0, 5.0)
STILL = Constant(0.0)
LOSS = 0.02
PORT = 7_400
TOLERANCE = Goal(-0.3, 0.3)
FLOOR_MS = 0.3
CORE_PERCENT = 25.0
# Within which a share of independent losses lies 997 times of 1000.
DEVIATIONS = Goal(-3.0, 3.0)
START_S = 60.0


@dataclass(frozen=True, slots=True)
class _Kind:
    """Messages that are measured: flows that take turns, each at `hertz`."""

    what: str
    kind: Literal["udp", "tcp", "zenoh"]
    size_bytes: int
    flows: int
    hertz: float = 25.0

    def asked(self, side: Literal["send", "receive"], address: str, s: float) -> Specification:
        return Specification(
            side, self.kind, address, PORT, self.size_bytes, self.flows, self.hertz, s
        )


UDP = _Kind("UDP, 64 bytes", "udp", 64, 20)
SMALL = _Kind("TCP, 1 kB", "tcp", 1_000, 20)
IMAGES = _Kind("TCP, 300 kB", "tcp", 300_000, 5)
PUTS = _Kind("Zenoh, 1 kB", "zenoh", 1_000, 12)
PICTURES = _Kind("Zenoh, 300 kB", "zenoh", 300_000, 4)
CLOSE = replace(SMALL, what="TCP, 1 kB, 100 messages/s a flow", hertz=100.0, flows=5)


def measure(quick: bool) -> Section:
    """Floor, delays of UDP, TCP and Zenoh against those asked for, losses, CPU, close bursts."""
    runs, seconds = (1, 8.0) if quick else (3, 16.0)
    # The link has a process of its own, and is not to compete with this one for a core.
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    figures: list[Figure] = []
    with _bench() as bench:
        for kind in (UDP, SMALL, IMAGES, PUTS, PICTURES):
            figures += bench.floor(kind, runs, 3.0)
        for kind in (UDP, SMALL, IMAGES, PUTS, PICTURES, CLOSE):
            figures += bench.delays(kind, runs, seconds)
        figures.append(Figure("latest departure", [bench.worst_ms], "ms"))
        scheduling = bench.link.scheduling
    samples = [round(each.flows * each.hertz * seconds) for each in (IMAGES, PICTURES)]
    notes = [
        f"delays: at least {min(samples)} messages a run, so that the error of a mean is up to "
        f"{DELAY.std / min(samples) ** 0.5:.2f} ms and that of a standard deviation "
        f"{DELAY.std / (2 * min(samples)) ** 0.5:.2f} ms, whatever the link does",
        "what is subtracted: 25±5 ms drawn independently, in order within a flow, and the median "
        "within one host (what sending, receiving and Zenoh take); order makes at 25 messages a "
        f"second of a flow {_in_order(25.0)[0] - 25.0:+.3f} ms, at 100 "
        f"{_in_order(100.0)[0] - 25.0:+.2f} ms",
        f"scheduling of the link's process: {scheduling}; elapsed times of unpinned processes: "
        "other work on the machine is part of them",
    ]
    return Section("Link of the testbed", figures, notes)


class _Bench:
    """Two hosts and the link between."""

    def __init__(self, hosts: Hosts, link: TunLink, losses: LinkFile) -> None:
        self.link = link
        self.worst_ms = 0.0
        self._direct_ms: dict[tuple[str, int], float] = {}
        self._hosts, self._losses = hosts, losses

    def floor(self, kind: _Kind, runs: int, seconds: float) -> Iterator[Figure]:
        """What the link adds to messages within one host."""
        self.link.set(*AB, delay_ms=STILL)
        self.link.set("B", "A", delay_ms=STILL)
        added = []
        for _ in range(runs):
            direct, _ = self._ages(kind, seconds, sender="B")
            through, _ = self._ages(kind, seconds)
            added.append([_quantile(through, q) - _quantile(direct, q) for q in (0.5, 0.95)])
            self._direct_ms[kind.kind, kind.size_bytes] = statistics.median(direct)
        goal = Goal(high=FLOOR_MS)
        yield Figure(f"{kind.what}: added p50", [one[0] for one in added], "ms", goal)
        yield Figure("  added p95", [one[1] for one in added], "ms")

    def delays(self, kind: _Kind, runs: int, seconds: float) -> Iterator[Figure]:
        """Delays against those asked for; with Zenoh losses, too; CPU where the load is high."""
        self.link.set(*AB, delay_ms=DELAY)
        self.link.set("B", "A", delay_ms=DELAY)
        loss = LOSS if kind.kind == "zenoh" else 0.0
        self._losses.set(*AB, loss=loss)
        found = [self._ages(kind, seconds) for _ in range(runs)]
        mean, std = _in_order(kind.hertz)
        direct_ms = self._direct_ms[kind.kind, kind.size_bytes]
        means = [statistics.mean(ages) - mean - direct_ms for ages, _ in found]
        stds = [statistics.pstdev(ages) - std for ages, _ in found]
        what = f"{kind.what}: mean − {mean:.2f} − {direct_ms:.2f}"
        yield Figure(what, means, "ms", TOLERANCE)
        yield Figure(f"  standard deviation − {std:.2f}", stds, "ms", TOLERANCE)
        if loss:
            sent = round(kind.flows * kind.hertz * seconds)
            spread = (sent * loss * (1 - loss)) ** 0.5
            off = [(sent - len(ages) - sent * loss) / spread for ages, _ in found]
            shares = [100 * (1 - len(ages) / sent) for ages, _ in found]
            yield Figure("  lost", shares, "%")
            yield Figure("  lost, off 2 % in standard deviations", off, "", DEVIATIONS)
        if kind.size_bytes > 100_000:
            cpu = [100 * passed.cpu_s / seconds for _, passed in found]
            megabits = kind.flows * kind.hertz * kind.size_bytes * 8e-6
            goal = Goal(high=CORE_PERCENT)
            yield Figure(f"  CPU of the link at {megabits:.0f} Mbit/s", cpu, "%", goal)
        self._losses.set(*AB, loss=0.0)

    def _ages(
        self, kind: _Kind, seconds: float, *, sender: str = "A"
    ) -> tuple[list[float], Passed]:
        """Return the ages of messages on arrival, ms, and what has passed the link."""
        address = self._hosts.address("B")
        receive = kind.asked("receive", address, seconds).words()
        asked = kind.asked("send", address, seconds)
        send = replace(asked, links=str(self._losses.path)).words()
        with self._process("B", receive) as receiver:
            assert receiver.stdout is not None
            assert receiver.stdin is not None
            if receiver.stdout.readline() != "ready\n":
                raise RuntimeError(f"{kind.what}: the receiver did not start")
            time.sleep(0.2)
            before = self.link.read()[AB]
            with self._process(sender, send) as sending:
                if sending.wait(START_S + seconds):
                    raise RuntimeError(f"{kind.what}: the sender has failed")
            after = self.link.read()[AB]
            receiver.stdin.write("\n")
            receiver.stdin.flush()
            ages: list[float] = json.loads(receiver.stdout.readline())
        self.worst_ms = max(self.worst_ms, after.late_max_ms)
        return ages, replace(after, cpu_s=after.cpu_s - before.cpu_s)

    def _process(self, node: str, words: Sequence[str]) -> subprocess.Popen[str]:
        return subprocess.Popen(
            self._hosts.inside(node, words),
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )


@contextmanager
def _bench() -> Iterator[_Bench]:
    name = f"bench{os.getpid()}"
    with tempfile.TemporaryDirectory() as folder, Hosts(name, NODES, [NODES]) as hosts:
        tuns = {"A": hosts.tun("A", "B"), "B": hosts.tun("B", "A")}
        losses = LinkFile(Path(folder) / "links", NODES, seed=5)
        with TunLink(NODES, tuns, seed=7) as link, closing(losses):
            yield _Bench(hosts, link, losses)


def _in_order(hertz: float) -> tuple[float, float]:
    """Return mean and standard deviation of the delay where no message overtakes another."""
    release_ms = np.arange(400_000) * 1e3 / hertz
    arrival_ms = release_ms + DELAY.marginal(np.random.default_rng(0), len(release_ms))
    age_ms = np.maximum.accumulate(arrival_ms) - release_ms
    return float(age_ms.mean()), float(age_ms.std())


def _quantile(values: Sequence[float], share: float) -> float:
    return float(np.quantile(values, share))
