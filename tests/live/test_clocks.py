from __future__ import annotations

from pathlib import Path

import pytest

import dwell
from dwell.errors import LiveError
from dwell.live.clocks import CLOCKS, ClockFile, wrong_clock
from dwell.live.hosting import Hosted
from dwell.live.sink import Sink
from tests.live.small_world import MS, World

NODES = ("R1", "E")
EXEC_MS = {"sensing": 3.0, "perception": 10.0, "planning": 6.0, "control": 0.5}


class Clock:
    def __init__(self) -> None:
        self.now_ns = 1_000_000_000_000

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def true() -> Clock:
    return Clock()


@pytest.fixture
def file(tmp_path: Path, true: Clock) -> ClockFile:
    return ClockFile(tmp_path / "clocks", NODES, true)


def clock_at(node: str, file: ClockFile, true: Clock) -> Clock:
    return wrong_clock(node, true, {CLOCKS: str(file.path)})  # type: ignore[return-value]


def test_without_the_variable_clocks_are_right(true: Clock) -> None:
    assert wrong_clock("R1", true, {}) is true


def test_jumps_add_up_and_are_of_one_node(file: ClockFile, true: Clock) -> None:
    robot, edge = clock_at("R1", file, true), clock_at("E", file, true)
    assert (robot(), edge()) == (true(), true())
    file.set("E", jump_ns=500)
    assert file.set("E", jump_ns=-2_000) == -1_500
    assert (robot(), edge()) == (true(), true() - 1_500)


def test_a_drift_goes_on_from_where_the_clock_is(file: ClockFile, true: Clock) -> None:
    robot = clock_at("R1", file, true)
    file.set("R1", jump_ns=1_000, drift_ppb=100_000)
    assert robot() == true() + 1_000
    true.now_ns += 10_000_000_000
    assert robot() == true() + 1_000 + 1_000_000
    before_ns = robot()
    file.set("R1")
    assert robot() == before_ns
    true.now_ns += 10_000_000_000
    assert robot() == before_ns + 10_000_000_000


def test_what_is_no_file_of_clocks(file: ClockFile, true: Clock, tmp_path: Path) -> None:
    with pytest.raises(LiveError, match="no node R7"):
        clock_at("R7", file, true)
    with pytest.raises(LiveError, match="no node R7"):
        file.set("R7")
    with pytest.raises(LiveError, match="cannot be read"):
        wrong_clock("R1", true, {CLOCKS: str(tmp_path / "nothing")})
    other = tmp_path / "other"
    other.write_bytes(b"x" * 200)
    with pytest.raises(LiveError, match="no file of clocks"):
        wrong_clock("R1", true, {CLOCKS: str(other)})


HOUR_NS = 3_600_000 * MS


@pytest.fixture
def world() -> World:
    cell = dwell.load("examples/canonical.yaml")
    made = World(cell, exec_ms=EXEC_MS)
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
    world: World, true: Clock
) -> None:
    end = world.network.transport("visitor", "R1")
    hosted = Hosted(world.worker("sensing@R1"), end, true)
    hosted.wake()
    assert hosted.rest_ns() > 0
    true.now_ns -= HOUR_NS
    assert hosted.rest_ns() <= 0
