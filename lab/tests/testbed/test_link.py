"""A TUN link between two namespaces; times are only ever bounded from below."""

from __future__ import annotations

import socket
import statistics
import time
from collections.abc import Iterator

import numpy as np
import pytest

from dwell.errors import LiveError
from dwell.live.local.conditions import Conditions, delays_ns
from dwell.model import Constant, Normal, Trace, TraceTable
from dwell_lab.testbed.forwarder import GAP_MS, LATE_MS
from dwell_lab.testbed.link import TunLink
from lab.tests.testbed.two_hosts import NODES, TwoHosts, two_hosts, why_not

WHY_NOT = why_not()
needs_hosts = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "they can be made")

AB, BA = ("A", "B"), ("B", "A")
TIMEOUT_MS = 30.0
#: After which what comes is no part of the message before.
PAUSE_S = 2 * GAP_MS / 1e3
USUAL = Conditions(delay_ms=Constant(0.0), loss=0.0)


@pytest.fixture(scope="module")
def made() -> Iterator[TwoHosts]:
    with two_hosts() as both:
        yield both


@pytest.fixture
def hosts(made: TwoHosts) -> Iterator[TwoHosts]:
    yield made
    made.hang_up()


@pytest.fixture(scope="module")
def shared(made: TwoHosts) -> Iterator[TunLink]:
    with TunLink(NODES, made.tuns, retransmit_ms={AB: TIMEOUT_MS}, seed=3) as opened:
        yield opened


@pytest.fixture
def link(shared: TunLink) -> Iterator[TunLink]:
    shared.read()
    yield shared
    for way in (AB, BA):
        shared.set(*way, delay_ms=Constant(0.0), add_delays_ms=(), shares=(), loss=0.0, down=False)
        shared.set(*way, rate_mbps=float("inf"))


class Probe:
    """Datagrams from A to B that tell when they were sent."""

    def __init__(self, hosts: TwoHosts, flows: int = 1) -> None:
        self.senders = [hosts.udp("A") for _ in range(flows)]
        self.receiver = hosts.udp("B")

    def send(self, name: str, flow: int = 0, size: int = 0) -> None:
        content = f"{name} {time.monotonic_ns()} ".encode() + bytes(size)
        self.senders[flow].sendto(content, self.receiver.getsockname())

    def next(self) -> tuple[str, float]:
        """Name and age in ms of the one that comes next."""
        name, sent_ns, _ = self.receiver.recv(65_536).split(b" ", 2)
        return name.decode(), (time.monotonic_ns() - int(sent_ns)) / 1e6

    def receive(self, count: int) -> list[str]:
        return [self.next()[0] for _ in range(count)]


@needs_hosts
def test_no_message_comes_before_its_delay(hosts: TwoHosts, link: TunLink) -> None:
    link.set(*AB, delay_ms=Constant(15.0), add_delays_ms=(Constant(10.0),), shares=(0.5,))
    probe = Probe(hosts)
    for number in range(5):
        probe.send(str(number))
        name, age_ms = probe.next()
        assert name == str(number)
        assert age_ms >= 20.0
    time.sleep(PAUSE_S)
    link.set(*AB, shares=(0.0,))
    probe.send("x")
    assert probe.next()[1] >= 15.0
    passed = link.read()[AB]
    assert passed.packets == sum(passed.late) == 6
    assert len(passed.late) == len(LATE_MS) + 1
    assert passed.late_max_ms > 0


@needs_hosts
def test_one_way_is_not_the_other(hosts: TwoHosts, link: TunLink) -> None:
    link.set(*BA, delay_ms=Constant(30.0))
    probe = Probe(hosts)
    probe.send("there")
    assert probe.next()[0] == "there"
    begin_ns = time.monotonic_ns()
    probe.receiver.sendto(b"back", probe.senders[0].getsockname())
    assert probe.senders[0].recv(10) == b"back"
    assert time.monotonic_ns() - begin_ns >= 30e6
    passed = link.read()
    assert (passed[AB].delay_mean_ms, passed[BA].delay_mean_ms) == (0.0, 30.0)


