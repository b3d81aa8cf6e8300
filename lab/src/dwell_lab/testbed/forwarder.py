"""The process of a TUN link: read packets from either side, and deliver each at its due time.

Packets of one flow that follow each other closely are a burst: one message, in pieces of 64 kB.
Each direction transmits packets in order at its rate and then adds a delay, sampled once per burst.
Packets within a flow stay in order; flows can overtake each other.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import gc
import os
import struct
import time
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

from dwell.errors import LiveError
from dwell.live.local.child import Parent
from dwell.live.local.conditions import (
    MOST_ATTEMPTS,
    Conditions,
    Draws,
    Scheduling,
    transmission_ns,
)
from dwell_lab.testbed.event_loop import Loop
from dwell_lab.testbed.packets import kind_of

#: Upper limits of the lateness classes, ms; the last class has no limit.
LATE_MS = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
LATE_NS = tuple(round(each * 1e6) for each in LATE_MS)

#: Pause that ends a burst: a sender stopped by its CPU quota in the middle of a message continues
#: within 4 ms.
GAP_MS = 4.0
#: Longest burst: after this time a flow without pauses samples its next delay.
LONGEST_MS = 20.0
GAP_NS, LONGEST_NS = round(GAP_MS * 1e6), round(LONGEST_MS * 1e6)

PACKET_BYTES = 65_536
# Packets to read per call, a message of 300 kB; due packets must not wait for more.
AT_ONCE = 5
# Limit per direction for queued and travelling bytes; more is lost, as in a full buffer.
WAITING_BYTES = 64 << 20
# Number of flows to keep; above it, flows without travelling packets are dropped.
FLOWS = 1_024
# Linux lets timers of ordinary processes be 50 µs late to save power.
TIMER_SLACK = "/proc/self/timerslack_ns"
# Shortest time slice that Linux grants; a shorter slice gets the CPU sooner.
SLICE_NS = 100_000
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}


class _Settings(NamedTuple):
    """Settings from `TunLink`; mappings are keyed by source."""

    nodes: tuple[str, str]
    descriptors: list[int]
    usual: dict[str, Conditions]
    retransmit_ns: dict[str, int]
    seed: int


@dataclass(slots=True)
class Passed:
    """Counts of the packets of one direction.

    `packets` and `bytes` were delivered. `bursts` counts bursts of data, and `held` those delayed
    by at least one timeout. `vanished` packets were lost to an outage, a full queue or a missing
    host; `ignored` packets (IPv6, multicast, broadcast) belong to no cell. `delay_ns` and
    `squares` are the sums of the sampled delays with timeouts, and of their squares. `late_max_ns`
    is the largest lateness, and `late` counts packets per class of `LATE_MS`, plus one class
    above. `cpu_s` is the CPU time of the process since its start, for both directions.
    """

    packets: int = 0
    bytes: int = 0
    bursts: int = 0
    held: int = 0
    vanished: int = 0
    ignored: int = 0
    delay_ns: int = 0
    squares: float = 0.0
    late_max_ns: int = 0
    late: list[int] = field(default_factory=lambda: [0] * (len(LATE_NS) + 1))
    cpu_s: float = 0.0

    @property
    def delay_mean_ms(self) -> float:
        """Mean of the sampled delays; 0 without bursts."""
        return self.delay_ns / max(self.bursts, 1) / 1e6

    @property
    def delay_std_ms(self) -> float:
        """Standard deviation of the sampled delays."""
        bursts = max(self.bursts, 1)
        variance = self.squares / bursts - (self.delay_ns / bursts) ** 2
        return float(max(variance, 0.0) ** 0.5) / 1e6

    @property
    def late_max_ms(self) -> float:
        """Largest lateness of a packet."""
        return self.late_max_ns / 1e6

    def left(self, size_bytes: int, late_ns: int) -> None:
        """Count a delivered packet."""
        self.packets += 1
        self.bytes += size_bytes
        self.late_max_ns = max(self.late_max_ns, late_ns)
        self.late[bisect_right(LATE_NS, late_ns)] += 1

    def began(self, delay_ns: int) -> None:
        """Count a new burst of data."""
        self.bursts += 1
        self.delay_ns += delay_ns
        self.squares += float(delay_ns) ** 2


@dataclass(slots=True)
class _Flow:
    """A flow, identified by its 5-tuple, with its latest burst."""

    begun_ns: int = 0
    last_ns: int = 0
    delay_ns: int = 0
    due_ns: int = 0


class _Direction:
    """A direction of the link."""

    served_ns = 0

    def __init__(self, loop: Loop, settings: _Settings, index: int) -> None:
        source = settings.nodes[index]
        self.draws = Draws((settings.seed, index))
        self.draws.apply(settings.usual[source])
        self.counts = Passed()
        self._loop = loop
        self._source, self._target = settings.descriptors[index], settings.descriptors[1 - index]
        self._retransmit_ns = settings.retransmit_ns.get(source, 0)
        self._flows: dict[bytes, _Flow] = {}
        self._free_ns = 0
        self._waiting_bytes = 0
        os.set_blocking(self._source, False)
        loop.watch(self._source, self)

    def ready(self) -> None:
        """Read packets; all get the time of this call as their arrival."""
        self.served_ns = time.monotonic_ns()
        for _ in range(AT_ONCE):
            try:
                packet = os.read(self._source, PACKET_BYTES)
            except BlockingIOError:
                return
            except OSError:  # the device is gone, and its node with it
                self._loop.unwatch(self._source)
                return
            self._take(packet, self.served_ns)

    def _take(self, packet: bytes, now_ns: int) -> None:
        kind = kind_of(packet)
        counts, conditions = self.counts, self.draws.conditions
        if kind is None:
            counts.ignored += 1
            return
        # With a loss of 1 no attempt succeeds; the sender's own repetitions continue later.
        stopped = conditions.down or (kind.data and conditions.loss == 1)
        if stopped or self._waiting_bytes > WAITING_BYTES:
            counts.vanished += 1
            return
        took_ns = transmission_ns(len(packet), conditions.rate_mbps)
        self._free_ns = max(now_ns, self._free_ns) + took_ns
        flow = self._flows.get(kind.flow)
        begins = (
            flow is None or now_ns - flow.last_ns > GAP_NS or now_ns - flow.begun_ns > LONGEST_NS
        )
        if flow is None:
            flow = self._flows[kind.flow] = _Flow()
            self._forget(now_ns)
        if begins:
            flow.begun_ns = now_ns
            flow.delay_ns = self.draws.delay_ns()
            if kind.data:
                flow.delay_ns += self._held_back()
                counts.began(flow.delay_ns)
        flow.last_ns = now_ns
        flow.due_ns = max(self._free_ns + flow.delay_ns, flow.due_ns)
        self._waiting_bytes += len(packet)
        self._loop.at(flow.due_ns, partial(self._leave, packet))

    def _held_back(self) -> int:
        """Sample the time until an attempt to send a burst is not lost, ns."""
        held_ns = 0
        while held_ns < MOST_ATTEMPTS * self._retransmit_ns and self.draws.lose():
            held_ns += self._retransmit_ns
        self.counts.held += held_ns > 0
        return held_ns

    def _leave(self, packet: bytes, due_ns: int) -> None:
        self._waiting_bytes -= len(packet)
        try:
            os.write(self._target, packet)
        except OSError as error:
            if error.errno == errno.EBADF:
                raise
            # The device is down, or its node is gone.
            self.counts.vanished += 1
            return
        self.counts.left(len(packet), time.monotonic_ns() - due_ns)

    def _forget(self, now_ns: int) -> None:
        if len(self._flows) > FLOWS:
            old_ns = now_ns - LONGEST_NS
            self._flows = {
                name: flow
                for name, flow in self._flows.items()
                if flow.due_ns > now_ns or flow.last_ns > old_ns or not flow.last_ns
            }


class _Link:
    """Both directions, which serve the parent's requests."""

    served_ns = 0

    def __init__(self, parent: Parent, settings: _Settings) -> None:
        self.loop, self._parent = Loop(), parent
        self._directions = {
            name: _Direction(self.loop, settings, index)
            for index, name in enumerate(settings.nodes)
        }
        self.loop.watch(parent.fileno(), self)

    def ready(self) -> None:
        """Serve a request; an `EOFError` ends the process."""
        what, *arguments = self._parent.receive()
        answer = self._stats(*arguments) if what == "stats" else self._set(*arguments)
        self._parent.answer(answer)

    def _set(self, source: str, changes: Mapping[str, Any], at_ns: int) -> int:
        """Change conditions of a direction from an instant on; return that instant."""
        draws, now_ns = self._directions[source].draws, time.monotonic_ns()

        def change(_: int) -> None:
            draws.apply(replace(draws.conditions, **changes))

        if at_ns <= now_ns:
            change(now_ns)
            return now_ns
        self.loop.at(at_ns, change)
        return at_ns

    def _stats(self, reset: bool) -> dict[str, dict[str, Any]]:
        """Return the counts of each direction, by its source."""
        counts = {}
        for name, direction in self._directions.items():
            direction.counts.cpu_s = time.process_time()
            counts[name] = asdict(direction.counts)
            if reset:
                direction.counts = Passed()
        return counts


def _come_first() -> Scheduling:
    """Give this process the highest priority that the system permits.

    A real link does not wait for the CPU of a node that it connects, and foreign work should slow
    nodes, not links. The process asks for real-time priority. If this is refused, it asks for short
    time slices (Linux 6.12, no privilege needed), which halve the lateness on busy CPUs.
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


def main() -> None:
    """Forward packets until the parent ends or closes the pipe."""
    parent = Parent()
    with contextlib.suppress(EOFError):
        settings = _Settings(*parent.receive())
        try:
            link = _Link(parent, settings)
        except OSError as error:
            parent.answer(LiveError(str(error)))
            return
        parent.answer(_come_first())
        gc.freeze()
        while parent.alive:
            link.loop.turn()


if __name__ == "__main__":
    main()
