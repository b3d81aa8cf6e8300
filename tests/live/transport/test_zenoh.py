"""What only real processes and sockets can do: die, freeze, take a port, share memory."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import Queue

import pytest

from dwell.errors import LiveError
from dwell.live.transport.zenoh import (
    POOL_BYTES,
    KeyRoute,
    PatientSender,
    PayloadPool,
    ZenohSettings,
    ZenohTransport,
    mark_of,
)
from dwell.live.wire.transport import Arrival, Lane, Transport
from dwell.live.wire.wiring import Locator, Role, WiringEntry
from tests.live.transport.meshes import Inbox, ZenohMesh, introduce
from tests.live.transport.peer import digest
from tests.waiting import PATIENCE_S

ME, NEAR, FAR, WITNESS = "me@R1", "near@R1", "far@E", "witness@R1"
TASK = {NEAR: "R1", FAR: "E"}
LANES: tuple[Lane, ...] = ("control", "images")


@pytest.fixture
def mesh() -> Iterator[ZenohMesh]:
    made = ZenohMesh([ME, NEAR, FAR, WITNESS])
    yield made
    made.close()


def key_to(who: str, lane: Lane) -> str:
    return f"dwell/t/in/{lane}/{TASK[who]}"


class Correspondent:
    """Puts to real processes and hears their answers."""

    def __init__(self, mesh: ZenohMesh) -> None:
        self.mesh = mesh
        self.end: Transport = mesh.open(ME)
        self.answers: dict[str, Inbox] = {}
        self.numbers = itertools.count()

    def spawn(self, who: str) -> subprocess.Popen[bytes]:
        """Start a process, and wait until it answers on both lanes."""
        child = self.mesh.spawn(who)
        if who not in self.answers:
            self.answers[who] = self.mesh.inbox()
            self.end.subscribe(f"dwell/t/done/{who}", self.answers[who])
        self.reach(who)
        return child

    def reach(self, who: str) -> None:
        """Put until something is answered on each lane."""
        for lane in LANES:
            first = next(self.numbers)

            def greet(lane: Lane = lane) -> None:
                self.end.put(key_to(who, lane), b"%d" % next(self.numbers), lane=lane)

            self.mesh.joined(lambda first=first: self.newest(who) >= first, greet)  # type: ignore[misc]

    def newest(self, who: str) -> int:
        return max((int(payload) for payload in self.answers[who].payloads), default=-1)

    def ask(self, who: str, lane: Lane, padding: bytes = b"") -> None:
        """Put one message and wait for the answer to it."""
        number = b"%d" % next(self.numbers)
        payload = number.ljust(16) + padding
        self.end.put(key_to(who, lane), payload, b"header", lane=lane)
        answers = self.answers[who]
        self.mesh.until(lambda: number.ljust(16) in answers.payloads)
        answer = answers.samples[answers.payloads.index(number.ljust(16))]
        assert answer.header == digest(Arrival(key_to(who, lane), payload, b"header"))


@pytest.mark.parametrize("size", [0, 100_000, 1_000_000])
def test_payloads_cross_processes_whole(mesh: ZenohMesh, size: int) -> None:
    me = Correspondent(mesh)
    for who in TASK:
        me.spawn(who)
    for who, lane, _ in itertools.product(TASK, LANES, range(5)):
        me.ask(who, lane, bytes(i % 251 for i in range(1_000)) * (size // 1_000))


def test_a_frozen_process_costs_the_others_nothing(mesh: ZenohMesh) -> None:
    me = Correspondent(mesh)
    frozen = me.spawn(NEAR)
    me.spawn(FAR)
    frozen.send_signal(signal.SIGSTOP)
    sent: dict[Lane, list[int]] = {lane: [] for lane in LANES}
    # Far more than every buffer on the way holds, in both kinds of session. If one put waited for
    # the frozen process, the next message to the other would not get out while it is frozen.
    for _ in range(100):
        for lane in LANES:
            number = next(me.numbers)
            sent[lane].append(number)
            me.end.put(key_to(NEAR, lane), (b"%d" % number).ljust(200_000), lane=lane)
            me.ask(FAR, lane)
    frozen.send_signal(signal.SIGCONT)
    me.reach(NEAR)
    heard = [int(payload) for payload in me.answers[NEAR].payloads]
    for lane, numbers in sent.items():  # what was not dropped comes once and in order
        came = [number for number in heard if number in set(numbers)]
        assert came == sorted(set(came))
        if lane == "control":  # 20 MB through sockets; the others are small references to memory
            assert len(came) < len(numbers)


def test_of_large_payloads_that_wait_the_newest_are_sent() -> None:
    begun, go_on, sent = threading.Event(), threading.Event(), Queue[bytes]()

    def send(way: KeyRoute, content: bytes, header: bytes) -> None:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        sent.put(content + header)

    sender = PatientSender(KeyRoute(print, None), send)
    sender.send(b"1", b"a")
    assert begun.wait(PATIENCE_S)  # it is on its way, and hangs
    for number in (b"2", b"3", b"4", b"5"):
        sender.send(number, b"b")
    go_on.set()
    assert [sent.get(timeout=PATIENCE_S) for _ in range(3)] == [b"1a", b"4b", b"5b"]
    sender.stop()
    sender.send(b"6", b"c")
    assert sent.empty()


@pytest.mark.parametrize("listens", [True, False])
def test_a_killed_process_that_comes_back_is_heard_again(mesh: ZenohMesh, listens: bool) -> None:
    # `me` is named first and listens; the witness comes after `far` and connects to it.
    me = Correspondent(mesh)
    witness = mesh.inbox()
    if listens:
        mesh.open(WITNESS).subscribe(f"dwell/t/done/{FAR}", witness)
    for _ in range(2):
        child = me.spawn(FAR)
        me.ask(FAR, "control")
        child.kill()
        child.wait()
        me.end.put(key_to(FAR, "control"), b"to the dead")
        witness.samples.clear()
    me.spawn(FAR)
    me.ask(FAR, "images", bytes(300_000))
    if listens:

        def ask() -> None:
            me.end.put(key_to(FAR, "control"), b"0")

        mesh.joined(lambda: bool(witness.samples), ask)


def test_a_taken_port_is_named(mesh: ZenohMesh) -> None:
    mesh.open(ME)
    with pytest.raises(LiveError, match=rf"{ME} .*control.*{mesh.first_port}.*taken"):
        mesh.open(ME)


@pytest.mark.parametrize(
    ("address", "words"),
    [("no.such.host.invalid", "cannot be resolved"), ("192.0.2.7", "is no address of this")],
)
def test_an_address_that_is_not_here_is_no_taken_port(address: str, words: str) -> None:
    role = Role(ME, "R1", "agent")
    entry = WiringEntry(role, {"control": Locator(address, 7_450)}, {})
    with pytest.raises(LiveError, match=words) as caught:
        ZenohTransport(entry)
    assert "taken" not in str(caught.value)


def test_a_receiver_that_fails_goes_on_hearing(
    mesh: ZenohMesh, caplog: pytest.LogCaptureFixture
) -> None:
    me, inbox = mesh.open(ME), mesh.inbox()

    def fail(sample: Arrival) -> None:
        inbox(sample)
        raise ValueError("no good")

    mesh.open(NEAR).subscribe("dwell/t/order", fail)
    mesh.joined(lambda: len(inbox.samples) >= 2, lambda: me.put("dwell/t/order", b""))
    assert "no good" in caplog.text
    assert "dwell/t/order" in caplog.text


def test_a_process_without_sessions_for_images_sends_them_the_other_way(mesh: ZenohMesh) -> None:
    entry = mesh.entry(FAR)
    control = {"control": entry.connect["control"]}
    small = ZenohTransport(type(entry)(entry.role, {}, control))  # type: ignore[arg-type]
    inbox = mesh.inbox()
    mesh.open(ME).subscribe("dwell/t/in/**", inbox)
    try:
        mesh.joined(
            lambda: bool(inbox.samples),
            lambda: small.put("dwell/t/in/task/R1/main", bytes(50_000), lane="images"),
        )
        assert small.peers == {"control": 1}
    finally:
        small.close()
    assert small.peers == {}


def test_a_full_pool_falls_back_to_a_copy() -> None:
    pool = PayloadPool.of(1 << 20)
    assert pool is not None
    payload = bytes(range(256)) * 1_024
    held = [pool.filled(payload) for _ in range(8)]
    kinds = [type(item) for item in held]
    assert kinds[0] is not bytes
    assert kinds[-1] is bytes
    assert all(bytes(item) == payload for item in held)
    del held
    assert type(pool.filled(payload)) is not bytes


def test_no_pool_where_there_is_no_room_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert PayloadPool.of(1 << 50) is None
    monkeypatch.setattr("dwell.live.transport.zenoh.SHARED_MEMORY", "/nowhere/at/all")
    assert PayloadPool.of() is None


def test_a_user_who_may_lock_little_memory_sends_through_sockets() -> None:
    code = "from dwell.live.transport.zenoh import PayloadPool; print(PayloadPool.of())"
    command = ["prlimit", "--memlock=1000000", sys.executable, "-c", code]
    if os.geteuid() == 0:  # whom no limit holds
        command[2:2] = ["setpriv", "--bounding-set=-ipc_lock"]
    if missing := [name for name in ("prlimit", "setpriv") if shutil.which(name) is None]:
        pytest.skip(f"{', '.join(missing)} is not installed")
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "None\n"
    assert "images are copied through sockets" in done.stderr


def test_the_killed_leave_no_shared_memory_behind(mesh: ZenohMesh) -> None:
    # Zenoh clears up after the dead whenever somebody starts to share memory.
    def pools() -> set[str]:
        found = Path("/dev/shm").glob("*.zenoh")
        return {file.name for file in found if file.stat().st_size == POOL_BYTES}

    before = pools()
    me = Correspondent(mesh)
    for _ in range(4):
        child = me.spawn(NEAR)
        me.ask(NEAR, "images", bytes(200_000))
        child.kill()
        child.wait()
    me.spawn(NEAR)
    # Ours, that of the living process, and at most one of somebody who has just died.
    assert len(pools() - before) <= 3


def test_a_message_that_is_too_long_is_dropped_on_arrival() -> None:
    """And not put together first: a peer decides on the length of what it sends."""
    mesh = ZenohMesh([ME, FAR], ZenohSettings(longest_bytes=1 << 20))
    try:
        sender, receiver = mesh.open(ME), mesh.open(FAR)
        inbox, key = mesh.inbox(), "dwell/t/in/images/E"
        receiver.subscribe(key, inbox)
        introduce(mesh, sender, key, [inbox], lane="images")
        mesh.joined(
            lambda: any(len(payload) == 1 << 19 for payload in inbox.payloads),
            lambda: sender.put(key, bytes(1 << 19), lane="images"),
        )
        for _ in range(5):
            sender.put(key, bytes(3 << 20), lane="images")
        mesh.joined(
            lambda: b"after" in inbox.payloads, lambda: sender.put(key, b"after", lane="images")
        )
        assert max(len(payload) for payload in inbox.payloads) == 1 << 19
    finally:
        mesh.close()


def test_a_receiver_that_fails_gets_the_next_message_and_its_failure_is_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    mesh = ZenohMesh([ME, FAR])
    try:
        sender, receiver = mesh.open(ME), mesh.open(FAR)
        assert isinstance(receiver, ZenohTransport)
        inbox, key = mesh.inbox(), "dwell/t/stamped"

        def receive(sample: Arrival) -> None:
            if sample.payload == b"poison":
                raise ZeroDivisionError
            inbox(sample)

        receiver.subscribe(key, receive)
        introduce(mesh, sender, key, [inbox])
        for payload in (b"poison", b"poison", b"food"):
            sender.put(key, payload)
        mesh.joined(lambda: b"food" in inbox.payloads, lambda: sender.put(key, b"food"))
        assert receiver.failed == 2
        (record,) = caplog.records
        assert record.getMessage() == f"{FAR}: a receiver of {key} failed"
    finally:
        mesh.close()


def test_what_was_put_under_another_key_is_not_heard() -> None:
    """Zenoh has delivered messages under keys of the session before, when it began anew."""
    mesh = ZenohMesh([ME, FAR])
    try:
        sender, receiver = mesh.open(ME), mesh.open(FAR)
        assert isinstance(sender, ZenohTransport)
        assert isinstance(receiver, ZenohTransport)
        inbox, key = mesh.inbox(), "dwell/t/stamped"
        receiver.subscribe(key, inbox)
        introduce(mesh, sender, key, [inbox])
        way = sender._routes[key, "control"]
        own, way.mark = way.mark, mark_of("dwell/t/order")
        sender.put(key, b"misled", b"header")
        # What carries no mark is of others, who may put what they may put.
        way.mark = b""
        sender.put(key, b"unmarked")
        way.mark = own
        mesh.joined(lambda: b"after" in inbox.payloads, lambda: sender.put(key, b"after", b"head"))
        assert b"misled" not in inbox.payloads
        assert b"unmarked" in inbox.payloads
        assert receiver.misled == 1
        assert {one.header for one in inbox.samples if one.payload == b"after"} == {b"head"}
    finally:
        mesh.close()