@needs_hosts
def test_flows_overtake_each_other_and_a_flow_keeps_its_order(
    hosts: TwoHosts, link: TunLink
) -> None:
    probe = Probe(hosts, flows=2)
    # Long enough for what follows, on a machine that has a lot else to do.
    link.set(*AB, delay_ms=Constant(2_000.0))
    probe.send("slow", flow=0)
    while link.read(reset=False)[AB].bursts < 1:
        time.sleep(0.001)
    link.set(*AB, delay_ms=Constant(0.0))
    time.sleep(PAUSE_S)
    probe.send("behind", flow=0)
    probe.send("fast", flow=1)
    assert probe.receive(3) == ["fast", "slow", "behind"]
    passed = link.read()[AB]
    assert passed.bursts == 3


@needs_hosts
def test_a_trace_is_replayed_row_by_row(hosts: TwoHosts, link: TunLink) -> None:
    rows = [5.0, 1.0, 9.0, 3.0, 12.0]
    link.set(*AB, delay_ms=Trace(TraceTable("t", {"d": np.array(rows)}), "d"))
    probe = Probe(hosts)
    drawn = []
    for _ in range(6):
        link.read()
        probe.send("x")
        _, age_ms = probe.next()
        drawn.append(link.read()[AB].delay_mean_ms)
        assert age_ms >= drawn[-1]
        time.sleep(PAUSE_S)
    first = rows.index(drawn[0])
    assert drawn == [rows[(first + i) % 5] for i in range(6)]


@needs_hosts
def test_what_is_drawn_is_drawn_from_the_seed() -> None:
    seen = []
    for seed in (1, 1, 2):
        usual = {AB: Conditions(delay_ms=Normal(5.0, 1.0))}
        with two_hosts() as hosts, TunLink(NODES, hosts.tuns, usual, seed=seed) as link:
            probe = Probe(hosts)
            link.read()
            for _ in range(3):
                probe.send("x")
                probe.next()
                time.sleep(PAUSE_S)
            seen.append(link.read()[AB].delay_mean_ms)
    assert seen[0] == seen[1] != seen[2]
    delays, _, _ = np.random.default_rng((2, 0)).spawn(3)
    drawn = delays_ns(Normal(5.0, 1.0), delays)
    assert statistics.mean(next(drawn) for _ in range(3)) / 1e6 == pytest.approx(seen[2])


@needs_hosts
def test_what_is_lost_is_held_back_by_whole_timeouts(hosts: TwoHosts, link: TunLink) -> None:
    flows = 200
    link.set(*AB, loss=0.5)
    probe = Probe(hosts, flows)
    for flow in range(flows):
        probe.send(str(flow), flow)
    ages_ms = dict(probe.next() for _ in range(flows))
    passed = link.read()[AB]
    assert passed.bursts == passed.packets == flows
    # P(fewer than 50 or more than 150 of 200) < 1e-12.
    assert 50 <= passed.held <= 150
    assert sum(age_ms >= TIMEOUT_MS for age_ms in ages_ms.values()) >= passed.held
    # Of whole timeouts: the mean is a number of them over all.
    timeouts = passed.delay_mean_ms * flows / TIMEOUT_MS
    assert timeouts == pytest.approx(round(timeouts))
    assert timeouts > passed.held


@needs_hosts
def test_messages_queue_at_the_rate_of_their_direction(hosts: TwoHosts, link: TunLink) -> None:
    link.set(*AB, rate_mbps=8.0)  # 1 kB a millisecond
    probe = Probe(hosts, flows=4)
    for flow in range(4):
        probe.send(str(flow), flow, size=20_000)
    ages = [probe.next() for _ in range(4)]
    assert [name for name, _ in ages] == ["0", "1", "2", "3"]
    begin_to_end_ms = ages[3][1] - ages[0][1]
    assert ages[0][1] >= 20.0
    # All four begin within what it takes to send them.
    assert begin_to_end_ms > 0
    assert link.read()[AB].bytes >= 80_000


@needs_hosts
def test_what_is_sent_while_it_is_down_vanishes(hosts: TwoHosts, link: TunLink) -> None:
    probe = Probe(hosts)
    link.set(*AB, delay_ms=Constant(100.0))
    probe.send("under-way")
    while link.read(reset=False)[AB].bursts < 1:
        time.sleep(0.001)
    link.set(*AB, down=True)
    probe.send("gone")
    probe.receiver.sendto(b"the other way", probe.senders[0].getsockname())
    assert probe.senders[0].recv(100) == b"the other way"
    while link.read(reset=False)[AB].vanished < 1:
        time.sleep(0.001)
    link.set(*AB, down=False)
    probe.send("back")
    assert probe.receive(2) == ["under-way", "back"]
    assert link.read()[AB].vanished == 1


