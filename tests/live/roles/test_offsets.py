"""Offsets on simulated clocks: the true instant is always inside the bound."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from random import Random

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from dwell.live.roles.offsets import MAX_DRIFT_PPB, UNBOUNDED_NS, Offsets
from dwell.live.wire.messages import Beat, Heard

US, MS, S = 1_000, 1_000_000, 1_000_000_000
YEAR = 365 * 86_400 * S
NODES = ("R1", "E", "R2")

Delay = Callable[[Random, str, str, int], int | None]


@dataclass(slots=True)
class Clock:
    """What a node's clock shows at true time t."""

    offset_ns: int
    drift_ppb: int
    wander: Callable[[int], float] = lambda t_ns: 0.0

    def at(self, t_ns: int) -> int:
        return self.offset_ns + t_ns + t_ns * self.drift_ppb // S + round(self.wander(t_ns))


@dataclass(slots=True)
class World:
    """Processes that send beats to one another; one of them compares the clocks."""

    clocks: dict[str, Clock]
    offsets: Offsets
    delay: Delay
    random: Random
    processes: int = 1
    period_ns: int = 40 * MS
    heard: dict[str, dict[str, Heard]] = field(default_factory=dict)
    best_ns: dict[tuple[str, str], int] = field(default_factory=dict)

    def play(self, begin_ns: int, end_ns: int) -> Iterator[int]:
        """Deliver beats in the order of their arrival; yield true times between them."""
        under_way: list[tuple[int, int, str, str, Beat]] = []
        number = 0
        for t_ns in range(begin_ns, end_ns, self.period_ns):
            for node in self.clocks:
                for process in range(self.processes):
                    sent_ns = t_ns + self.random.randrange(self.period_ns)
                    under_way += self._send(f"p{process}@{node}", node, sent_ns, number)
                    number += 3
            under_way.sort(key=lambda item: item[:2])
            while under_way and under_way[0][0] < t_ns + self.period_ns:
                at_ns, _, who, to, beat = under_way.pop(0)
                self._arrive(at_ns, who, to, beat)
            yield t_ns + self.period_ns

    def _send(
        self, who: str, node: str, sent_ns: int, number: int
    ) -> Iterator[tuple[int, int, str, str, Beat]]:
        heard = tuple(self.heard.get(who, {}).values())
        # What is written into a beat was heard before it was sent.
        clock = self.clocks[node]
        heard = tuple(h for h in heard if h.at_ns <= clock.at(sent_ns))
        beat = Beat(who, node, 1, clock.at(sent_ns), ready=True, heard=heard)
        for i, other in enumerate(self.clocks):
            if other == node:
                continue
            delay_ns = self.delay(self.random, node, other, sent_ns)
            if delay_ns is not None:
                pair = (node, other)
                self.best_ns[pair] = min(self.best_ns.get(pair, delay_ns), delay_ns)
                yield sent_ns + delay_ns, number + i, who, other, beat

    def _arrive(self, at_ns: int, who: str, to: str, beat: Beat) -> None:
        shown_ns = self.clocks[to].at(at_ns)
        for process in range(self.processes):
            mine = self.heard.setdefault(f"p{process}@{to}", {})
            mine[who] = Heard(who, beat.node, beat.sent_ns, shown_ns)
        if to == self.offsets.node:
            self.offsets.hear(beat, shown_ns)

    def error_and_bound(self, node: str, t_ns: int) -> tuple[int, int]:
        found = self.offsets.to_reference(node, self.clocks[node].at(t_ns))
        true_ns = self.clocks[self.offsets.reference].at(t_ns)
        return abs(found.instant_ns - true_ns), found.bound_ns

    def error_back(self, node: str, t_ns: int) -> tuple[int, int]:
        true_ns = self.clocks[self.offsets.reference].at(t_ns)
        found = self.offsets.from_reference(node, true_ns)
        return abs(found.instant_ns - self.clocks[node].at(t_ns)), found.bound_ns


#: Clocks show whole nanoseconds.
READING_NS = 4


def jittery(least_ns: int, spread_ns: int, loss: float = 0.0) -> Delay:
    """Delays of each direction its own: the least, and a long tail."""

    def delay(random: Random, source: str, target: str, sent_ns: int) -> int | None:
        if random.random() < loss:
            return None
        own = 1 + 3 * ((NODES.index(source) * 2 + NODES.index(target)) % 3)
        return own * least_ns + round(random.expovariate(1) ** 2 * spread_ns)

    return delay


