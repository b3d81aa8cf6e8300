"""How connections share a rate: in one queue, or each in its own; on a clock of the test's."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dwell.demo.link_rate import Fair, InOrder

MS = 1_000_000
#: Of 8 Mbit/s: a byte takes a microsecond.
RATE_MBPS, BYTE_NS = 8.0, 1_000
QUEUE_BYTES = 10_000
ROUNDING_NS = 10


@dataclass
class Clockwork:
    now_ns: int = 0
    actions: list[tuple[int, int, Callable[[int], None]]] = field(default_factory=list)
    count: int = 0

    def at(self, instant_ns: int, action: Callable[[int], None], /) -> None:
        self.count += 1
        heapq.heappush(self.actions, (instant_ns, self.count, action))

    def run(self, until_ns: int) -> None:
        while self.actions and self.actions[0][0] <= until_ns:
            instant_ns, _, action = heapq.heappop(self.actions)
            self.now_ns = max(self.now_ns, instant_ns)
            action(instant_ns)
        self.now_ns = until_ns


class Line:
    """A rate, and what has passed it."""

    def __init__(self, kind: type[Fair[str]] | type[InOrder[str]]) -> None:
        self.clock = Clockwork()
        self.resumed: list[tuple[str | None, int]] = []
        self.passed: list[tuple[str, int]] = []
        self.rate = kind(self.clock, QUEUE_BYTES, self._resume)
        self.rate.change(RATE_MBPS, 0)

    def _resume(self, stream: str | None) -> None:
        self.resumed.append((stream, self.clock.now_ns))

    def put(self, stream: str, size_bytes: int) -> None:
        self.rate.put(
            stream,
            size_bytes,
            self.clock.now_ns,
            lambda at_ns: self.passed.append((stream, at_ns)),
        )


def near(instant_ns: int) -> object:
    return pytest.approx(instant_ns, abs=ROUNDING_NS)


def test_in_one_queue_what_comes_later_waits_for_all_before_it() -> None:
    line = Line(InOrder)
    line.put("images", 5_000)
    line.put("small", 100)
    line.clock.run(50 * MS)
    assert line.passed == [("images", 5 * MS), ("small", 5_100_000)]


def test_with_a_queue_each_they_share_until_one_is_empty() -> None:
    line = Line(Fair)
    line.put("images", 5_000)
    line.put("small", 100)
    line.clock.run(50 * MS)
    # Small ones at half the rate; the rest of the images' bytes at all of it.
    assert line.passed == [("small", near(200_000)), ("images", near(5_100_000))]


def test_who_comes_in_the_middle_slows_the_other_from_then_on() -> None:
    line = Line(Fair)
    line.put("images", 4_000)
    line.clock.run(1 * MS)
    line.put("small", 1_000)
    line.clock.run(50 * MS)
    assert line.passed == [("small", near(3 * MS)), ("images", near(5 * MS))]


def test_within_a_connection_the_order_stays_and_nothing_at_all_waits_too() -> None:
    line = Line(Fair)
    for size in (3_000, 0, 500):
        line.put("images", size)
    line.clock.run(50 * MS)
    assert [at_ns for _, at_ns in line.passed] == [near(3 * MS), near(3 * MS), near(3_500_000)]
    line.put("images", 0)
    assert line.passed[-1][1] == 50 * MS


def test_a_full_queue_stops_its_own_connection_alone() -> None:
    line = Line(Fair)
    line.put("images", 12_000)
    line.put("small", 100)
    assert line.rate.full("images")
    assert not line.rate.full("small")
    line.put("images", 3_000)
    line.clock.run(50 * MS)
    assert not line.rate.full("images")
    # Behind the first 12 kB only 3 kB wait.
    assert line.resumed == [("images", 0), ("images", near(12_100_000))]
    other = Line(InOrder)
    other.put("images", 12_000)
    assert other.rate.full("small")
    other.clock.run(1_999_999)
    assert other.rate.full("images")
    other.clock.run(2 * MS)
    assert not other.rate.full("images")


def test_a_change_of_the_rate_is_for_what_waits_too() -> None:
    line = Line(Fair)
    line.put("images", 4_000)
    line.clock.run(1 * MS)
    line.rate.change(2 * RATE_MBPS, line.clock.now_ns)
    line.clock.run(50 * MS)
    assert line.passed == [("images", near(2_500_000))]
    line.rate.change(float("inf"), line.clock.now_ns)
    line.put("images", 1_000_000)
    assert line.passed[-1] == ("images", 50 * MS)


def test_what_a_closed_connection_had_queued_takes_nothing() -> None:
    line = Line(Fair)
    line.put("images", 5_000)
    line.put("small", 1_000)
    line.rate.leave("images")
    line.clock.run(50 * MS)
    assert line.passed == [("small", near(1 * MS))]


def test_a_slow_link_is_read_in_small_pieces() -> None:
    line = Line(InOrder)
    for rate_mbps, chunk_bytes in ((0.1, 1_448), (20.0, 2_500), (float("inf"), 65_536)):
        line.rate.change(rate_mbps, 0)
        assert line.rate.chunk_bytes == chunk_bytes


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.sampled_from("abc"), st.integers(0, 3_000)),
        min_size=1,
        max_size=40,
    )
)
@settings(max_examples=60, deadline=None)
def test_all_bytes_pass_and_the_rate_is_used_and_never_exceeded(
    puts: list[tuple[int, str, int]],
) -> None:
    fair, queue = Line(Fair), Line(InOrder)
    for line in (fair, queue):
        for wait_ms, stream, size in puts:
            line.clock.run(line.clock.now_ns + wait_ms * MS)
            line.put(stream, size)
        line.clock.run(10_000 * MS)
        assert len(line.passed) == len(puts)
    # However it is shared, the last byte of a busy time passes at the same instant.
    ends = [max(at_ns for _, at_ns in line.passed) for line in (fair, queue)]
    assert ends[0] == pytest.approx(ends[1], abs=ROUNDING_NS * len(puts))
    for stream in "abc":
        instants = [at_ns for name, at_ns in fair.passed if name == stream]
        assert instants == sorted(instants)
