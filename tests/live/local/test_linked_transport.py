"""A transport whose messages meet links: which of them where, when, and in which order."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from dwell.live.local.linked_transport import LinkedTransport, target_of, without_source
from dwell.live.local.message_links import LinkEnds, LinkFile
from dwell.live.wire import channels
from dwell.live.wire.keys import Keys
from dwell.live.wire.transport import Arrival, Lane
from dwell.model import Constant, Link, Normal
from tests.live.direct_transport import DirectTransport
from tests.live.transport.meshes import ZenohMesh, introduce
from tests.waiting import wait_until

NODES = "R1", "E", "R2"
KEYS = Keys("cell")
TO_E = KEYS.of(channels.INPUT, "perception", "E", "main")
#: Of messages at once that are held in order by numbers.
MANY = 50


@pytest.fixture
def file(tmp_path: Path) -> Iterator[LinkFile]:
    with closing(LinkFile(tmp_path / "links", NODES, seed=3)) as opened:
        yield opened


class Pair:
    """A sender on R1 and a receiver on E, and what has arrived there when."""

    def __init__(self, file: LinkFile) -> None:
        carrier = DirectTransport()
        self.sender = LinkedTransport(carrier, LinkEnds(file.path, "camera@R1", "R1"))
        self.receiver = LinkedTransport(carrier, LinkEnds(file.path, "perception@E", "E"))
        self.arrived: list[tuple[int, Arrival]] = []
        self.receiver.subscribe(
            "**", lambda sample: self.arrived.append((time.monotonic_ns(), sample))
        )

    @property
    def payloads(self) -> list[bytes]:
        return [sample.payload for _, sample in self.arrived]


@pytest.fixture
def pair(file: LinkFile) -> Iterator[Pair]:
    made = Pair(file)
    yield made
    made.sender.close()
    made.receiver.close()


def test_the_key_tells_what_is_for_one_node() -> None:
    assert target_of(KEYS.of(channels.INPUT, "planning", "R2", "shadow")) == "R2"
    assert target_of(KEYS.of(channels.STATE, "planning", "E")) == "E"
    assert target_of(KEYS.of(channels.SNAPSHOT, "planning", "E")) == "E"
    for key in (
        KEYS.of(channels.COMMAND, "control"),
        KEYS.of(channels.BEAT, "R1", "stamper@R1"),
        KEYS.of(channels.ORDER),
        KEYS.of(channels.ASK),
    ):
        assert target_of(key) is None


@pytest.mark.parametrize(
    "key", [TO_E, KEYS.of(channels.STAMPED)], ids=["at the sender", "at the receiver"]
)
def test_a_message_takes_its_delay_once_and_a_put_takes_none(
    file: LinkFile, pair: Pair, key: str
) -> None:
    file.set("R1", "E", delay_ms=Constant(300.0))
    begun_ns = time.monotonic_ns()
    pair.sender.put(key, b"x", b"header")
    assert pair.arrived == []
    wait_until(lambda: len(pair.arrived) == 1)
    at_ns, sample = pair.arrived[0]
    # Not before its time, and not after twice of it: it meets the link once.
    assert 300e6 <= at_ns - begun_ns < 600e6
    assert (sample.key, sample.payload, sample.header) == (key, b"x", b"header")


@pytest.mark.parametrize(
    "key", [TO_E, KEYS.of(channels.STAMPED)], ids=["at the sender", "at the receiver"]
)
def test_messages_of_a_key_keep_their_order_whatever_their_delays(
    file: LinkFile, pair: Pair, key: str
) -> None:
    file.set("R1", "E", delay_ms=Normal(10.0, 8.0, min=0.0))
    for number in range(MANY):
        pair.sender.put(key, b"%d" % number)
    wait_until(lambda: len(pair.arrived) == MANY)
    assert pair.payloads == [b"%d" % number for number in range(MANY)]


def test_a_rate_puts_messages_apart(file: LinkFile, pair: Pair) -> None:
    # 2.5 kB at 1 Mbit/s: 20 ms.
    file.set("R1", "E", rate_mbps=1.0)
    for number in range(5):
        pair.sender.put(TO_E, bytes([number]) * 2_500)
    wait_until(lambda: len(pair.arrived) == 5)
    instants = [at_ns for at_ns, _ in pair.arrived]
    assert instants[-1] - instants[0] > 79e6


def test_what_is_put_on_a_link_that_is_down_is_lost(file: LinkFile, pair: Pair) -> None:
    file.set("R1", "E", down=True)
    pair.sender.put(TO_E, b"lost")
    pair.sender.put(KEYS.of(channels.STAMPED), b"lost")
    file.set("R1", "E", down=False)
    pair.sender.put(TO_E, b"0")
    wait_until(lambda: len(pair.arrived) == 1)
    assert pair.payloads == [b"0"]


def test_it_waits_for_a_link_that_retransmits(tmp_path: Path) -> None:
    repeats = Link("R1", "E", Constant(0.0), retransmit_ms=5.0)
    with closing(LinkFile(tmp_path / "links", NODES, [repeats], seed=3)) as file:
        pair = Pair(file)
        file.set("R1", "E", down=True)
        for number in range(5):
            pair.sender.put(TO_E, b"%d" % number)
        time.sleep(0.05)
        assert pair.arrived == []
        file.set("R1", "E", down=False)
        wait_until(lambda: len(pair.arrived) == 5)
        pair.sender.put(TO_E, b"5")
        wait_until(lambda: len(pair.arrived) == 6)
        assert pair.payloads == [b"%d" % number for number in range(6)]
        for one in (pair.sender, pair.receiver):
            one.close()


def test_what_stays_on_its_node_meets_no_link(file: LinkFile) -> None:
    for source, target in itertools.permutations(NODES, 2):
        file.set(source, target, down=True)
    carrier = DirectTransport()
    here = LinkedTransport(carrier, LinkEnds(file.path, "perception@E", "E"))
    found: list[Arrival] = []
    here.subscribe("**", found.append)
    here.put(TO_E, b"1")
    here.put(KEYS.of(channels.STAMPED), b"2", b"header")
    # Of somebody who is on no node: an operator.
    carrier.put(KEYS.of(channels.ASK), b"3")
    assert [(one.payload, one.header) for one in found] == [
        (b"1", b""),
        (b"2", b"header"),
        (b"3", b""),
    ]
    here.close()
    here.put(KEYS.of(channels.STAMPED), b"4")
    assert carrier.closed


def test_a_receiver_that_fails_does_not_stop_the_others(
    file: LinkFile, pair: Pair, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(sample: Arrival) -> None:
        raise ValueError(sample.payload)

    pair.receiver.subscribe("**", fail)
    file.set("R1", "E", delay_ms=Constant(5.0))
    for number in range(3):
        pair.sender.put(KEYS.of(channels.STAMPED), b"%d" % number)
    wait_until(lambda: len(pair.arrived) == 3)
    wait_until(lambda: "could not be handled" in caplog.text)


def test_a_header_says_where_a_message_comes_from() -> None:
    assert without_source(b"\xc1\x02R1rest") == ("R1", b"rest")
    assert without_source(b"rest") == ("", b"rest")


# ------------------------------------------------------------------------------ over Zenoh

COUNT = 300
SENDER, NEAR, FAR = "camera@R1", "stamper@R1", "perception@E"


@pytest.mark.parametrize(
    "key", [TO_E, KEYS.of(channels.STAMPED)], ids=["at the sender", "at the receiver"]
)
@pytest.mark.parametrize("lane", ["control", "images"])
def test_a_share_crosses_a_link_of_zenoh_s(file: LinkFile, key: str, lane: Lane) -> None:
    mesh = ZenohMesh([SENDER, NEAR, FAR])
    try:
        sender, near, far = (
            LinkedTransport(mesh.open(who), LinkEnds(file.path, who, who.partition("@")[2]))
            for who in (SENDER, NEAR, FAR)
        )
        inbox, here = mesh.inbox(), mesh.inbox()
        far.subscribe(key, inbox)
        near.subscribe(KEYS.of(channels.BEAT, "R1", "*"), here)
        introduce(mesh, sender, key, [inbox], lane=lane)
        introduce(mesh, sender, KEYS.of(channels.BEAT, "R1", SENDER), [here])
        file.set("R1", "E", loss=0.3)
        for number in range(COUNT):
            sender.put(key, b"%d" % number, b"header", lane=lane)
            sender.put(KEYS.of(channels.BEAT, "R1", SENDER), b"%d" % number)
            # Queues are short, and what does not fit is lost as well.
            mesh.until(lambda number=number: len(here.samples) > number)  # type: ignore[misc]
        file.set("R1", "E", loss=0.0)
        sender.put(key, b"last", lane=lane)
        mesh.until(lambda: b"last" in inbox.payloads)
        # 300 at 30 %: 90 expected, 7.9 of standard deviation.
        assert abs(COUNT + 1 - len(inbox.samples) - 90) < 7 * 7.9
        assert {sample.header for sample in inbox.samples[:-1]} == {b"header"}
        assert len(here.samples) == COUNT
    finally:
        mesh.close()
