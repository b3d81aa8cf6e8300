"""Roles in a thread: each is woken when something is due, also what a message has made due."""

from __future__ import annotations

import threading

import pytest

from dwell.live.host.hosting import Hosted, take_turns
from dwell.live.wire.transport import Arrival
from tests.live.memory_transport import MemoryTransport, Network

FAR_NS = 1 << 62


class Waiting:
    """Wants to be woken at an instant that messages say; far away otherwise."""

    def __init__(self, wanted_ns: int | None) -> None:
        self.wanted_ns = wanted_ns
        self.taken = b""
        self.woken = threading.Semaphore(0)

    def subscriptions(self) -> tuple[str, ...]:
        return ("dwell/c/stamped",)

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        return self.wanted_ns

    def wake(self, now_ns: int) -> int:
        self.woken.release()
        return FAR_NS


@pytest.fixture
def sender(monkeypatch: pytest.MonkeyPatch) -> tuple[Network, MemoryTransport]:
    # No thread looks by itself within the test.
    monkeypatch.setattr("dwell.live.host.hosting.LONGEST_SLEEP_S", 60.0)
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


def test_a_role_is_woken_at_once_from_another_thread(
    sender: tuple[Network, MemoryTransport],
) -> None:
    role = Waiting(None)
    hosted = Hosted(role, sender[0].transport("agent@E", "E"), clock=lambda: 1)
    thread = threading.Thread(target=hosted.run, daemon=True)
    thread.start()
    assert role.woken.acquire(timeout=10)
    hosted.wake_now()
    assert role.woken.acquire(timeout=10)
    hosted.stop()
    thread.join(10)


class Due:
    """Is due at some instants; the clock stands where the last one was."""

    def __init__(self, name: str, log: list[str], *due_ns: int) -> None:
        self.name, self.log, self.due_ns = name, log, list(due_ns)

    def subscriptions(self) -> tuple[str, ...]:
        return ()

    def receive(self, sample: Arrival, now_ns: int) -> int | None:
        return None

    def wake(self, now_ns: int) -> int:
        self.log.append(self.name)
        return self.due_ns.pop(0) if self.due_ns else FAR_NS


def test_roles_of_one_thread_take_turns_the_one_due_first_before_the_others() -> None:
    network, hurry, stopped = Network(), threading.Event(), threading.Event()
    log: list[str] = []

    class Last(Due):
        def wake(self, now_ns: int) -> int:
            stopped.set()
            return super().wake(now_ns)

    roles = [Due("a", log, 30, 40), Due("b", log, 10, 20, 41), Last("c", log)]
    all_hosted = [
        Hosted(role, network.transport(role.name, "E"), lambda: 100, stopped=stopped, hurry=hurry)
        for role in roles
    ]
    # All are late; the last one has never been due before the others are through.
    all_hosted[2]._due_ns = 45
    take_turns(all_hosted)
    assert log == ["a", "b", "b", "b", "a", "a", "b", "c"]


@pytest.mark.parametrize("back_ms", [50, 150, 5_000])
def test_a_clock_that_is_set_back_keeps_nobody_asleep(back_ms: int) -> None:
    now_ns = 10**10
    role = Due("a", [], now_ns + 40_000_000)
    hosted = Hosted(role, Network().transport("a", "E"), lambda: now_ns)
    hosted.wake()
    assert hosted.rest_ns() == 40_000_000
    now_ns += 10_000_000
    assert hosted.rest_ns() == 30_000_000
    now_ns -= back_ms * 1_000_000
    # Whoever asks first: it stays due until it has been woken.
    assert hosted.rest_ns() <= 0
    assert hosted.rest_ns() <= 0
    hosted.wake()
    assert role.log == ["a", "a"]
    assert 0 < hosted.rest_ns() <= 200_000_000


def test_a_message_that_a_role_fails_at_is_told_and_the_next_one_is_taken() -> None:
    class Failing(Waiting):
        def receive(self, sample: Arrival, now_ns: int) -> int | None:
            if sample.payload == b"poison":
                return 1 // len(sample.header)
            self.taken = sample.payload
            return None

    network, told = Network(), list[str]()
    stamper = network.transport("stamper@R1", "R1")
    role = Failing(None)
    end = network.transport("controller@E", "E")
    Hosted(role, end, lambda: 1, complain=lambda error: told.append(str(error)))
    for payload in (b"poison", b"food"):
        stamper.put("dwell/c/stamped", payload)
    network.advance(1_000_000_000)
    assert role.taken == b"food"
    (line,) = told
    assert line.startswith("a message under dwell/c/stamped: ZeroDivisionError: ")
    assert "(test_hosting.py:" in line


def test_a_role_that_fails_stops_all() -> None:
    class Failing(Due):
        def wake(self, now_ns: int) -> int:
            raise ZeroDivisionError

    stopped = threading.Event()
    failing = Failing("a", [])
    hosted = Hosted(failing, Network().transport("a", "E"), lambda: 100, stopped=stopped)
    with pytest.raises(ZeroDivisionError):
        take_turns([hosted])
    assert stopped.is_set()
