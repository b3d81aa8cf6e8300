"""The sink: actuators that raise, its watchdog, and clocks that are set back while a cell runs."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

import dwell
from dwell.live.host.hosting import Hosted
from dwell.live.roles.sink import Sink
from dwell.live.stage import Message
from dwell.live.wire import channels
from dwell.live.wire.messages import Beat, Header, Stamp, decode
from dwell.live.wire.transport import Arrival
from tests.live.rated_cells import SLOW, sampling, world_of
from tests.live.small_world import MS, Arm, World, canonical, columns

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


def test_an_actuator_gets_the_cycles_from_which_a_command_descends(
    monkeypatch: pytest.MonkeyPatch, world: World
) -> None:
    sampled, commands, plain = world_of(sampling()), list[Message](), list[Message]()
    monkeypatch.setattr(sampled.arms["act"], "apply", commands.append)
    monkeypatch.setattr(world.arm, "apply", plain.append)
    sampled.run(1_000)
    world.run(1_000)
    steady = commands[3 * SLOW :]
    assert len(steady) > 70
    for command in steady:
        picture = (command.cycle - 1) // SLOW * SLOW
        assert command.origins == {"camera": picture, "imu": command.cycle}
    # Without sampled flows and chains messages have no origins.
    assert {len(command.origins) for command in plain} == {0}


class Refusing(Arm):
    """An actuator that raises while it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.refuses = ""

    def apply(self, command: Message) -> None:
        if self.refuses == "apply":
            raise OSError("the bus is off")
        super().apply(command)

    def hold(self) -> None:
        super().hold()
        if self.refuses == "hold":
            raise OSError("the bus is off")


@pytest.fixture
def arm() -> Refusing:
    return Refusing()


@pytest.fixture
def refused(arm: Refusing) -> World:
    cell = canonical(20, fallbacks=("LOC", "HYB", "SO"), estimator="profile")
    made = World(replace(cell, live=replace(cell.live, max_age_ms=200)), policy="LOC")
    made.sink.actuator = arm
    made.run(3_000)
    return made


def test_a_command_that_the_actuator_refuses_is_not_applied(refused: World, arm: Refusing) -> None:
    arm.refuses = "apply"
    refused.run(1_000)
    assert "apply() raised OSError: the bus is off" in refused.note("sink.control@R2")
    arm.refuses = ""
    refused.run(2_000)
    cycles = columns(refused, "cycles", "outcome", "missed", "actuated")
    told = [place for place, (outcome, *_) in enumerate(cycles) if outcome == "not_applied"]
    assert len(told) == 1_000 // refused.problem.pipeline.period_ms
    assert told == list(range(told[0], told[-1] + 1))
    assert all(cycles[place][1:] == (True, False) for place in told)
    # Every placement ends there: neither the guard nor the policy has a reason to move.
    rates = columns(refused, "windows", "violation_rate", "seen_violation_rate")
    # 29 cycles in a row make up most of some window of 20.
    assert max(rate for rate, _ in rates) > 0.7
    assert max(seen for _, seen in rates) == 0.0
    assert not refused.stamper.moves


def test_an_actuator_that_refuses_commands_is_told_to_hold(refused: World, arm: Refusing) -> None:
    before = arm.silences
    arm.refuses = "apply"
    refused.run(150)
    assert arm.silences == before
    refused.run(300)
    assert arm.silences > before


def test_a_hold_that_raises_is_repeated_until_the_next_command(
    refused: World, arm: Refusing
) -> None:
    before = arm.silences
    arm.refuses = "hold"
    cut = refused.network.cut("*", "sink.control@R2", key="**/sink/**")
    refused.run(1_300)
    assert arm.silences - before in (5, 6)
    assert refused.sink.counts["silences"] == 1
    assert "hold() raised OSError: the bus is off" in refused.note("sink.control@R2")
    refused.network.heal(cut)
    refused.run(1_000)
    assert arm.silences - before in (5, 6)


