"""The closed loop in simulated time: it converges, tracks, and suffers from what is late."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dwell.live.stage import Message, load_actuator, load_stage
from dwell.live.wire.payloads import read_payload, write_payload
from examples.visual_servoing.servoing.horizon import HorizonSettings
from examples.visual_servoing.servoing.messages import Plan, Pose
from examples.visual_servoing.servoing.planning import Planning
from examples.visual_servoing.servoing.scene import Scene
from examples.visual_servoing.servoing.world import World
from tests.visual_servoing.loop import Loop, rms

#: A fifth of the usual work, and nearly the same loop.
LIGHT = HorizonSettings(steps=12, decays=(0.0,), weights=(1.0,), common=1)
LOOKS_A_SECOND = 200


@pytest.mark.parametrize("seed", [1, 2])
def test_it_converges_and_tracks(tmp_path: Path, seed: int) -> None:
    loop = Loop(tmp_path, Scene(seed=seed))
    errors = loop.play(range(70))
    assert errors[0] > 100
    assert errors[LOOKS_A_SECOND:].max() < 25
    settled = errors[2 * LOOKS_A_SECOND :]
    # A target of 250 mm/s: it moves 15 mm from a picture to the middle of its command's hold.
    assert rms(settled) < 7
    assert all(plan.tracking for plan in loop.plans)


def late(tmp_path: Path, name: str, by_ms: int, lost: Callable[[int], bool]) -> float:
    folder = tmp_path / name
    folder.mkdir()
    loop = Loop(
        folder,
        perceived_ns=lambda cycle: by_ms * 600_000,
        actuated_ns=lambda cycle: by_ms * 1_000_000,
        lost=lost,
        settings=LIGHT,
    )
    return rms(loop.play(range(60))[LOOKS_A_SECOND:])


def test_what_is_later_tracks_worse(tmp_path: Path) -> None:
    errors = [late(tmp_path, str(ms), ms, lambda cycle: False) for ms in (15, 60, 120)]
    assert errors[1] > 1.3 * errors[0]
    assert errors[2] > 1.5 * errors[1]


def test_what_is_lost_tracks_worse(tmp_path: Path) -> None:
    whole = late(tmp_path, "whole", 15, lambda cycle: False)
    holes = late(tmp_path, "holes", 15, lambda cycle: cycle % 10 >= 4)
    assert holes > 1.5 * whole


def test_a_lost_target_is_waited_for_at_home_and_found_again(tmp_path: Path) -> None:
    scene = Scene()
    loop = Loop(tmp_path, scene, covered=lambda cycle: 30 <= cycle < 80, settings=LIGHT)
    loop.play(range(80))
    assert not loop.plans[-1].tracking
    position, velocity = loop.world.state(loop.now_ns)
    assert position == pytest.approx(scene.home, abs=0.01)
    assert velocity == pytest.approx(np.zeros(4), abs=0.02)
    errors = loop.play(range(80, 125))
    assert loop.plans[-1].tracking
    assert rms(errors[-LOOKS_A_SECOND // 2 :]) < 10


def test_it_is_the_same_each_time(tmp_path: Path) -> None:
    runs = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        runs.append(Loop(tmp_path / name).play(range(8)))
    assert np.array_equal(runs[0], runs[1])


def pose(cycle: int) -> Pose:
    """A tag that moves to the right by 4 mm a cycle, below a camera at home."""
    home = Scene().home
    at = (0.004 * cycle, 0.0, 0.5)
    return Pose(10**9 + cycle * 40_000_000, 0, home, (0, 0, 0, 0), True, 4, at)


def test_a_planner_goes_on_from_the_snapshot_of_another() -> None:
    first, second, fresh = (Planning(settings=LIGHT) for _ in range(3))
    for cycle in range(6):
        first.plan(pose(cycle), 20_000_000)
    second.restore(first.snapshot())
    plans = [planner.plan(pose(6), 20_000_000) for planner in (first, second, fresh)]
    speeds = [np.array(plan.velocities)[-1, 0] for plan in plans]
    assert speeds[1] == pytest.approx(speeds[0], abs=2e-3)
    assert speeds[0] == pytest.approx(0.1, abs=0.03)
    assert speeds[2] < 0.05


def test_a_planner_without_a_tag_stays_at_home() -> None:
    planner = Planning(settings=LIGHT)
    plan: Plan = planner.plan(Pose(10**9, 0, Scene().home, (0, 0, 0, 0)), 20_000_000)
    assert not plan.tracking
    assert np.abs(plan.velocities).max() < 1e-3


def test_a_cell_file_can_name_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DWELL_WORLD", str(tmp_path / "world"))
    message, released_ns = Message(), time.monotonic_ns()
    before = "stamper"
    for task, name in (
        ("sensing", "camera:Sensing"),
        ("perception", "perception:Perception"),
        ("planning", "planning:Planning"),
        ("control", "control:Control"),
    ):
        stage = load_stage(f"examples.visual_servoing.servoing.{name}", task)
        expected = stage.inputs.get(before)
        kind, data = write_payload(message.payload)
        payload = read_payload(kind, bytes(data), expected)
        done = stage.process({before: Message(payload, 1, released_ns)})
        message = Message(done.payload)
        before = task
    load_actuator("examples.visual_servoing.servoing.arm:Arm", "control").apply(message)
    assert World.open(None, 0).newest()[2].actuations == 1
