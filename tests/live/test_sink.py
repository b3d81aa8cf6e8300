"""Clocks of nodes that are set back while a cell runs."""

from __future__ import annotations

import pytest

import dwell
from dwell.live.hosting import Hosted
from dwell.live.sink import Sink
from tests.live.small_world import MS, World

HOUR_NS = 3_600_000 * MS


@pytest.fixture
def world() -> World:
    cell = dwell.load("examples/canonical.yaml")
    made = World(cell)
    made.run(1_000)
    return made


def test_a_watchdog_whose_clock_is_set_back_does_not_wait_for_it(world: World) -> None:
    sink = world.roles["sink.control@R2"]
    assert isinstance(sink, Sink)
    silences = world.arm.silences
    sink.wake(world.network.now_ns - HOUR_NS)
    assert world.arm.silences == silences + 1


def test_whoever_beats_goes_on_when_its_clock_is_set_back(world: World) -> None:
    pulse = world.stamper.pulse
    now_ns = world.network.now_ns - HOUR_NS
    assert pulse.wake(now_ns) <= now_ns + world.stamper.place.period_ns


def test_a_stamper_whose_clock_is_set_back_releases_cycles(world: World) -> None:
    before = world.stamper.cycle
    world.stamper.wake(world.network.now_ns - HOUR_NS)
    assert world.stamper.cycle == before + 1


def test_nobody_sleeps_until_a_clock_that_was_set_back_is_where_it_was(
    world: World,
) -> None:
    now_ns = world.network.now_ns
    end = world.network.transport("visitor", "R1")
    hosted = Hosted(world.worker("sensing@R1"), end, lambda: now_ns)
    hosted.wake()
    assert hosted.rest_ns() > 0
    now_ns -= HOUR_NS
    assert hosted.rest_ns() <= 0