def test_a_hold_that_has_been_heard_is_not_repeated(refused: World, arm: Refusing) -> None:
    arm.refuses = "hold"
    cut = refused.network.cut("*", "sink.control@R2", key="**/sink/**")
    refused.run(500)
    arm.refuses = ""
    refused.run(300)
    told = arm.silences
    refused.run(1_000)
    assert arm.silences == told
    refused.network.heal(cut)


class Hanging(Arm):
    """An actuator; while it is called, time passes, and another thread looks after its sink."""

    def __init__(self, world: World, passes_ms: float) -> None:
        super().__init__()
        self.world, self.passes_ms = world, passes_ms
        self.calls = {"apply": 0, "hold": 0}

    def apply(self, command: Message) -> None:
        self._pass("apply")

    def hold(self) -> None:
        self._pass("hold")

    def _pass(self, method: str) -> None:
        self.calls[method] += 1
        self.world.sink.watch(self.world.network.now_ns + round(self.passes_ms * MS))


@pytest.mark.parametrize("method", ["apply", "hold"])
@pytest.mark.parametrize("passes_ms", [0, 500, 6_000])
def test_a_sink_beats_while_its_actuator_does_not_return(
    refused: World, method: str, passes_ms: float
) -> None:
    beats: list[Beat] = []

    def hear(sample: Arrival) -> None:
        if sample.key == refused.keys.of(channels.BEAT, "R2", "sink.control@R2"):
            beats.append(decode(sample.payload, Beat))

    refused.sink.actuator = arm = Hanging(refused, passes_ms)
    if method == "hold":
        refused.network.cut("*", "sink.control@R2", key="**/sink/**")
    refused.network.taps.append(hear)
    while not arm.calls[method]:
        refused.run(1)
    late = [beat for beat in beats if beat.sent_ns > refused.network.now_ns]
    told = [(beat.ready, re.sub(r"cycle \d+: ", "", beat.note)) for beat in late]
    hangs = f"sink of control on R2: {method}() has not returned for 6 s"
    assert told == {0: [], 500: [(True, "")], 6_000: [(False, hangs)]}[round(passes_ms)]


def test_the_highest_cycle_is_remembered_before_the_actuator_is_called(world: World) -> None:
    remembered: list[tuple[int, int]] = []

    class Looking(Arm):
        def apply(self, command: Message) -> None:
            super().apply(command)
            remembered.append((command.cycle, memory.load()[1]))

    (memory,) = world.highest.values()
    world.sink.actuator = Looking()
    world.run(500)
    assert len(remembered) > 5
    assert all(cycle == highest for cycle, highest in remembered)


def test_a_command_is_as_old_as_the_clocks_bound_allows() -> None:
    cell = canonical()
    world = World(replace(cell, live=replace(cell.live, clock="system")))
    world.run(500)
    sink = world.sink
    now_ns = world.network.now_ns
    stamp = Stamp(world.stamper.run, world.stamper.cycle, 1, "LOC", now_ns - 5 * MS)
    # Clocks that are kept synchronous by others are so to 1 ms.
    assert sink.age_ns(Header(stamp, "control", "R2", "none"), now_ns) == 6 * MS


def test_a_command_that_comes_twice_is_applied_once(world: World) -> None:
    sink, samples = world.sink, list[Arrival]()
    receive = sink.receive

    def twice(sample: Arrival, now_ns: int) -> None:
        receive(sample, now_ns)
        samples.append(sample)
        receive(sample, now_ns)

    sink.receive = twice  # type: ignore[method-assign]
    world.run(500)
    assert len(samples) > 5
    assert len(world.cycles) == len(set(world.cycles))


def test_the_actuator_is_told_what_the_cell_says_about_silence() -> None:
    class Told(Arm):
        zeros = 0

        def zero(self) -> None:
            self.zeros += 1

    cell = canonical()
    for silence in ("hold", "zero"):
        made = World(replace(cell, live=replace(cell.live, silence=silence)))
        arm = made.sink.actuator = Told()
        made.run(1_000)
        made.kill("control@R2")
        made.run(1_000)
        assert (arm.silences, arm.zeros) == ((1, 0) if silence == "hold" else (0, 1))
