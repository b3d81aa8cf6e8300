"""Real Zenoh sessions of two processes through a link: what a loss or a cut does to them."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from dwell.demo.link import Forward, LinkProcess
from dwell.model import Constant
from dwell.testbed.conditions import CUTS, Cut
from tests.demo.link_sender import IMAGE_BYTES, session
from tests.demo.link_wire import PATIENCE_S, wait_until

AB = ("A", "B")
SENDER = Path(__file__).with_name("link_sender.py")


class Peers:
    """A sender's process, a link, and a receiver here."""

    def __init__(self, link: LinkProcess, receiver: zenoh.Session) -> None:
        self.link = link
        self.received: list[tuple[str, int, float]] = []
        self._sent = {"small": 0, "image": 0}
        self._new = threading.Condition()
        self._subscriber = receiver.declare_subscriber("t/*", self._receive)
        self._sender = subprocess.Popen(
            [sys.executable, str(SENDER), str(link.ports[0])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.said() == "ready"

    def _receive(self, sample: zenoh.Sample) -> None:
        now_ns = time.monotonic_ns()
        payload = sample.payload.to_bytes()
        name = str(sample.key_expr).removeprefix("t/")
        assert len(payload) == 16 + (IMAGE_BYTES if name == "image" else 0)
        number = int.from_bytes(payload[:8], "little")
        age_ms = (now_ns - int.from_bytes(payload[8:16], "little")) / 1e6
        with self._new:
            self.received.append((name, number, age_ms))
            self._new.notify()

    def said(self) -> str:
        assert self._sender.stdout is not None
        return self._sender.stdout.readline().strip()

    def send(self, name: str, count: int) -> range:
        """Have messages sent, and return their numbers.

        The sender has kept its session if it says that it has a peer.
        """
        assert self._sender.stdin is not None
        print(name, count, file=self._sender.stdin, flush=True)
        assert self.said() == "1"
        first = self._sent[name]
        self._sent[name] += count
        return range(first, first + count)

    def numbers(self, name: str) -> list[int]:
        """Numbers of the messages received since the last `begin`, in their order."""
        return [number for kind, number, _ in list(self.received) if kind == name]

    def until(self, name: str, numbers: range) -> list[int]:
        """Wait for the last of some messages and return what `numbers` does then."""
        with self._new:
            assert self._new.wait_for(lambda: numbers[-1] in self.numbers(name), PATIENCE_S)
        return self.numbers(name)

    def begin(self) -> None:
        """Forget what was before."""
        self.link.set(*AB, loss=0.0, delay_ms=Constant(0.0))
        for name in self._sent:
            self.until(name, self.send(name, 1))
        self.received.clear()
        self.link.stats(reset=True)

    def close(self) -> None:
        self._sender.kill()
        self._sender.communicate()


@pytest.fixture(scope="module")
def shared() -> Iterator[Peers]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with (
        session(listen=port) as receiver,
        LinkProcess(AB, [Forward("A", "127.0.0.1", port)], seed=2) as link,
    ):
        peers = Peers(link, receiver)
        yield peers
        peers.close()


@pytest.fixture
def peers(shared: Peers) -> Peers:
    shared.begin()
    return shared


def test_lost_messages_break_no_session_and_delay_no_others(peers: Peers) -> None:
    peers.link.set(*AB, loss=0.3)
    for _ in range(6):
        peers.send("small", 100)  # at once: the sender puts several into one frame
        peers.send("image", 8)

    def all_have_come() -> bool:
        there = peers.link.stats()[AB]
        return there.messages + there.dropped == 648

    wait_until(all_have_come)
    peers.link.set(*AB, loss=0.0)
    small = peers.until("small", peers.send("small", 1))
    image = peers.until("image", peers.send("image", 1))
    assert small == sorted(set(small))
    assert image == sorted(set(image))
    assert len(small) + len(image) - 2 == 648 - peers.link.stats()[AB].dropped
    # Binomial, 600 and 48 at 0.3: five standard deviations.
    assert 420 - 57 <= len(small) - 1 <= 420 + 57
    assert 34 - 16 <= len(image) - 1 <= 34 + 16


def test_an_image_in_fragments_has_one_delay(peers: Peers) -> None:
    peers.link.set(*AB, delay_ms=Constant(100.0))
    for _ in range(2):
        peers.until("image", peers.send("image", 1))
    there = peers.link.stats()[AB]
    assert there.messages == 2
    # One for each of its seven fragments would be 700 ms.
    assert 100 <= there.delay_mean_ms < 700
    assert min(age_ms for _, _, age_ms in peers.received) >= 100


@pytest.mark.parametrize("kind", CUTS)
def test_a_cut_shorter_than_the_lease_breaks_no_session(peers: Peers, kind: Cut) -> None:
    before = peers.send("small", 5)
    assert peers.until("small", before) == [*before]
    peers.link.cut(kind=kind)
    during = peers.send("small", 5)
    if kind == "drop":  # the buffers before the link have no room for an image
        peers.send("image", 1)
        wait_until(lambda: peers.link.stats()[AB].dropped == 6)
    assert peers.numbers("small") == [*before]
    peers.link.heal()
    after = peers.send("small", 1)
    image = peers.send("image", 1)
    assert peers.until("image", image) == [*image]
    held = during if kind == "hold" else []
    assert peers.until("small", after) == [*before, *held, *after]
