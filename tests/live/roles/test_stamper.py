"""The stamper: beats of others, and cycles that frames begin."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dwell.control import Probation
from dwell.live.roles.stamper import Stamper
from dwell.live.wire import channels
from dwell.live.wire.continuity import CLAIMED_RUN_LIMIT, CLAIMS
from dwell.live.wire.messages import Beat, encode
from dwell.live.wire.transport import Arrival
from dwell.model import Problem
from dwell.model.document import digests
from tests.live.small_world import MS, World, canonical


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC",))


def test_both_copies_of_a_completion_are_one_cycle(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(problem)
    world.run(1_000)
    completed: list[int] = []
    monkeypatch.setattr(Probation, "healthy", lambda _, cycles=1: completed.append(cycles))
    before = world.stamper.cycle
    world.run(2_000)
    assert world.stamper.cycle - before == pytest.approx(sum(completed), abs=1)


def test_a_beat_says_how_long_ago_its_sender_has_heard_others(problem: Problem) -> None:
    world = World(problem)
    world.run(1_000)
    presence = world.stamper.guard.presence
    assert not presence.missing("SO", world.network.now_ns)
    world.network.cut("R1", "E")
    world.run(500)
    # E is heard, and tells of the last that it has heard of R1.
    assert presence.missing("SO", world.network.now_ns) == {"R1->E"}


def test_a_flood_of_frames_makes_two_cycles_a_period(problem: Problem) -> None:
    cell = replace(problem, live=replace(problem.live, release="frames"))
    world = World(cell)
    world.run(500)
    stamper = world.stamper
    assert isinstance(stamper, Stamper)
    assert stamper.cycle == 0
    period_ms = problem.pipeline.period_ms
    key = stamper.place.keys.of(channels.FRAME)
    for _ in range(1_000):
        stamper.receive(Arrival(key, b""), world.network.now_ns)
        world.run(period_ms / 100)
    assert 19 <= stamper.cycle <= 20


# ------------------------------------------------------------------ a book that is gone or old

#: Run of a stamper whose clock was set, and of one whose clock was not.
TODAY, UNSET = 1_700_000_000_000_000_000, 5_000_000_000
STAMPER, SINK = "stamper@R1", "sink.control@R2"


def restarted(problem: Problem, *, run: int, boot: str, book: bool) -> World:
    """Run a cell, and start its stamper again with its book or without, by another clock."""
    world = World(problem)
    world.run_id, world.boot = TODAY, "before"
    world.kill(STAMPER)
    world.book.entry = None
    world.start(STAMPER)
    world.run(1_000)
    assert world.stamper.run == TODAY
    world.kill(STAMPER)
    if not book:
        world.book.entry = None
    world.run_id, world.boot = run, boot
    world.run(100)
    return world


def commands_after(world: World, ms: float) -> int:
    """Let time pass; returns how many commands the actuator has got meanwhile."""
    before = len(world.arm.applied)
    world.run(ms)
    return len(world.arm.applied) - before


def test_a_stamper_without_book_and_clock_begins_a_run_beyond_the_sinks(problem: Problem) -> None:
    world = restarted(problem, run=UNSET, boot="after", book=False)
    world.start(STAMPER)
    assert commands_after(world, 1_000) > 10
    assert world.stamper.run == TODAY + 1


def test_a_run_that_is_heard_of_later_is_passed_then(problem: Problem) -> None:
    world = restarted(problem, run=UNSET, boot="after", book=False)
    world.network.freeze(SINK)
    world.start(STAMPER)
    # It does not wait for a sink for ever.
    world.run(11_000)
    assert (world.stamper.run, world.stamper.cycle > 5) == (UNSET, True)
    cycle = world.stamper.cycle
    world.network.thaw(SINK)
    assert commands_after(world, 1_000) > 10
    assert world.stamper.run == TODAY + 1
    assert world.stamper.cycle > cycle


def test_a_book_of_another_boot_is_not_trusted_for_its_numbers(problem: Problem) -> None:
    world = restarted(problem, run=UNSET, boot="after", book=True)
    assert world.book.entry is not None
    world.book.entry = replace(world.book.entry, reserved=1, term=1)
    world.start(STAMPER)
    assert commands_after(world, 1_000) > 10
    assert world.stamper.run == TODAY + 1


def test_a_book_of_this_boot_goes_on(problem: Problem) -> None:
    world = restarted(problem, run=UNSET, boot="before", book=True)
    world.start(STAMPER)
    assert commands_after(world, 1_000) > 10
    assert world.stamper.run == TODAY


def claim(world: World, run: int, times: int) -> None:
    """Have somebody say in a sink's beats that it let a run through."""
    digest = digests(world.problem)["wiring"]
    for number in range(times):
        # Later than all that the sink says itself for a while.
        sent_ns = world.network.now_ns + (number + 1) * MS
        beat = Beat(SINK, "R2", 10**9, sent_ns, True, cell=digest, run=run)
        key = world.keys.of(channels.BEAT, "R2", SINK)
        world.stamper.receive(Arrival(key, encode(beat)), world.network.now_ns)


@pytest.mark.parametrize(
    ("book", "run", "times", "believed"),
    [
        (False, TODAY + 9, CLAIMS, True),
        (False, TODAY + 9, CLAIMS - 1, False),
        (False, CLAIMED_RUN_LIMIT - 1, CLAIMS, True),
        (False, CLAIMED_RUN_LIMIT, 2 * CLAIMS, False),
        (True, TODAY + 9, 2 * CLAIMS, False),
    ],
)
def test_no_single_or_absurd_claim_moves_the_run(
    problem: Problem, book: bool, run: int, times: int, believed: bool
) -> None:
    boot = "before" if book else "after"
    world = restarted(problem, run=TODAY + 5, boot=boot, book=book)
    world.start(STAMPER)
    world.run(1_000)
    before = TODAY if book else TODAY + 5
    assert world.stamper.run == before
    claim(world, run, times)
    assert world.stamper.run == (run + 1 if believed else before)
    assert commands_after(world, 4_000) > 10
