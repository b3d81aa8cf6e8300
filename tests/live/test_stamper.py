"""The stamper: its beats, and cycles that frames begin."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from dwell.control import Probation
from dwell.live.stamper import Stamper
from dwell.live.transport.transport import Arrival
from dwell.model import Problem
from tests.live.small_world import MS, World, canonical


@pytest.fixture(scope="module")
def problem() -> Problem:
    return canonical(fallbacks=("LOC",))


def test_the_stamper_beats_between_two_releases(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(problem)
    stamper, period_ns = world.stamper, problem.pipeline.period_ms * MS
    beats: list[int] = []
    send = stamper.pulse.send

    def noted(now_ns: int) -> None:
        beats.append(now_ns)
        send(now_ns)

    monkeypatch.setattr(stamper.pulse, "send", noted)
    world.run(3_000)
    assert stamper.cycle > 50
    since = [(at_ns - stamper._next_ns) % period_ns / period_ns for at_ns in beats[10:]]
    assert since == pytest.approx([0.5] * len(since), abs=0.01)
    assert max(b - a for a, b in pairwise(beats)) <= 1.5 * period_ns


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
    key = stamper.place.keys.frame()
    for _ in range(1_000):
        stamper.receive(Arrival(key, b""), world.network.now_ns)
        world.run(period_ms / 100)
    assert 19 <= stamper.cycle <= 20
    assert stamper.skipped == 1_000 - stamper.cycle