@needs_hosts
def test_changes_come_at_their_instant(hosts: TwoHosts, link: TunLink) -> None:
    at_ns = time.monotonic_ns() + 50_000_000
    assert link.set(*AB, at_ns=at_ns, delay_ms=Constant(7.0)) == at_ns
    probe = Probe(hosts)
    probe.send("before")
    probe.next()
    while time.monotonic_ns() < at_ns + 5_000_000:
        time.sleep(0.005)
    link.read()
    probe.send("after")
    assert probe.next()[1] >= 7.0


# -------------------------------------------------------------- TCP; it may say more than asked


@needs_hosts
def test_everything_arrives_as_it_was_sent(hosts: TwoHosts, link: TunLink) -> None:
    here, there = hosts.tcp("A", "B")
    sent = np.random.default_rng(1).bytes(3_000_000)
    received = bytearray()
    with here, there:
        here.setblocking(False)
        at = 0
        while len(received) < len(sent):
            try:
                at += here.send(sent[at : at + 500_000])
            except BlockingIOError:
                received += there.recv(1 << 20)
                continue
            if at == len(sent):
                received += there.recv(1 << 20)
    assert bytes(received) == sent
    passed = link.read()
    assert passed[AB].bytes > len(sent)
    assert passed[BA].bursts < passed[BA].packets  # acknowledgements are no messages
    assert passed[AB].vanished == passed[BA].vanished == 0


@needs_hosts
def test_a_message_in_pieces_has_one_delay(hosts: TwoHosts, link: TunLink) -> None:
    here, there = hosts.tcp("A", "B")
    with here, there:
        here.sendall(b"warm")
        there.recv(4)
        time.sleep(PAUSE_S)
        link.read()
        link.set(*AB, delay_ms=Constant(20.0))
        begin_ns = time.monotonic_ns()
        here.sendall(bytes(300_000))
        there.recv(300_000, socket.MSG_WAITALL)
        assert time.monotonic_ns() - begin_ns >= 20e6
    passed = link.read()[AB]
    assert passed.packets >= 5
    # TCP may send something again, as its time for that is still that of a link without delay.
    assert passed.bursts < passed.packets


@needs_hosts
def test_a_host_that_is_gone_is_no_reason_to_end() -> None:
    with two_hosts() as others, TunLink(NODES, others.tuns) as link:
        Probe(others).send("x")
        others.hosts.stop()
        passed = link.read()
        assert passed[AB].packets + passed[AB].vanished <= 1


# ------------------------------------------------------------------------------ bad input


def test_a_link_is_between_two_nodes() -> None:
    with pytest.raises(LiveError, match="needs one device each of two nodes"):
        TunLink(("A", "B"), {"A": 3})
    with pytest.raises(LiveError, match="does not go from A to C"):
        TunLink(("A", "B"), {"A": 3, "B": 4}, {("A", "C"): USUAL})
    with pytest.raises(LiveError, match="does not go from A to C"):
        TunLink(("A", "B"), {"A": 3, "B": 4}, retransmit_ms={("A", "C"): 5.0})


def test_messages_are_lost_by_the_transport_only() -> None:
    link = TunLink(("A", "B"), {"A": 3, "B": 4}, retransmit_ms={("B", "A"): 5.0})
    with pytest.raises(LiveError, match="link A-B, A to B: without retransmit_ms it loses nothing"):
        link.set("A", "B", loss=0.1)


@needs_hosts
def test_values_out_of_their_bounds_change_nothing(hosts: TwoHosts, link: TunLink) -> None:
    with pytest.raises(LiveError, match="loss"):
        link.set(*AB, loss=1.5, delay_ms=Constant(500.0))
    with pytest.raises(TypeError, match="delay"):
        link.set(*AB, delay=Constant(500.0))
    probe = Probe(hosts)
    probe.send("x")
    probe.next()
    assert link.read()[AB].delay_mean_ms == 0.0
