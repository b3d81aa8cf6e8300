"""How long cycles took by the stamper's clock alone, whatever the other clocks show."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from dwell.live.roles.latencies import SPAN_NS, Intervals
from dwell.live.roles.run_rows import columns_of
from dwell.live.wire.messages import Beat, Completion, Heard, Stamp
from dwell.model import Problem
from tests.live.memory_transport import Clock, NetworkConditions
from tests.live.small_world import World, canonical, columns

MS, S = 1_000_000, 1_000_000_000
CLOCKS = {"R1": Clock(7 * S), "E": Clock(50 * S, 80.0), "R2": Clock(900 * S, -60.0)}
WAY_MS = 0.2
#: What the clocks gain on each other between two beats.
ROUNDING_NS = 20_000


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(20, min_dwell=1, estimator="profile")


def measured(world: World) -> list[tuple[int | None, int]]:
    """What the stamper measured of cycles in closed windows, and their latency by all clocks."""
    rows = columns(world, "cycles", "stamper_interval_ns", "latency_ns", "bound_ns", "lead")
    return [(own, all_ns) for own, all_ns, bound, lead in rows if bound is not None and not lead]


def test_it_is_the_latency_where_both_ways_are_alike(problem: Problem) -> None:
    world = World(problem, policy="LOC", delay_ms=WAY_MS, clocks=CLOCKS)
    world.run(6_000)
    # LOC: three messages on one node, or to the next, and the command.
    found = measured(world)[20:]
    assert len(found) > 80
    assert sum(own is not None for own, _ in found) > 0.9 * len(found)
    for own, latency_ns in found:
        if own is not None:
            assert own == pytest.approx(latency_ns, abs=round(2 * WAY_MS * MS))
    constant = {own for own, _ in found if own is not None}
    assert max(constant) - min(constant) < 2 * ROUNDING_NS


def test_a_late_completion_is_part_of_it_and_a_longer_way_is_not(problem: Problem) -> None:
    world = World(problem, policy="LOC", delay_ms=WAY_MS, clocks=CLOCKS)
    # The detour would be shorter.
    world.network.cut(key="dwell/*/relay/done/*")
    longer = NetworkConditions(delay_ns=4 * MS)
    for source, target in (("R1", "R2"), ("R2", "R1")):
        world.network.impair(longer, source, target, key="dwell/*/beat/**")
        world.network.impair(longer, source, target, key="dwell/*/done/*")
    world.run(4_000)
    before = [own for own, _ in measured(world)[40:] if own is not None]
    world.network.impair(NetworkConditions(delay_ns=3 * MS), "R2", "R1", key="dwell/*/done/*")
    world.run(4_000)
    after = [own for own, _ in measured(world)[-40:] if own is not None]
    assert min(after) - max(before) == pytest.approx(3 * MS, abs=2 * ROUNDING_NS)


def test_of_what_came_over_the_detour_nothing_is_said(problem: Problem) -> None:
    world = World(problem, policy="LOC", delay_ms=WAY_MS, clocks=CLOCKS)
    world.network.cut("sink.control@R2", "stamper@R1", key="dwell/*/done/*")
    world.run(4_000)
    found = measured(world)
    assert len(found) > 40
    assert {own for own, _ in found} == {None}
    assert "stamper_interval_ns" in columns_of(world.cell.controller)["cycles"]


# --------------------------------------------------------------------------------- alone


def beat(sent_ns: int, heard_ns: int, beat_ns: int) -> Beat:
    heard = (Heard("stamper@R1", "R1", beat_ns, heard_ns),)
    return Beat("sink.arm@R2", "R2", 1, sent_ns, True, heard)


def done(cycle: int, sink: str = "arm", released_ns: int = 0) -> Completion:
    return Completion(Stamp(1, cycle, 1, "LOC", released_ns), sink, 0, "actuated", (), "R2")


def test_the_best_round_trip_counts_until_it_is_old() -> None:
    intervals = Intervals("R1", lambda _: frozenset({"arm"}))
    assert intervals.return_ns("R2") is None
    # Sent at 0, heard at 100 s of the other clock, answered 10 ms later, here at 16 ms.
    intervals.hear(beat(100 * S + 10 * MS, 100 * S, 0), 16 * MS)
    intervals.hear(beat(100 * S + 50 * MS, 100 * S, 0), 59 * MS)
    assert intervals.return_ns("R2") == 3 * MS
    for later in (SPAN_NS, 2 * SPAN_NS):
        intervals.hear(beat(later + 10 * MS, later, 0), later + 18 * MS)
    assert intervals.return_ns("R2") is not None
    assert intervals.return_ns("R2") != 3 * MS


def test_a_cycle_ends_with_its_last_sink_and_copies_change_nothing() -> None:
    intervals = Intervals("R1", lambda _: frozenset({"arm", "gripper"}))
    intervals.hear(beat(100 * S + 10 * MS, 100 * S, 0), 14 * MS)
    intervals.completed(done(5), 40 * MS, newest=5, direct=True)
    intervals.completed(done(5), 60 * MS, newest=5, direct=False)
    assert intervals.take_unreported() == ()
    intervals.completed(replace(done(5, "gripper"), rested=True), 50 * MS, newest=5, direct=True)
    intervals.completed(done(5, "gripper"), 70 * MS, newest=5, direct=True)
    intervals.completed(done(5, "nobody"), 80 * MS, newest=5, direct=True)
    assert intervals.take_unreported() == ((5, 48 * MS, 1),)
    assert intervals.take_unreported() == ()


def test_cycles_that_never_complete_take_no_memory() -> None:
    intervals = Intervals("R1", lambda _: frozenset({"arm", "gripper"}))
    for cycle in range(10_000):
        intervals.completed(done(cycle), cycle, newest=cycle, direct=True)
    waiting = intervals._waiting
    assert len(waiting) <= 256
    intervals.completed(done(3, "gripper"), 1, newest=10_000, direct=True)  # long ago
    assert 3 not in waiting