def world(
    delay: Delay,
    *,
    offsets_ns: tuple[int, int, int] = (0, 7 * YEAR, -3 * S),
    drifts_ppb: tuple[int, int, int] = (0, 40_000, -60_000),
    seed: int = 1,
    processes: int = 1,
) -> World:
    pairs = zip(NODES, offsets_ns, drifts_ppb, strict=True)
    clocks = {node: Clock(offset, drift) for node, offset, drift in pairs}
    return World(clocks, Offsets("E", "R1"), delay, Random(seed), processes)


@given(
    offsets_ns=st.tuples(*[st.integers(-10 * YEAR, 10 * YEAR)] * 3),
    drifts_ppb=st.tuples(*[st.integers(-100_000, 100_000)] * 3),
    least_ns=st.integers(1, 20 * MS),
    spread_ns=st.integers(0, 30 * MS),
    loss=st.floats(0, 0.9),
    silence=st.integers(0, 600),
    seed=st.integers(0, 1000),
)
@example((0, 0, 0), (100_000, -100_000, 100_000), 1, 0, 0.0, 600, 0)
def test_the_true_instant_is_inside_the_bound(
    offsets_ns: tuple[int, int, int],
    drifts_ppb: tuple[int, int, int],
    least_ns: int,
    spread_ns: int,
    loss: float,
    silence: int,
    seed: int,
) -> None:
    delay = jittery(least_ns, spread_ns, loss)
    cell = world(delay, offsets_ns=offsets_ns, drifts_ppb=drifts_ppb, seed=seed)
    ages_ns = (0, 300 * MS, 20 * S, -5 * S)
    again_ns = (10 + silence) * S
    for begin_ns, end_ns in ((0, 10 * S), (again_ns, again_ns + 3 * S)):
        for number, t_ns in enumerate(cell.play(begin_ns, end_ns)):
            if number % 5 and number > 20:
                continue
            for node in ("E", "R2"):
                for age_ns in ages_ns:
                    for find in (cell.error_and_bound, cell.error_back):
                        error_ns, bound_ns = find(node, t_ns - age_ns)
                        assert error_ns <= bound_ns + READING_NS
    assert cell.offsets.breaks == 0


@given(least_us=st.integers(20, 5000), seed=st.integers(0, 100))
def test_the_bound_is_close_to_half_the_best_round_trip(least_us: int, seed: int) -> None:
    cell = world(jittery(least_us * US, 3 * MS), seed=seed)
    for _ in cell.play(0, 20 * S):
        pass
    _, bound_ns = cell.error_and_bound("E", 20 * S)
    round_trip_ns = cell.best_ns["R1", "E"] + cell.best_ns["E", "R1"]
    # And what clocks may have parted by since the best messages, twenty seconds ago at most.
    assert bound_ns <= round_trip_ns / 2 + 20 * S * MAX_DRIFT_PPB / 1e9 + 0.3 * MS


def test_the_bound_of_a_silent_link_grows_as_clocks_may_part() -> None:
    cell = world(jittery(100 * US, 0))
    for _ in cell.play(0, 10 * S):
        pass
    _, at_first_ns = cell.error_and_bound("E", 10 * S)
    for later_s in (60, 600):
        error_ns, later_ns = cell.error_and_bound("E", (10 + later_s) * S)
        assert error_ns <= later_ns
        assert later_ns - at_first_ns == pytest.approx(later_s * S * MAX_DRIFT_PPB / 1e9, rel=1e-3)


def test_drift_that_changes_slowly_stays_inside() -> None:
    cell = world(lambda random, source, target, sent_ns: US)
    # The rate swings by 4 ppm and back in two minutes.
    swing = 120 * S
    cell.clocks["E"].wander = lambda t_ns: 4e-6 * swing * math.sin(2 * math.pi * t_ns / swing) / 6.3
    for number, t_ns in enumerate(cell.play(0, 400 * S)):
        if t_ns > S and number % 5 == 0:
            # Now, and after a silence.
            for ahead_ns in (0, 20 * S):
                error_ns, bound_ns = cell.error_and_bound("E", t_ns + ahead_ns)
                assert error_ns <= bound_ns + READING_NS
    assert cell.offsets.breaks == 0


