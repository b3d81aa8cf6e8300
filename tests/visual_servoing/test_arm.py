"""The arm's commands, its watchdog's words, and what it refuses; and control before it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from dwell.errors import LiveError
from dwell.live.stage import Message
from dwell.live.wire.payloads import read_payload, write_payload
from examples.visual_servoing.servoing.arm import Arm
from examples.visual_servoing.servoing.control import Control, velocities
from examples.visual_servoing.servoing.messages import Command, Plan
from examples.visual_servoing.servoing.scene import Scene
from examples.visual_servoing.servoing.world import World

SECOND_NS = 1_000_000_000
RIGHT = Message(Command(7, (0.1, 0.0, 0.0, 0.0)))


class Bench:
    """An arm whose clock a test sets."""

    def __init__(self, path: Path) -> None:
        self.now_ns = 0
        self.path = path
        self.world = World.create(path, Scene(), 0)
        self.arm = self.started()

    def started(self) -> Arm:
        return Arm(self.path, clock=lambda: self.now_ns)

    def velocity(self) -> float:
        return float(self.world.state(self.now_ns)[1][0])


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "world")


def test_a_command_holds_until_the_next(bench: Bench) -> None:
    bench.arm.apply(RIGHT)
    bench.now_ns = SECOND_NS // 2
    ramp_s = 0.1 / 6.0
    at = bench.world.state(bench.now_ns)[0][0]
    assert at == pytest.approx(0.1 * (0.5 - ramp_s) + 0.1 * ramp_s / 2)
    bench.arm.apply(Message(Command(8, (-0.1, 0.0, 0.0, 0.0))))
    assert bench.world.state(bench.now_ns)[0][0] == pytest.approx(at)
    assert bench.world.newest()[2].actuations == 2
    assert bench.world.newest()[2].taken_ns == 8


def test_without_a_word_the_drives_stop_by_themselves(bench: Bench) -> None:
    bench.arm.apply(RIGHT)
    bench.now_ns = SECOND_NS - 1
    assert bench.velocity() == pytest.approx(0.1)
    bench.now_ns = SECOND_NS + 100_000_000
    assert bench.velocity() == 0


def test_hold_goes_on_and_zero_stops(bench: Bench) -> None:
    bench.arm.apply(RIGHT)
    bench.now_ns = SECOND_NS * 9 // 10
    bench.arm.hold()
    bench.now_ns = SECOND_NS * 3 // 2
    assert bench.velocity() == pytest.approx(0.1)
    bench.arm.zero()
    bench.now_ns += 100_000_000
    assert bench.velocity() == 0
    # What a watchdog does is no actuation.
    assert bench.world.newest()[2].actuations == 1


def test_commands_are_limited_to_what_the_drives_can(bench: Bench) -> None:
    bench.arm.apply(Message(Command(1, (50.0, -50.0, 0.0, 0.0))))
    assert bench.world.newest()[1].command == (0.8, -0.8, 0.0, 0.0)


def test_a_restarted_arm_goes_on_where_it_was(bench: Bench) -> None:
    bench.arm.apply(RIGHT)
    bench.now_ns = SECOND_NS // 2
    before = bench.world.state(bench.now_ns)[0]
    bench.started().hold()
    assert bench.world.state(bench.now_ns)[0] == pytest.approx(before)
    assert bench.velocity() == pytest.approx(0.1)


def test_a_command_may_arrive_as_plain_values(bench: Bench) -> None:
    kind, data = write_payload(RIGHT.payload)
    bench.arm.apply(Message(read_payload(kind, bytes(data))))
    assert bench.world.newest()[1].command == (0.1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "payload",
    [None, b"x", [1], [1, [0.0, 0.0]], Command(1, (math.nan, 0, 0, 0)), [1, [math.inf, 0, 0, 0]]],
)
def test_what_is_no_velocity_is_refused_and_changes_nothing(bench: Bench, payload: object) -> None:
    bench.arm.apply(RIGHT)
    before = bench.world.newest()
    with pytest.raises(LiveError, match="for the arm"):
        bench.arm.apply(Message(payload))
    assert bench.world.newest() == before


PLAN = Plan(
    taken_ns=10**15,
    waited_ns=2_000_000,
    start_ns=20_000_000,
    step_ns=40_000_000,
    velocities=((0.0, 0.4, 0.0, 0.0), (0.4, 0.0, 0.0, 0.0), (0.8, 0.0, 0.0, 0.0)),
    tracking=True,
    iterations=1,
)


def test_a_plan_holds_each_velocity_for_a_step_and_nothing_after() -> None:
    since_ns = np.array([0, 20, 59, 60, 99, 100, 139, 140]) * 10**6
    found = velocities(PLAN, since_ns)[:, 0]
    assert found == pytest.approx([0, 0, 0, 0.4, 0.4, 0.8, 0.8, 0])


def test_control_knows_the_age_of_the_picture_by_its_own_clock() -> None:
    released_ns = 5_000_000_000
    control = Control(clock=lambda: released_ns + 42_000_000)
    command = control.process({"planning": Message(PLAN, 4, released_ns)}).payload
    # 40 ms after the picture: half of the next 40 ms is the first velocity's, half the second's.
    assert command.velocity == pytest.approx((0.2, 0.2, 0, 0))
    assert command.taken_ns == PLAN.taken_ns
