"""A role in a thread: it is woken when something is due, also what a message has made due."""

from __future__ import annotations

import threading

import pytest

from dwell.live.hosting import Hosted
from dwell.live.transport.memory import MemoryTransport, Network
from dwell.live.transport.protocol import Sample

FAR_NS = 1 << 62


class Waiting:
    """Wants to be woken at an instant that messages say; far away otherwise."""

    def __init__(self, wanted_ns: int | None) -> None:
        self.wanted_ns = wanted_ns
        self.woken = threading.Semaphore(0)

    def subscriptions(self) -> tuple[str, ...]:
        return ("dwell/c/stamped",)

    def receive(self, sample: Sample, now_ns: int) -> int | None:
        return self.wanted_ns

    def wake(self, now_ns: int) -> int:
        self.woken.release()
        return FAR_NS


@pytest.fixture
def sender(monkeypatch: pytest.MonkeyPatch) -> tuple[Network, MemoryTransport]:
    # No thread looks by itself within the test.
    monkeypatch.setattr("dwell.live.hosting.LONGEST_SLEEP_S", 60.0)
    network = Network()
    return network, network.transport("stamper@R1", "R1")


@pytest.mark.parametrize(("wanted_ns", "woken"), [(0, True), (None, False), (FAR_NS, False)])
def test_what_a_message_makes_due_is_done_at_once(
    sender: tuple[Network, MemoryTransport], wanted_ns: int | None, woken: bool
) -> None:
    network, stamper = sender
    role = Waiting(wanted_ns)
    hosted = Hosted(role, network.transport("controller@E", "E"), clock=lambda: 1)
    thread = threading.Thread(target=hosted.run, daemon=True)
    thread.start()
    assert role.woken.acquire(timeout=10)
    stamper.put("dwell/c/stamped", b"")
    network.advance(1_000_000_000)
    assert role.woken.acquire(timeout=10 if woken else 0.05) is woken
    hosted.stop()
    thread.join(10)
    assert not thread.is_alive()
