"""Observers of cells with several rates, whose messages come from a cell in memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import pytest

from dwell.dash.observer import ObservedCycle, Observer
from dwell.live.host.security import Security
from dwell.live.wire.transport import Arrival, Lane, Receive
from dwell.model import Problem
from tests.live.memory_transport import matcher
from tests.live.rated_cells import SLOW, rated, sampling
from tests.live.small_world import Staying, World, columns


class Listener:
    """A visitor's transport that receives all messages of a cell, and sends none."""

    def __init__(self, world: World) -> None:
        self._receivers: list[tuple[Callable[[str], bool], Receive]] = []
        world.network.taps.append(self._hear)

    def _hear(self, sample: Arrival) -> None:
        for matches, receive in self._receivers:
            if matches(sample.key):
                receive(sample)

    def put(self, key: str, payload: bytes, header: bytes = b"", *, lane: Lane = "control") -> None:
        """Send nothing."""

    def subscribe(self, key: str, receive: Receive) -> None:
        """Have `receive` called with the messages under a key expression."""
        self._receivers.append((matcher(key), receive))

    def close(self) -> None:
        """Receive nothing more."""
        self._receivers.clear()


Watched: TypeAlias = tuple[World, list[ObservedCycle], Mapping[str, int]]
Watching: TypeAlias = Callable[[Problem], Watched]


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watching:
    """Return what runs a cell for two seconds, and returns it and what an observer has seen."""

    def watched(problem: Problem) -> Watched:
        exec_ms = dict.fromkeys(problem.pipeline.tasks, 1.0) | {"detect": 7.0}
        world = World(problem, exec_ms=exec_ms, policy=Staying())

        def visit(*_: Any) -> Listener:
            return Listener(world)

        monkeypatch.setattr(Security, "visit", visit)
        with Observer(world.problem) as observer:
            world.run(2_000)
            return world, list(observer.cycles.since(0).items), observer.now().cycles

    return watched


def test_idle_cycles_are_neither_lost_nor_missed(watch: Watching) -> None:
    _, cycles, counts = watch(rated(idle=True))
    assert {one.outcome for one in cycles if one.number % SLOW} == {"idle"}
    due = [one for one in cycles if not one.number % SLOW]
    assert {one.outcome for one in due} == {"actuated"}
    assert len(due) > 30
    assert all(one.known and not one.missed for one in cycles)
    assert counts["idle"] > 120


def test_an_observer_sees_the_jobs_that_no_sink_waits_for(watch: Watching) -> None:
    _, cycles, _ = watch(sampling())
    pictures = [one for one in cycles if not one.number % SLOW]
    assert len(pictures) > 30
    tasks = [{job["task"] for job in one.jobs} for one in pictures]
    assert {"camera", "detect", "imu", "control", "act"} <= set.intersection(*tasks)


def test_cycles_with_old_data_are_missed_as_in_the_record(watch: Watching) -> None:
    chains = {"see-act": {"from": "camera", "to": "act", "max_age_ms": 50}}
    world, cycles, _ = watch(sampling(chains=chains))
    recorded = dict(columns(world, "cycles", "number", "missed"))
    seen = {one.number: one.missed for one in cycles if one.number in recorded}
    assert len(seen) > 150
    assert seen == {number: recorded[number] for number in seen}
    assert 0 < sum(seen.values()) < len(seen)
