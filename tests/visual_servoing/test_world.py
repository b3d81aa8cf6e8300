"""The closed form of the arm's motion, and the file that carries it between processes."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dwell.errors import LiveError
from examples.visual_servoing.servoing.scene import Limits, Scene, axes
from examples.visual_servoing.servoing.world import Motion, World, Worth

SCENE = Scene()
LIMITS = SCENE.limits
velocities = st.tuples(*(st.floats(-most, most) for most in LIMITS.velocity))
STILL = (0.0, 0.0, 0.0, 0.0)


@given(velocities, velocities, st.integers(0, 400), st.integers(0, 400))
def test_the_closed_form_is_the_integral(
    velocity: tuple[float, float, float, float],
    command: tuple[float, float, float, float],
    for_ms: int,
    expires_ms: int,
) -> None:
    free = Limits(low=(-9, -9, -9, -9), high=(9, 9, 9, 9))
    motion = Motion(5, (0.1, 0.2, -0.5, 0.3), velocity, command, 5 + expires_ms * 1_000_000)
    p, v, most = np.array(motion.position), np.array(velocity), 1e-3 * np.array(free.acceleration)
    for step in range(for_ms):
        goal = np.array(command if step < expires_ms else STILL)
        after = v + np.clip(goal - v, -most, most)
        p, v = p + 1e-3 * (v + after) / 2, after
    position, speed = motion.state(5 + for_ms * 1_000_000, free)
    assert position == pytest.approx(p, abs=5e-5)
    assert speed == pytest.approx(v, abs=1e-6)


def test_an_axis_stands_at_its_end_stop() -> None:
    motion = Motion(0, (0.2, 0, -0.5, 0), (0.5, 0, 0, 0), (0.5, 0.1, 0, 0))
    position, velocity = motion.state(1_000_000_000, LIMITS)
    assert position[0] == LIMITS.high[0]
    assert velocity[0] == 0
    assert velocity[1] == pytest.approx(0.1)


def test_before_it_began_a_motion_has_not_moved() -> None:
    position, _ = Motion(1000, (0, 0, -0.5, 0), (0.5, 0, 0, 0), STILL).state(0, LIMITS)
    assert position.tolist() == [0, 0, -0.5, 0]


def test_the_error_is_0_where_the_arm_ought_to_be_and_in_pixels_beside_it() -> None:
    there = SCENE.wanted(123)
    assert SCENE.errors(there, 123) == pytest.approx((0, 0), abs=1e-9)
    millimetres, pixels = SCENE.errors(there + np.array([0.007, 0, 0, 0.5]), 123)
    assert millimetres == pytest.approx(7)
    assert pixels == pytest.approx(600 * 0.007 / 0.35)
    assert SCENE.errors(there + np.array([0, 0, 0.5, 0]), 123)[1] == 800


def test_a_file_is_made_once_and_keeps_its_scene(tmp_path: Path) -> None:
    path = tmp_path / "world"
    first = World.create(path, Scene(seed=5), 10)
    first.write(Motion(20, (0.1, 0, -0.5, 0), STILL), Worth())
    second = World.create(path, Scene(seed=6), 30)
    assert second.scene == Scene(seed=5)
    assert second.newest()[0] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["world"]


def test_the_environment_names_the_usual_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DWELL_WORLD", str(tmp_path / "there"))
    assert World.open(None, 0).path == tmp_path / "there"
    assert World.open(None, 0).scene == Scene()


@pytest.mark.parametrize(
    "text", [b"", b"something else" * 2000, b"dwell-world-1\n{}}" + b"\0" * 30000]
)
def test_another_file_is_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "world").write_bytes(text)
    with pytest.raises(LiveError, match="world"):
        World(tmp_path / "world")


def test_the_past_is_seen_as_it_was(tmp_path: Path) -> None:
    world = World.create(tmp_path / "world", SCENE, 0)
    for k in range(1, 100):
        world.write(Motion(k * 10, (k * 1e-3, 0, -0.5, 0), STILL), Worth(k))
    assert world.state(995)[0][0] == pytest.approx(0.099)
    assert world.state(505)[0][0] == pytest.approx(0.050)
    assert [number for number, _, _ in world.records()] == list(range(99, 35, -1))
    # Further back than the ring reaches: the oldest there is.
    assert world.state(0)[0][0] == pytest.approx(0.036)


def test_a_torn_record_is_no_record(tmp_path: Path) -> None:
    world = World.create(tmp_path / "world", SCENE, 0)
    for k in range(1, 4):
        world.write(Motion(k, (k * 1e-3, 0, -0.5, 0), STILL), Worth(k))
    newest = world.newest()
    data = bytearray(world.path.read_bytes())
    torn = data.index(np.array(0.003).tobytes())
    data[torn : torn + 8] = np.array(0.004).tobytes()
    world.path.write_bytes(data)
    torn_world = World(world.path)
    assert torn_world.newest()[0] == newest[0] - 1
    for start in range(2048, len(data)):
        data[start] = 255
    world.path.write_bytes(data)
    with pytest.raises(LiveError, match="no whole record"):
        World(world.path).newest()


def write_without_end(path: Path) -> None:
    world = World(path)
    k = 0
    while True:
        k += 1
        world.write(Motion(k, axes([k] * 4), axes([k] * 4), axes([k] * 4), k), Worth(k, k, k, k))


def test_no_reader_sees_half_a_write(tmp_path: Path) -> None:
    path = tmp_path / "world"
    world = World.create(path, SCENE, 0)
    writer = multiprocessing.get_context("spawn").Process(target=write_without_end, args=(path,))
    writer.start()
    try:
        seen: set[int] = set()
        while len(seen) < 200:
            number, motion, worth = world.newest()
            if not number:
                time.sleep(0.001)
                continue
            seen.add(number)
            same = axes([number] * 4)
            assert motion == Motion(number, same, same, same, number)
            assert worth == Worth(number, number, number, number)
    finally:
        writer.kill()
        writer.join()
    # Killed at any point, it leaves a world that can be read and written.
    before = world.newest()[0]
    world.write(Motion(1, STILL, STILL), Worth())
    assert world.newest()[0] == before + 1


def test_worths_differ_by_what_came_between() -> None:
    early = Worth().then(1, 100.0, 100.0)
    late = early.then(2, 3.0, 6.0).then(3, 4.0, 8.0)
    assert late.rms_since(early) == pytest.approx((np.sqrt(12.5), np.sqrt(50.0)))
    assert np.isnan(early.rms_since(early)).all()