def test_nothing_is_known_before_messages_have_gone_both_ways() -> None:
    offsets = Offsets("E", "R1")
    assert offsets.to_reference("E", 5) == (5, UNBOUNDED_NS)
    assert offsets.to_reference("R1", 5) == (5, 0)
    offsets.hear(Beat("stamper@R1", "R1", 1, 1000, ready=True), 5_001_000)
    # The best guess from one direction: the message took no time.
    assert offsets.to_reference("E", 5_001_000) == (1000, UNBOUNDED_NS)
    assert offsets.from_reference("E", 1000) == (5_001_000, UNBOUNDED_NS)
    heard = (Heard("controller@E", "E", 5_002_000, 2_600),)
    offsets.hear(Beat("stamper@R1", "R1", 1, 3000, ready=True, heard=heard), 5_004_000)
    instant_ns, bound_ns = offsets.to_reference("E", 5_001_000)
    # 5,000,000 ahead at most, 4,999,400 at least.
    assert bound_ns in range(300, 304)
    assert abs(instant_ns - 1300) <= 2


def test_processes_of_one_node_share_its_clock() -> None:
    def slow_for_one(random: Random, source: str, target: str, sent_ns: int) -> int:
        return 10 * MS if sent_ns % 3 else 100 * US

    alone, together = (world(slow_for_one, processes=count, seed=4) for count in (1, 5))
    for cell in (alone, together):
        for _ in cell.play(0, 200 * MS):
            pass
    assert together.error_and_bound("E", 200 * MS)[1] < alone.error_and_bound("E", 200 * MS)[1]


def test_two_other_nodes_are_compared_through_what_their_beats_say_of_one_another() -> None:
    def far_from_me(random: Random, source: str, target: str, sent_ns: int) -> int | None:
        return 30 * MS if "E" in (source, target) else 100 * US

    cell = world(far_from_me)
    for _ in cell.play(0, 2 * S):
        pass
    error_ns, bound_ns = cell.error_and_bound("R2", 2 * S)
    assert error_ns <= bound_ns + READING_NS
    assert bound_ns <= 150 * US


@pytest.mark.parametrize("jump_ns", [-8 * YEAR, -S, S, 8 * YEAR])
@pytest.mark.parametrize("node", NODES)
def test_a_clock_that_begins_anew_is_found_out(jump_ns: int, node: str) -> None:
    cell = world(jittery(100 * US, 500 * US))
    for _ in cell.play(0, 10 * S):
        pass
    cell.clocks[node].offset_ns += jump_ns
    cell.heard.clear()
    for t_ns in cell.play(12 * S, 14 * S):
        if t_ns > 12 * S + 200 * MS:
            for other in ("E", "R2"):
                error_ns, bound_ns = cell.error_and_bound(other, t_ns)
                assert error_ns <= bound_ns + READING_NS < 5 * MS
    assert cell.offsets.breaks >= 1


def test_copies_and_late_beats_change_nothing() -> None:
    cell = world(jittery(100 * US, 500 * US))
    kept: list[tuple[Beat, int]] = []
    hear = cell.offsets.hear
    repeated = Offsets("E", "R1")

    class Both(Offsets):
        def hear(self, beat: Beat, at_ns: int) -> None:
            hear(beat, at_ns)
            kept.append((beat, at_ns))
            repeated.hear(beat, at_ns)
            # A copy took the longer way.
            if len(kept) > 10:
                late, _ = kept[-10]
                repeated.hear(late, at_ns)

    plain = cell.offsets
    cell.offsets = Both("E", "R1")
    for _ in cell.play(0, 5 * S):
        pass
    t_ns = cell.clocks["E"].at(5 * S)
    one, other = plain.to_reference("E", t_ns), repeated.to_reference("E", t_ns)
    assert abs(one.instant_ns - other.instant_ns) < US
    assert abs(one.bound_ns - other.bound_ns) < US


def test_synchronous_clocks_are_taken_at_their_word() -> None:
    offsets = Offsets("E", "R1", system_bound_ns=50 * US)
    offsets.hear(Beat("stamper@R1", "R1", 1, 10 * S, ready=True), 5)
    assert offsets.to_reference("E", 7) == (7, 50 * US)
    assert offsets.from_reference("R2", 7) == (7, 50 * US)
    assert offsets.to_reference("R1", 7) == (7, 0)


def test_a_flood_of_names_takes_no_memory() -> None:
    cell = world(jittery(100 * US, 0))
    for _ in cell.play(0, S):
        pass
    before = cell.error_and_bound("E", S)
    for i in range(1000):
        cell.offsets.hear(Beat("x", f"node{i}", 1, i, ready=True), 5)
    assert len(cell.offsets._pairs) <= 64 * 64
    assert cell.error_and_bound("E", S) == before
