"""Messages that the transport leaves out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.keys import Keys
from dwell.live.transport.transport import Lane
from dwell.testbed.losses import Losses, LossFile, LossyTransport, target_of
from tests.live.transport.meshes import ZenohMesh, introduce

NODES = "R1", "E", "R2"
KEYS = Keys("cell")
TO_E = KEYS.inputs("perception", "E")


@pytest.fixture
def file(tmp_path: Path) -> Iterator[LossFile]:
    with LossFile(tmp_path / "losses", NODES, seed=3) as opened:
        yield opened


def lost_of(count: int, losses: Losses, key: str = TO_E) -> int:
    draw = losses.sending(key)
    assert draw is not None
    return sum(draw() for _ in range(count))


# --------------------------------------------------------------------- which message where


def test_the_key_tells_what_is_for_one_node() -> None:
    assert target_of(KEYS.inputs("planning", "E")) == "E"
    assert target_of(KEYS.inputs("planning", "R2", "shadow")) == "R2"
    assert target_of(KEYS.state("planning", "E")) == "E"
    assert target_of(KEYS.snapshot("planning", "E")) == "E"


def test_every_other_key_is_for_several() -> None:
    several = [
        KEYS.command("control"),
        KEYS.done("control"),
        KEYS.ended(),
        KEYS.beat("R1", "stamper@R1"),
        KEYS.stamped(),
        KEYS.frame(),
        KEYS.order(),
        KEYS.accepted(),
        KEYS.load("E"),
        KEYS.restored(),
        KEYS.ask(),
        KEYS.answer("1"),
        KEYS.relay(KEYS.beat("R1", "stamper@R1")),
        KEYS.relay(KEYS.load("E")),
        KEYS.detour(KEYS.done("control")),
        KEYS.carried(),
        KEYS.gathered(),
    ]
    assert [target_of(key) for key in several] == [None] * len(several)


def test_a_message_is_drawn_at_one_end_of_a_link_only(file: LossFile) -> None:
    file.set("R1", "E", 1.0)
    sender, receiver = Losses(file.path, "camera@R1", "R1"), Losses(file.path, "perception@E", "E")
    for key in (TO_E, KEYS.stamped(), KEYS.beat("R1", "camera@R1")):
        draw = sender.sending(key)
        drawn = [draw is not None and draw(), not receiver.receives(key, "R1")]
        assert sorted(drawn) == [False, True]


def test_what_stays_on_its_node_is_never_lost(file: LossFile) -> None:
    for source in NODES:
        for target in NODES:
            file.set(source, target, 1.0)
    losses = Losses(file.path, "perception@E", "E")
    assert losses.sending(TO_E) is None
    assert losses.receives(KEYS.stamped(), "E")


def test_who_does_not_say_where_it_is_loses_nothing(file: LossFile) -> None:
    for source in NODES:
        file.set(source, "E", 1.0)
    losses = Losses(file.path, "controller@E", "E")
    assert losses.receives(KEYS.ask(), "")
    assert losses.receives(KEYS.ask(), "elsewhere")


# --------------------------------------------------------------------------------- draws


def test_losses_are_a_share_of_what_is_sent(file: LossFile) -> None:
    losses = Losses(file.path, "camera@R1", "R1")
    assert lost_of(1_000, losses) == 0
    file.set("R1", "E", 0.02)
    # 20 000 at 2 %: 400 expected, 19.8 of standard deviation.
    assert abs(lost_of(20_000, losses) - 400) < 6 * 19.8
    file.set("R1", "E", 1.0)
    assert lost_of(100, losses) == 100
    file.set("R1", "E", 0.0)
    assert lost_of(100, losses) == 0


def test_directions_are_apart(file: LossFile) -> None:
    file.set("E", "R1", 1.0)
    losses = Losses(file.path, "camera@R1", "R1")
    assert lost_of(100, losses) == 0
    assert not losses.receives(KEYS.stamped(), "E")
    assert losses.receives(KEYS.stamped(), "R2")


def test_each_process_has_a_stream_of_its_own(file: LossFile, tmp_path: Path) -> None:
    file.set("R1", "E", 0.5)

    def drawn(path: Path, who: str) -> list[bool]:
        draw = Losses(path, who, "R1").sending(TO_E)
        assert draw is not None
        return [draw() for _ in range(64)]

    first = drawn(file.path, "camera@R1")
    assert first == drawn(file.path, "camera@R1")
    assert first != drawn(file.path, "stamper@R1")
    with LossFile(tmp_path / "other", NODES, seed=4) as other:
        other.set("R1", "E", 0.5)
        assert first != drawn(other.path, "camera@R1")


# ------------------------------------------------------------------------------ bad input


def test_a_writer_says_what_is_wrong(file: LossFile, tmp_path: Path) -> None:
    with pytest.raises(LiveError, match=r"no node X; it has R1, E, R2"):
        file.set("R1", "X", 0.1)
    with pytest.raises(LiveError, match=r"loss from R1 to E: 1.5 is not in \[0, 1\]"):
        file.set("R1", "E", 1.5)
    with pytest.raises(LiveError, match=r"nan is not in \[0, 1\]"):
        file.set("R1", "E", float("nan"))
    with pytest.raises(LiveError, match="cannot be written"):
        LossFile(tmp_path / "missing" / "losses", NODES)


def test_a_reader_says_what_is_wrong(file: LossFile, tmp_path: Path) -> None:
    with pytest.raises(LiveError, match=r"missing: cannot be read"):
        Losses(tmp_path / "missing", "camera@R1", "R1")
    with pytest.raises(LiveError, match="no node X; it has R1, E, R2"):
        Losses(file.path, "camera@X", "X")
    content = file.path.read_bytes()
    for spoilt in (b"", b"x" + content[1:], content[:-1], content + b"]", content[:24]):
        other = tmp_path / "spoilt"
        other.write_bytes(spoilt)
        with pytest.raises(LiveError, match="is no file of losses"):
            Losses(other, "camera@R1", "R1")


# ------------------------------------------------------------------------------ over Zenoh

COUNT = 400
SENDER, NEAR, FAR = "camera@R1", "stamper@R1", "perception@E"


@pytest.fixture
def mesh() -> Iterator[ZenohMesh]:
    opened = ZenohMesh([SENDER, NEAR, FAR])
    yield opened
    opened.close()


def lossy(mesh: ZenohMesh, file: LossFile, who: str) -> LossyTransport:
    return LossyTransport(mesh.open(who), Losses(file.path, who, who.partition("@")[2]))


@pytest.mark.parametrize("key", [TO_E, KEYS.stamped()], ids=["at the sender", "at the receiver"])
@pytest.mark.parametrize("lane", ["control", "images"])
def test_a_share_crosses_the_link(mesh: ZenohMesh, file: LossFile, key: str, lane: Lane) -> None:
    sender, near, far = (lossy(mesh, file, who) for who in (SENDER, NEAR, FAR))
    inbox, here = mesh.inbox(), mesh.inbox()
    far.subscribe(key, inbox)
    near.subscribe(KEYS.beat("R1", "*"), here)
    introduce(mesh, sender, key, [inbox], lane=lane)
    introduce(mesh, sender, KEYS.beat("R1", SENDER), [here])
    file.set("R1", "E", 0.3)
    for number in range(COUNT):
        sender.put(key, b"%d" % number, b"header", lane=lane)
        sender.put(KEYS.beat("R1", SENDER), b"%d" % number)
        # Queues are short, and what does not fit is lost as well.
        mesh.until(lambda number=number: len(here.samples) > number)  # type: ignore[misc]
    file.set("R1", "E", 0.0)
    sender.put(key, b"last", lane=lane)
    mesh.until(lambda: b"last" in inbox.payloads)
    # 400 at 30 %: 120 expected, 9.2 of standard deviation.
    assert abs(COUNT + 1 - len(inbox.samples) - 120) < 7 * 9.2
    assert {sample.header for sample in inbox.samples[:-1]} == {b"header"}
    assert len(here.samples) == COUNT


def test_a_link_may_lose_everything_for_a_while(mesh: ZenohMesh, file: LossFile) -> None:
    sender, far = lossy(mesh, file, SENDER), lossy(mesh, file, FAR)
    inbox = mesh.inbox()
    far.subscribe(TO_E, inbox)
    introduce(mesh, sender, TO_E, [inbox])
    file.set("R1", "E", 1.0)
    for _ in range(20):
        sender.put(TO_E, b"lost")
    file.set("R1", "E", 0.0)
    sender.put(TO_E, b"last")
    mesh.until(lambda: b"last" in inbox.payloads)
    assert b"lost" not in inbox.payloads
