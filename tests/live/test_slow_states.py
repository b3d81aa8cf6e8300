"""States that take long to write, to send or to read: what they may cost."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from dwell.live.wire import channels
from dwell.model import Problem
from tests.live.memory_transport import NetworkConditions
from tests.live.small_world import MS, Bench, Counting, World, canonical, on, stateful

#: Length of the snapshot, in periods.
LONG = 50


@pytest.fixture(scope="module")
def problem() -> Problem:
    return stateful(canonical(40, fallbacks=("LOC",)), "planning", 100)


def counting(problem: Problem, candidate: str, **more: Any) -> World:
    """Run a cell whose planning counts its cycles for two seconds."""
    world = World(on(problem, candidate), stages={"planning": Counting}, policy=candidate, **more)
    world.run(2_000)
    return world


def slow(world: World, who: str, call: str, ms: float) -> None:
    """Have a call of a worker's stage take long from now on."""
    bench = world.roles[who]
    assert isinstance(bench, Bench)
    bench.chore_ns[call] = round(ms * MS)


def longest_gap(world: World, since: int = 0) -> int:
    """Most consecutive cycles without a command, from a place in the actuator's log on."""
    return max(later - before - 1 for before, later in pairwise(world.cycles[since:]))


def require_whole(world: World) -> None:
    """Hold that the last commands count all cycles: the state behind them lacks none."""
    assert [count - cycle for cycle, count in world.arm.counts[-30:]] == [1] * 30


# --------------------------------------------------------------------------------------- pins


@pytest.mark.parametrize(("here", "there", "who"), [("LOC", "SO", "R2"), ("SO", "LOC", "E")])
def test_a_pin_loses_the_snapshot_and_no_more(
    problem: Problem, here: str, there: str, who: str
) -> None:
    cell = replace(problem, live=replace(problem.live, checkpoint_cycles=0))
    world = counting(cell, here)
    slow(world, f"planning@{who}", "snapshot()", LONG * problem.pipeline.period_ms)
    since = len(world.cycles) - 1
    world.pin(there)
    world.run(10_000)
    status = world.status
    assert (status["placement"], status["fallback"], status["guard_moves"]) == (there, False, 0)
    assert status["moves"]["pinned"] == 1
    assert longest_gap(world, since) <= LONG + problem.controller.guard_cycles + 1
    require_whole(world)


def test_beats_go_on_while_a_snapshot_is_written(problem: Problem) -> None:
    world = counting(problem, "LOC")
    slow(world, "planning@R2", "snapshot()", 5_000)
    world.pin("SO")
    world.run(1_000)
    assert world.worker("planning@R2").busy_since_ns is not None
    detector, now_ns = world.stamper.pulse.detector, world.network.now_ns
    assert detector.fresh("planning@R2", now_ns, 2 * problem.pipeline.period_ns)
    beat = detector.last("planning@R2")
    assert beat is not None
    assert (beat.ready, beat.moving) == (True, True)


def test_a_worker_that_dies_in_its_snapshot_costs_what_it_costs_elsewhere(
    problem: Problem,
) -> None:
    world = counting(problem, "SO")
    slow(world, "planning@E", "snapshot()", 5_000)
    world.pin("LOC")
    world.run(1_000)
    cycle = world.stamper.cycle
    world.kill("planning@E")
    world.run(1_000)
    assert world.stamper.placement == "LOC"
    first = next(one for one in world.cycles if one > cycle)
    assert first - cycle <= problem.controller.guard_cycles + 2


def test_a_snapshot_that_never_returns_is_waited_for_ten_seconds(problem: Problem) -> None:
    world = counting(problem, "SO")
    slow(world, "planning@E", "snapshot()", 600_000)
    world.pin("LOC")
    world.run(9_000)
    assert world.stamper.placement == "SO"
    world.run(3_000)
    assert world.stamper.placement == "LOC"
    assert "planning on E: snapshot() has not returned for 12 s" in world.note("planning@E")
    status = world.status
    # The guard moved the cell; the pin did not.
    assert (status["fallback"], status["moves"]["pinned"]) == (True, 0)
    assert status["refused"] == "the guard moved the cell to LOC before the move to LOC"


@pytest.mark.parametrize("taken", ["state", "restore()"])
def test_patience_follows_the_state(problem: Problem, taken: str) -> None:
    links = {name: replace(link, rate_mbps=8.0) for name, link in problem.fabric.links.items()}
    cell = replace(problem, fabric=replace(problem.fabric, links=links))
    world = counting(stateful(cell, "planning", 4_000_000 if taken == "state" else 100), "LOC")
    if taken == "state":
        late = NetworkConditions(delay_ns=5_000 * MS)
        world.network.impair(late, "planning@R2", "planning@E", key="**/state/**")
    else:
        slow(world, "planning@E", taken, 5_000)
    since = len(world.cycles) - 1
    world.pin("SO")
    world.run(9_000)
    status = world.status
    assert (status["placement"], status["fallback"]) == ("SO", False)
    assert longest_gap(world, since) <= problem.controller.guard_cycles + 1
    require_whole(world)


# -------------------------------------------------------------------------------- checkpoints


def test_a_checkpoint_that_the_guard_would_not_wait_for_is_made_once(problem: Problem) -> None:
    world = counting(on(problem, "SO"), "SO")
    slow(world, "planning@E", "snapshot()", LONG * problem.pipeline.period_ms)
    world.run(20_000)
    assert world.status["placement"] == "SO"
    place, period_ms = len(world.cycles), problem.pipeline.period_ms
    world.run(20_000)
    assert longest_gap(world, place) == 0
    cost_s = LONG * period_ms / 1e3
    assert world.note("planning@E") == (
        f"no checkpoints: planning@E's snapshot() takes {cost_s:.2g} s of a period of "
        f"{period_ms:g} ms"
    )
    # A new process knows it by the state that the old one sent.
    assert not world.note("planning@R2")


def test_checkpoints_take_at_most_a_20th_of_the_time(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, checkpoint_cycles=1))
    world = counting(cell, "SO")
    sent: list[int] = []
    cost_ms = 1.5 * problem.pipeline.period_ms
    slow(world, "planning@E", "snapshot()", cost_ms)
    world.run(1_000)
    state = world.keys.of(channels.STATE, "planning", "R2", "E")
    world.network.taps.append(
        lambda sample: sent.append(world.network.now_ns) if sample.key == state else None
    )
    world.run(20_000)
    assert len(sent) > 3
    assert min(b - a for a, b in pairwise(sent)) >= 20 * cost_ms * MS
