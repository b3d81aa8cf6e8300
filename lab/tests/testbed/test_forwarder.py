"""The process of a link, with sockets in place of TUN devices."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from dwell.errors import LiveError
from dwell.live.local.conditions import MOST_ATTEMPTS, Conditions
from dwell.model import Constant
from dwell_lab.testbed.link import TunLink
from lab.tests.testbed.test_packets import ip, udp
from tests.waiting import PATIENCE_S


class Ends:
    """Two nodes, each with its end of the link."""

    def __init__(self, stack: ExitStack) -> None:
        self.mine, self.devices = dict[str, socket.socket](), dict[str, int]()
        for node in ("R1", "E"):
            ours, theirs = (
                stack.enter_context(end)
                for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            )
            ours.settimeout(PATIENCE_S)
            self.mine[node], self.devices[node] = ours, theirs.fileno()

    def link(self, conditions: Conditions, **more: object) -> TunLink:
        usual = {("R1", "E"): conditions}
        return TunLink(("R1", "E"), self.devices, usual, **more)  # type: ignore[arg-type]

    def send(self, *packets: bytes, source: str = "R1") -> float:
        for packet in packets:
            self.mine[source].send(packet)
        return time.monotonic()

    def arrive(self, count: int, *, at: str = "E") -> list[bytes]:
        return [self.mine[at].recv(70_000) for _ in range(count)]


@pytest.fixture
def ends() -> Iterator[Ends]:
    with ExitStack() as stack:
        yield Ends(stack)


def numbered(port: int, number: int) -> bytes:
    return udp(port, struct.pack("!I", number) + bytes(1000))


def test_packets_of_a_flow_come_late_and_in_order_and_the_other_way_at_once(ends: Ends) -> None:
    with ends.link(Conditions(Constant(30.0))) as link:
        sent_s = ends.send(*(numbered(1, number) for number in range(5)))
        assert ends.arrive(5) == [numbered(1, number) for number in range(5)]
        assert time.monotonic() - sent_s >= 0.03
        ends.send(numbered(1, 9), source="E")
        assert ends.arrive(1, at="R1") == [numbered(1, 9)]
        passed = link.read()
    assert passed["R1", "E"].packets == 5
    assert passed["R1", "E"].bursts == 1
    assert passed["R1", "E"].delay_mean_ms == pytest.approx(30.0)
    assert passed["E", "R1"].packets == 1
    assert passed["E", "R1"].delay_mean_ms == 0.0


def test_what_is_no_cells_does_not_cross(ends: Ends) -> None:
    with ends.link(Conditions()) as link:
        ends.send(bytes([0x60]) + bytes(60), ip(2, b"igmp"), udp(1))
        assert ends.arrive(1) == [udp(1)]
        assert link.read()["R1", "E"].ignored == 2


def test_a_direction_that_is_cut_loses_what_is_sent_meanwhile(ends: Ends) -> None:
    with ends.link(Conditions()) as link:
        link.set("R1", "E", down=True)
        ends.send(numbered(1, 1))
        ends.send(numbered(2, 1), source="E")
        ends.arrive(1, at="R1")
        while not link.read(reset=False)["R1", "E"].vanished:
            time.sleep(0.001)
        link.set("R1", "E", down=False)
        ends.send(numbered(1, 2))
        assert ends.arrive(1) == [numbered(1, 2)]


def test_the_rate_spaces_what_is_sent_at_once(ends: Ends) -> None:
    with ends.link(Conditions(rate_mbps=8.0)):
        sent_s = ends.send(*(udp(port, bytes(9_972)) for port in range(5)))
        ends.arrive(5)
    # Five packets of 10 000 bytes take 10 ms each.
    assert time.monotonic() - sent_s >= 0.05


def test_changes_come_at_their_instant_and_a_wrong_one_changes_nothing(ends: Ends) -> None:
    with ends.link(Conditions()) as link:
        at_ns = time.monotonic_ns() + 50_000_000
        assert link.set("R1", "E", at_ns=at_ns, delay_ms=Constant(5.0)) == at_ns
        with pytest.raises(LiveError, match="rate_mbps"):
            link.set("R1", "E", rate_mbps=-1.0)
        while time.monotonic_ns() < at_ns:
            ends.send(udp(1))
            ends.arrive(1)
        link.read()
        # A burst keeps the delay that it began with: a flow of its own.
        ends.send(udp(2))
        ends.arrive(1)
        assert link.read()["R1", "E"].delay_mean_ms == pytest.approx(5.0)


def test_lost_messages_are_held_back_by_whole_timeouts(ends: Ends) -> None:
    lossy = Conditions(loss=0.5)
    with ends.link(lossy, retransmit_ms={("R1", "E"): 3.0}, seed=3) as link:
        ends.send(*(udp(port) for port in range(1, 101)))
        assert sorted(ends.arrive(100)) == sorted(udp(port) for port in range(1, 101))
        passed = link.read()["R1", "E"]
    assert 25 < passed.held < 75
    assert passed.vanished == 0
    # Of a geometric number of timeouts the mean is one, with half of the messages not held at all.
    assert 1.5 < passed.delay_mean_ms < 6.0


def test_what_is_always_lost_vanishes_and_what_is_nearly_always_is_held_a_bounded_time(
    ends: Ends,
) -> None:
    """The process goes on: it answers, and forwards again when the loss has ended."""
    with ends.link(Conditions(loss=1.0), retransmit_ms={("R1", "E"): 3.0}, seed=3) as link:
        ends.send(*(udp(port) for port in range(1, 11)))
        while link.read(reset=False)["R1", "E"].vanished < 10:
            time.sleep(0.001)
        link.set("R1", "E", loss=1 - 1e-12)
        ends.send(udp(11))
        assert ends.arrive(1) == [udp(11)]
        passed = link.read()["R1", "E"]
        assert passed.delay_mean_ms == pytest.approx(MOST_ATTEMPTS * 3.0)


def test_it_ends_with_a_node_that_is_gone(ends: Ends) -> None:
    with ends.link(Conditions()) as link:
        ends.mine["E"].close()
        ends.send(udp(1))
        while not link.read(reset=False)["R1", "E"].vanished:
            time.sleep(0.001)
        pid = link.pid
        os.kill(pid, 0)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
