"""A link's process, with connections made by hand; times are only ever bounded from below."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import fields

import numpy as np
import pytest

from dwell.demo.link import Forward, LinkProcess
from dwell.errors import LiveError
from dwell.model import Constant, Normal, Trace, TraceTable, Uniform
from dwell.testbed.conditions import CUTS, Conditions, Cut
from tests.demo.link_wire import (
    DECLARE,
    INIT,
    KEEP_ALIVE,
    PATIENCE_S,
    Wire,
    fragments,
    frame,
    framed,
    push,
    wait_until,
)

AB, BA = ("A", "B"), ("B", "A")
LAST = frame([push(b"last")], 9_999)


@pytest.fixture(scope="module")
def shared() -> Iterator[Wire]:
    with Wire() as opened:
        yield opened


@pytest.fixture
def wire(shared: Wire) -> Iterator[Wire]:
    shared.link.stats(reset=True)
    yield shared
    usual = Conditions()
    for source, target in (AB, BA):
        conditions = {item.name: getattr(usual, item.name) for item in fields(usual)}
        shared.link.set(source, target, **conditions)
    shared.hang_up()


def data(count: int, size: int = 40) -> list[bytes]:
    return [frame([push(bytes([index % 256]) * size)], index) for index in range(count)]


def test_everything_arrives_as_it_was_sent(wire: Wire) -> None:
    a, b = wire.connect()
    batches = [KEEP_ALIVE, *data(200), frame([DECLARE]), *fragments(push(b"i" * 307_000), 49_000)]
    a.send(*batches)
    assert b.receive(len(batches)) == batches
    b.send(*batches)
    assert a.receive(len(batches)) == batches
    there = wire.link.stats()[AB]
    assert (there.messages, there.dropped, there.unknown_bytes) == (201, 0, 0)
    assert there.bytes == len(framed([INIT, *batches]))


def test_a_connection_that_is_not_zenohs_passes_too(wire: Wire) -> None:
    wire.link.set("A", "B", loss=0.9)
    a, b = wire.connect(session=False)
    sent = os.urandom(1_000_000).replace(b"\x01\x09", b"\x02\x09")
    a.socket.setblocking(False)
    received = bytearray()
    at = 0
    while len(received) < len(sent):
        reads, writes, _ = select.select(
            [b.socket], [a.socket] if at < len(sent) else [], [], PATIENCE_S
        )
        assert reads or writes
        if writes:
            at += a.socket.send(sent[at : at + 65_536])
        if reads:
            received += b.socket.recv(65_536)
    assert received == sent
    assert wire.link.stats()[AB].unknown_bytes == len(sent)


def test_every_message_takes_its_delay_and_none_overtakes(wire: Wire) -> None:
    a, b = wire.connect()
    wire.link.set(
        "A", "B", delay_ms=Uniform(10.0, 30.0), add_delays_ms=(Constant(5.0),), shares=(1.0,)
    )
    sent_ns = []
    batches = data(40)
    for batch in batches:
        sent_ns.append(time.monotonic_ns())
        a.send(batch)
    ages_ms = []
    for batch, at_ns in zip(batches, sent_ns, strict=True):
        assert b.receive(1) == [batch]
        ages_ms.append((time.monotonic_ns() - at_ns) / 1e6)
    assert min(ages_ms) >= 15.0
    there = wire.link.stats()[AB]
    # Sent at once, each waits for the longest of those before it: the mean is that of maxima.
    assert 15.0 <= there.delay_mean_ms <= statistics.mean(ages_ms)
    b.send(LAST)
    assert a.receive(1) == [LAST]
    assert wire.link.stats()[BA].messages == 1


def test_delays_of_messages_apart_are_those_drawn(wire: Wire) -> None:
    a, b = wire.connect()
    values = [3.0, 9.0, 1.0, 6.0]
    trace = Trace(TraceTable("delays", {"ms": np.array(values)}), "ms")
    wire.link.set("A", "B", delay_ms=trace)
    ages_ms = []
    for batch in data(8):
        at_ns = time.monotonic_ns()
        a.send(batch)
        b.receive(1)
        ages_ms.append((time.monotonic_ns() - at_ns) / 1e6)
    begins = [values[k:] + values[:k] for k in range(4)]
    assert any(
        all(age >= value for age, value in zip(ages_ms, begin * 2, strict=True)) for begin in begins
    )
    assert wire.link.stats()[AB].delay_mean_ms >= statistics.mean(values)


def test_loss_takes_whole_messages_of_data_and_nothing_else(wire: Wire) -> None:
    a, b = wire.connect()
    wire.link.set("A", "B", loss=0.3)
    images = [fragments(push(bytes([k]) * 30_000), 9_000, 100 * k) for k in range(100)]
    for image, small in zip(images, data(100), strict=True):
        a.send(*image, KEEP_ALIVE, frame([DECLARE]), small)
    wire.link.set("A", "B", loss=0.0)
    a.send(LAST)
    received = b.until(LAST)
    assert received.count(KEEP_ALIVE) == 100
    assert received.count(frame([DECLARE])) == 100
    come = set(received)
    whole = [image for image in images if come.issuperset(image)]
    assert all(image in whole or come.isdisjoint(image) for image in images)
    left = len(whole) + len(come.intersection(data(100)))
    there = wire.link.stats()[AB]
    assert (there.messages, there.dropped) == (left + 1, 200 - left)
    # Binomial, 200 at 0.3: five standard deviations.
    assert 60 - 33 <= there.dropped <= 60 + 33


def test_a_seed_draws_the_same() -> None:
    def left(seed: int) -> list[bytes]:
        with Wire(seed) as opened:
            a, b = opened.connect()
            opened.link.set("A", "B", loss=0.5)
            a.send(*data(50), KEEP_ALIVE)
            return b.until(KEEP_ALIVE)

    first = left(1)
    assert left(1) == first
    assert 0 < len(first) < 50


def test_all_connections_share_the_rate(wire: Wire) -> None:
    pairs = [wire.connect() for _ in range(2)]
    wire.link.set("A", "B", rate_mbps=20.0)
    begin_ns = time.monotonic_ns()
    image = fragments(push(b"i" * 100_000), 49_000)
    for a, _ in pairs:
        a.send(*image)
    for _, b in pairs:
        assert b.receive(len(image)) == image
    assert time.monotonic_ns() - begin_ns >= 2 * 8 * len(framed(image)) * 1e9 / 20e6
    # The other direction has none.
    pairs[0][1].send(*image)
    assert pairs[0][0].receive(len(image)) == image


def test_a_full_queue_pushes_back_and_starves_nobody(wire: Wire) -> None:
    a, b = wire.connect()
    other_a, other_b = wire.connect()
    wire.link.set("A", "B", rate_mbps=8.0)
    flood = framed(data(1, 60_000)) * 200
    a.socket.setblocking(False)
    taken = 0
    while select.select([], [a.socket], [], 0.1)[1]:
        taken += a.socket.send(flood[taken : taken + 65_536])
    assert taken < 2_000_000
    other_a.send(LAST)
    assert other_b.receive(1) == [LAST]
    # It has overtaken what waits for the rate (about a second of it).
    wire.link.set("A", "B", rate_mbps=1e9)
    whole = taken // len(framed(data(1, 60_000)))
    assert b.receive(whole) == data(1, 60_000) * whole


def test_with_a_queue_each_a_full_one_holds_up_nobody_else() -> None:
    with Wire(sharing="fair") as wire:
        a, b = wire.connect()
        other_a, other_b = wire.connect()
        # Ten images would take a minute and a half; other messages take half of the rate.
        wire.link.set("A", "B", rate_mbps=0.1)
        image = fragments(push(b"i" * 100_000), 49_000)
        sending = threading.Thread(target=a.send, args=image * 10, daemon=True)
        sending.start()
        assert b.silent
        other_a.send(LAST)
        assert other_b.receive(1) == [LAST]
        assert b.silent
        wire.link.set("A", "B", rate_mbps=1e9)
        assert b.receive(len(image) * 10) == image * 10


@pytest.mark.parametrize("kind", CUTS)
def test_a_cut_stops_everything_and_loses_data_or_holds_it(wire: Wire, kind: Cut) -> None:
    a, b = wire.connect()
    wire.link.cut(kind=kind)
    small = data(20)
    image = fragments(push(b"i" * 50_000), 9_000, 100)
    sent = [KEEP_ALIVE, *small, frame([DECLARE]), *image]
    a.send(*sent)
    b.send(*sent)
    if kind == "drop":
        wait_until(lambda: all(item.dropped == 21 for item in wire.link.stats().values()))
    assert a.silent
    assert b.silent
    wire.link.heal()
    a.send(LAST)
    b.send(LAST)
    left = sent if kind == "hold" else [KEEP_ALIVE, frame([DECLARE])]
    assert a.until(LAST) == left
    assert b.until(LAST) == left


def test_a_message_half_way_through_is_lost_to_a_cut(wire: Wire) -> None:
    a, b = wire.connect()
    first, *others = fragments(push(b"i" * 50_000), 9_000)
    a.send(first)
    assert b.receive(1) == [first]
    wire.link.cut()
    a.send(*others)
    wait_until(lambda: wire.link.stats()[AB].dropped == 1)
    wire.link.heal()
    a.send(LAST)
    assert b.until(LAST) == []


def test_a_cut_of_one_direction_leaves_the_other(wire: Wire) -> None:
    a, b = wire.connect()
    wire.link.cut("A")
    a.send(LAST)
    b.send(LAST)
    assert a.receive(1) == [LAST]
    wait_until(lambda: wire.link.stats()[AB].dropped == 1)
    wire.link.heal("A")
    a.send(LAST)
    assert b.receive(1) == [LAST]


def test_a_cut_hides_ends_and_beginnings(wire: Wire) -> None:
    a, b = wire.connect()
    wire.link.cut(kind="hold")
    a.socket.close()
    later = wire.dial()
    later.send(INIT)
    assert b.silent
    wire.link.heal()
    assert b.socket.recv(1) == b""
    assert wire.accept().receive(1) == [INIT]


def test_a_cut_hides_that_the_other_side_is_gone(wire: Wire) -> None:
    a, b = wire.connect()
    wire.link.cut("B", kind="hold")
    b.socket.close()
    for _ in range(20):  # the first is answered by a reset, which ends the connection for others
        a.send(*data(1))
        wire.link.stats()
    assert a.silent
    wire.link.heal()
    with contextlib.suppress(ConnectionResetError):
        assert a.socket.recv(1) == b""
    c, d = wire.connect()
    c.send(LAST)
    assert d.receive(1) == [LAST]


def test_an_end_comes_after_what_was_sent_before_it(wire: Wire) -> None:
    a, b = wire.connect()
    wire.link.set("A", "B", delay_ms=Constant(30.0))
    a.send(*data(10))
    a.socket.shutdown(socket.SHUT_WR)
    assert b.receive(10) == data(10)
    assert b.socket.recv(1) == b""
    b.send(LAST)  # half of it is still open
    assert a.receive(1) == [LAST]
    b.socket.close()
    assert a.socket.recv(1) == b""


def test_nobody_behind_the_link_closes_the_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with (
        LinkProcess(("A", "B"), [Forward("B", "127.0.0.1", port)]) as link,
        socket.create_connection(("127.0.0.1", link.ports[0]), timeout=PATIENCE_S) as dialled,
    ):
        assert dialled.recv(1) == b""


def test_a_change_waits_for_its_instant(wire: Wire) -> None:
    a, _b = wire.connect()
    at_ns = time.monotonic_ns() + 100_000_000
    assert wire.link.cut("A", at_ns=at_ns) == at_ns
    a.send(*data(5))
    wait_until(lambda: wire.link.stats()[AB].messages == 5)

    def cut() -> bool:
        a.send(LAST)
        return wire.link.stats()[AB].dropped > 0

    wait_until(cut)
    assert time.monotonic_ns() >= at_ns
    before_ns = time.monotonic_ns()
    assert wire.link.heal(at_ns=5) >= before_ns


def test_statistics_begin_again(wire: Wire) -> None:
    a, b = wire.connect()
    a.send(*data(3))
    b.receive(3)
    assert wire.link.stats(reset=True)[AB].messages == 3
    assert wire.link.stats()[AB].messages == 0


# ------------------------------------------------------------------------------- mistakes


def test_what_cannot_be_is_said_and_changes_nothing(wire: Wire) -> None:
    with pytest.raises(LiveError, match=r"link A-B: loss: 1\.5 is not allowed"):
        wire.link.set("A", "B", loss=1.5, rate_mbps=1.0)
    with pytest.raises(LiveError, match="cut: 'half' is not allowed"):
        wire.link.set("A", "B", cut="half")
    with pytest.raises(LiveError, match="has no speed; it has delay_ms"):
        wire.link.set("A", "B", speed=1)
    with pytest.raises(LiveError, match="does not go from A to C"):
        wire.link.set("A", "C", loss=0.1)
    with pytest.raises(LiveError, match="does not begin at C"):
        wire.link.cut("C")
    with pytest.raises(LiveError, match="has been started before"):
        wire.link.start()
    a, b = wire.connect()
    a.send(*data(3))
    assert b.receive(3) == data(3)


def test_a_port_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        link = LinkProcess(("A", "B"), [Forward("A", "127.0.0.1", 1, port)])
        with pytest.raises(LiveError, match=rf"127\.0\.0\.1:{port}: cannot listen there"):
            link.start()
        link.stop()


def test_conditions_from_the_beginning() -> None:
    conditions = {AB: Conditions(Normal(8.0, 1.0, min=5.0), loss=0.0), BA: Conditions(cut="drop")}
    with socket.create_server(("127.0.0.1", 0)) as server:
        forward = Forward("A", "127.0.0.1", server.getsockname()[1])
        link = LinkProcess(("A", "B"), [forward], conditions)
        with link, pytest.raises(LiveError, match="delay_ms: 3 is not allowed"):
            link.set("A", "B", delay_ms=3)
    with pytest.raises(LiveError, match="does not begin at C"):
        LinkProcess(("A", "B"), [Forward("C", "127.0.0.1", 1)])


def test_a_link_that_has_ended_says_so() -> None:
    link = LinkProcess(("A", "B"), [])
    with pytest.raises(LiveError, match="link A-B has not been started"):
        link.pid  # noqa: B018
    link.start()
    os.kill(link.pid, signal.SIGKILL)
    with pytest.raises(LiveError, match=rf"link A-B \(process {link.pid}\) has ended"):
        link.stats()
    link.stop()
    with pytest.raises(LiveError, match="does not run"):
        link.stats()


PARENT = """
import sys
from dwell.demo.link import LinkProcess
link = LinkProcess(("A", "B"), [])
link.start()
print(link.pid, flush=True)
sys.stdin.read()
"""


def test_it_says_how_it_gets_the_cpu(wire: Wire) -> None:
    real_time = os.sched_getscheduler(wire.link.pid) == os.SCHED_FIFO
    assert wire.link.scheduling in ({"fifo"} if real_time else {"short slices", "usual"})


def test_a_link_ends_with_its_parent() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        descriptor = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
        ended, _, _ = select.select([descriptor], [], [], PATIENCE_S)
        os.close(descriptor)
    assert ended
