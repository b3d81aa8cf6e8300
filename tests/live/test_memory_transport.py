"""What the network in memory does to messages, clocks and processes when it is told to."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dwell.errors import LiveError
from dwell.live.wire.transport import Arrival, Lane
from tests.live.memory_transport import Clock, MemoryTransport, Network, NetworkConditions

MS = 1_000_000


class Listener:
    """Notes what arrives and when."""

    def __init__(self, network: Network, who: str, key: str = "**") -> None:
        self.network = network
        self.end = network.transport(who)
        self.heard: list[tuple[float, bytes]] = []
        self.end.subscribe(key, self._note)

    def _note(self, sample: Arrival) -> None:
        self.heard.append((self.network.now_ns / MS, sample.payload))

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.heard]


def send(end: MemoryTransport, count: int, *, every_ns: int = 0, lane: Lane = "control") -> None:
    network = end.network
    for i in range(count):
        at_ns = network.now_ns + i * every_ns
        network.call_at(at_ns, lambda i=i: end.put("k", b"%d" % i, lane=lane))  # type: ignore[misc]


def numbers(count: int) -> list[bytes]:
    return [b"%d" % i for i in range(count)]


def test_a_message_takes_its_delay() -> None:
    network = Network(delay_ns=2 * MS)
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    network.impair(NetworkConditions(delay_ns=3 * MS), "R1", "E")
    network.impair(NetworkConditions(delay_ns=100 * MS), "E", "R1")
    sender.put("k", b"x")
    assert listener.heard == []
    network.advance(5 * MS - 1)
    assert listener.heard == []
    network.advance(5 * MS)
    assert listener.heard == [(5.0, b"x")]


def test_jitter_keeps_the_order_and_reordering_does_not() -> None:
    network = Network(seed=3)
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    jitter = network.impair(NetworkConditions(delay_ns=lambda random: random.randrange(10 * MS)))
    send(sender, 200, every_ns=MS)
    network.advance(1_000 * MS)
    assert listener.payloads == numbers(200)
    network.heal(jitter)
    listener.heard.clear()
    network.impair(NetworkConditions(reordering=0.2, reorder_ns=3 * MS))
    send(sender, 200, every_ns=MS)
    network.advance(2_000 * MS)
    assert listener.payloads != numbers(200)
    assert sorted(listener.payloads) == sorted(numbers(200))


def test_lanes_do_not_wait_for_each_other() -> None:
    network = Network()
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    network.impair(NetworkConditions(delay_ns=5 * MS), key="image")
    sender.put("image", b"large", lane="images")
    sender.put("k", b"small")
    network.advance(10 * MS)
    assert listener.payloads == [b"small", b"large"]
    sender.put("image", b"large")
    sender.put("k", b"small")
    network.advance(20 * MS)
    assert listener.payloads[2:] == [b"large", b"small"]


def test_losses_and_doubles_come_as_often_as_asked() -> None:
    network = Network(seed=5)
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    network.impair(NetworkConditions(loss=0.3), "a@R1", "b@E")
    network.impair(NetworkConditions(duplication=0.25))
    send(sender, 2_000, every_ns=1)
    network.advance(MS)
    # Four standard deviations around the mean of a binomial.
    assert network.lost == pytest.approx(600, abs=4 * (2_000 * 0.3 * 0.7) ** 0.5)
    arrived = 2_000 - network.lost
    doubled = len(listener.heard) - arrived
    assert doubled == pytest.approx(arrived * 0.25, abs=4 * (arrived * 0.25 * 0.75) ** 0.5)


def test_a_cut_is_one_way_and_for_some_keys() -> None:
    network = Network()
    one, other = Listener(network, "a@R1"), Listener(network, "b@E")
    cut = network.cut("R1", "E", key="data/**")
    one.end.put("data/x", b"lost")
    one.end.put("beat/x", b"beat")
    other.end.put("data/x", b"back")
    network.advance(1)
    assert other.payloads == [b"beat"]
    assert one.payloads == [b"back"]
    network.heal(cut)
    one.end.put("data/x", b"again")
    network.advance(2)
    assert other.payloads == [b"beat", b"again"]


def test_a_stalled_link_keeps_the_newest() -> None:
    network = Network()
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    stall = network.stall("R1", waiting=3)
    send(sender, 10)
    network.advance(MS)
    assert listener.heard == []
    network.heal(stall)
    network.advance(2 * MS)
    assert listener.payloads == numbers(10)[-3:]
    assert network.lost == 7


def test_a_frozen_process_goes_on_where_it_stopped() -> None:
    network = Network()
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    witness = Listener(network, "c@E")
    network.freeze("b@E", waiting=4)
    send(sender, 6)
    network.advance(5 * MS)
    assert listener.heard == []
    assert witness.payloads == numbers(6)
    network.thaw("b@E")
    assert listener.heard == [(5.0, number) for number in numbers(6)[2:]]
    assert network.lost == 2


def test_the_killed_hear_nothing_and_may_come_back() -> None:
    network = Network(delay_ns=MS)
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    sender.put("k", b"on its way")
    listener.end.put("k", b"sent before it died")
    back = Listener(network, "c@R1")
    network.kill("b@E")
    again = Listener(network, "b@E")
    sender.put("k", b"new")
    network.advance(2 * MS)
    assert listener.heard == []
    assert again.payloads == [b"new"]
    assert b"new" in back.payloads
    with pytest.raises(LiveError, match="b@E is in the network"):
        network.transport("b@E")


def test_only_those_within_reach_hear() -> None:
    def reach(source: str, target: str, lane: Lane, key: str) -> bool:
        return (source, target) == ("a@R1", "b@E") and lane == "control"

    network = Network(reach=reach)
    near, far = Listener(network, "b@E"), Listener(network, "c@R2")
    sender = network.transport("a@R1")
    sender.put("k", b"1")
    sender.put("k", b"2", lane="images")
    network.advance(1)
    assert near.payloads == [b"1"]
    assert far.payloads == []


def test_a_lane_that_is_too_slow_is_later_with_every_message() -> None:
    network = Network()
    listener, sender = Listener(network, "b@E"), network.transport("a@R1")
    slow = network.impair(NetworkConditions(rate_mbps=8.0), "R1", "E", key="image")
    for _ in range(3):
        sender.put("image", bytes(5_000), lane="images")
        sender.put("k", b"small")
    network.advance(14 * MS)
    assert [at_ms for at_ms, payload in listener.heard if payload == b"small"] == [0.0, 0.0, 0.0]
    assert [at_ms for at_ms, payload in listener.heard if payload != b"small"] == [5.0, 10.0]
    network.heal(slow)
    network.advance(20 * MS)
    assert listener.heard[-1][0] == 15.0


def test_a_tap_hears_all_that_is_put_whoever_else_does() -> None:
    network, heard = Network(delay_ns=MS), list[tuple[int, str]]()
    network.taps.append(lambda sample: heard.append((network.now_ns, sample.key)))
    network.cut()
    sender = network.transport("a@R1")
    sender.put("k", b"lost")
    assert heard == [(0, "k")]


class Metronome:
    """Puts a beat every period of its own clock, and counts what it hears."""

    def __init__(self, end: MemoryTransport, period_ns: int, first_ns: int) -> None:
        self.end = end
        self.period_ns = period_ns
        self.due_ns = first_ns
        self.woken: list[int] = []
        self.heard: list[int] = []

    def subscriptions(self) -> Iterable[str]:
        return ["beat/*"]

    def receive(self, sample: Arrival, now_ns: int) -> None:
        self.heard.append(now_ns)

    def wake(self, now_ns: int) -> int:
        if now_ns >= self.due_ns:
            self.woken.append(now_ns)
            self.end.put(f"beat/{self.end.node}", b"")
            self.due_ns += self.period_ns
        return self.due_ns


def test_participants_are_woken_when_they_want_on_their_own_clock() -> None:
    network = Network(delay_ns=MS)
    ahead = Clock(offset_ns=7_000 * MS, drift_ppm=200.0)
    one = network.transport("a@R1")
    other = network.transport("b@E", clock=ahead)
    true = Metronome(one, 10 * MS, 0)
    fast = Metronome(other, 10 * MS, 7_000 * MS)
    network.attach(one, true)
    network.attach(other, fast)
    network.advance(1_000 * MS)
    assert true.woken == [i * 10 * MS for i in range(101)]
    assert fast.woken == [7_000 * MS + i * 10 * MS for i in range(101)]
    assert other.now_ns == 8_000 * MS + 200_000
    # The beat of 0 takes a millisecond, and is read on the other's clock.
    assert fast.heard[0] == 7_001 * MS + 200
    assert len(fast.heard) == 100


def test_a_frozen_participant_wakes_late_and_a_killed_one_never() -> None:
    network = Network()
    ends = [network.transport("a@R1"), network.transport("b@E")]
    metronomes = [Metronome(end, 10 * MS, 0) for end in ends]
    for end, metronome in zip(ends, metronomes, strict=True):
        network.attach(end, metronome)
    network.call_at(25 * MS, lambda: network.freeze("a@R1"))
    network.call_at(58 * MS, lambda: network.thaw("a@R1"))
    network.call_at(25 * MS, lambda: network.kill("b@E"))
    network.advance(70 * MS)
    woken = [at_ns / MS for at_ns in metronomes[0].woken]
    assert woken[:3] == [0, 10, 20]
    assert 30 not in woken
    assert woken[3] == 58
    assert [at_ns / MS for at_ns in metronomes[1].woken] == [0, 10, 20]


@settings(deadline=None)
@given(
    st.integers(-(10**15), 10**15),
    st.floats(-500, 500),
    st.integers(-(10**15), 10**15),
)
def test_a_clock_reaches_what_it_shows(offset_ns: int, drift_ppm: float, shown_ns: int) -> None:
    clock = Clock(offset_ns, drift_ppm)
    at_ns = clock.instant(shown_ns)
    assert clock.shown(at_ns) >= shown_ns
    assert clock.shown(at_ns - 1) < shown_ns


@given(st.integers(0, 2**32))
def test_a_seed_gives_the_same_run_whoever_else_is_there(seed: int) -> None:
    def run(others: int) -> list[tuple[float, bytes]]:
        network = Network(seed=seed)
        listener, sender = Listener(network, "b@E"), network.transport("a@R1")
        for i in range(others):
            Listener(network, f"x{i}@E").end.put("k", b"other")
        network.impair(
            NetworkConditions(
                delay_ns=lambda random: random.randrange(MS),
                loss=0.2,
                duplication=0.2,
                reordering=0.2,
            )
        )
        send(sender, 30, every_ns=10_000)
        network.advance(10 * MS)
        return [item for item in listener.heard if item[1] != b"other"]

    assert run(0) == run(0) == run(3)


def test_streams_of_two_pairs_differ() -> None:
    network = Network(seed=1)
    listeners = [Listener(network, "b@E"), Listener(network, "c@E")]
    network.impair(NetworkConditions(delay_ns=lambda random: random.randrange(MS)))
    send(network.transport("a@R1"), 20, every_ns=MS)
    network.advance(100 * MS)
    assert listeners[0].heard != listeners[1].heard
