"""The renderer against detection and `solvePnP`, there and back."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dwell.errors import LiveError
from dwell.live.stage import Message
from examples.visual_servoing.servoing.camera import Renderer, Sensing, read_mark, write_mark
from examples.visual_servoing.servoing.messages import Pose
from examples.visual_servoing.servoing.perception import Perception
from examples.visual_servoing.servoing.scene import Scene, rotation
from examples.visual_servoing.servoing.world import World

SCENE = Scene()
MARK = Pose(5, 3, (0.1, 0.2, -0.5, 0.3), (0.0, 0.1, 0.2, 0.3))


def seen(scene: Scene, arm: NDArray[np.float64], at_ns: int) -> tuple[Pose, NDArray[np.float64]]:
    """Return what perception says of a picture, and the truth: rotation beside position."""
    picture = Renderer(scene).draw(arm, at_ns)
    write_mark(picture, MARK)
    target, camera = scene.target(at_ns), rotation(0, 0, arm[3]).T
    at = camera @ (target[:3] - arm[:3])
    return Perception(scene).locate(picture), np.column_stack([camera @ rotation(*target[3:]), at])


@pytest.mark.parametrize("seed", range(6))
def test_a_pose_comes_back_from_its_picture(seed: int) -> None:
    random = np.random.default_rng(seed)
    at_ns = int(random.integers(1, 10**15))
    scene = Scene(seed=seed)
    off = random.uniform([-0.04, -0.02, -0.1, -0.8], [0.04, 0.02, 0.02, 0.8])
    pose, truth = seen(scene, scene.wanted(at_ns) + off, at_ns)
    assert pose.found
    assert pose.corners == 4
    # Sideways to half a millimetre, in depth to 1 %, turned to a degree and tilted to some.
    assert np.abs(truth[:2, 3] - pose.position[:2]).max() < 5e-4
    assert pose.position[2] == pytest.approx(truth[2, 3], rel=0.01)
    turned = np.asarray(cv2.Rodrigues(np.array(pose.turned))[0])
    yaw, true_yaw = (np.arctan2(matrix[1, 0], matrix[0, 0]) for matrix in (turned, truth))
    assert np.degrees(yaw - true_yaw) == pytest.approx(0, abs=1)
    cosine = (np.trace(turned.T @ truth[:, :3]) - 1) / 2
    assert np.degrees(np.arccos(min(1.0, cosine))) < 10


def test_a_tag_out_of_view_is_not_found_and_the_place_is_still_told() -> None:
    pose, _ = seen(SCENE, SCENE.wanted(9) + np.array([0.5, 0, 0, 0]), 9)
    assert pose == MARK


def test_nothing_is_drawn_of_what_is_behind_the_camera() -> None:
    pose, _ = seen(SCENE, SCENE.wanted(9) + np.array([0, 0, 1.0, 0]), 9)
    assert not pose.found


def test_pictures_follow_from_seed_and_instant() -> None:
    arm = SCENE.wanted(77)
    first = Renderer(SCENE).draw(arm, 77)
    renderer = Renderer(SCENE)
    later = renderer.draw(arm, 40_000_077)
    assert np.array_equal(renderer.draw(arm, 77), first)
    assert not np.array_equal(later, first)
    assert not np.array_equal(Renderer(Scene(seed=2)).draw(arm, 77), first)


@pytest.mark.parametrize("jpeg", [None, 80])
def test_sensing_sends_the_picture_and_when_it_was_taken(tmp_path: Path, jpeg: int | None) -> None:
    World.create(tmp_path / "world", SCENE, 0).close()
    sensing = Sensing(tmp_path / "world", jpeg=jpeg, clock=lambda: 1_000_500)
    picture = sensing.process({"stamper": Message(None, 3, 1_000_000)}).payload
    assert picture.dtype == np.uint8
    assert picture.nbytes == 307_200 if jpeg is None else picture.nbytes < 60_000
    picture.setflags(write=False)
    pose = Perception(SCENE).process({"sensing": Message(picture)}).payload
    assert (pose.taken_ns, pose.waited_ns, pose.camera) == (1_000_500, 500, SCENE.home)
    assert pose.found
    sensing.stop()


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (b"\0" * 307_200, "8-bit pixels"),
        (np.zeros((480, 640)), "8-bit pixels"),
        (np.zeros((480, 640), np.uint8), "does not say when"),
        (np.zeros(3, np.uint8), "does not say when"),
    ],
)
def test_what_is_no_picture_is_refused(payload: object, said: str) -> None:
    with pytest.raises(LiveError, match=said):
        Perception(SCENE).locate(payload)


@pytest.mark.parametrize("shape", [(4, 100), (400,)])
def test_a_mark_does_not_make_a_picture(shape: tuple[int, ...]) -> None:
    picture = np.zeros(shape, np.uint8)
    write_mark(picture, MARK)
    assert read_mark(picture) == MARK
    with pytest.raises(LiveError, match="640 x 480"):
        Perception(SCENE).locate(picture)
