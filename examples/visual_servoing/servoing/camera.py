"""Sensing: what the camera in the arm's hand sees, drawn by warping two planes into the picture.

The table and the tag are planes, so each is seen through a homography. Where the plane's points are
``R (u, v, 0) + t`` in the camera's frame, with r1 and r2 the columns of R,

    H = K [r1 r2 t]

takes (u, v) to the picture (Hartley and Zisserman, Multiple View Geometry, 2nd ed., section 8.1.1).
Light falls off to one side, and noise is added.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from dwell.errors import LiveError
from dwell.live.stage import Message

from .messages import Pose
from .scene import Array, Scene, axes, rotation
from .world import World

#: Pixels of 8 bits: height x width, or a row of a JPEG's bytes.
Picture: TypeAlias = NDArray[np.uint8]

# The end of a picture says when and from where it was taken, as the embedded data of image sensors
# do: instants, position and velocity of the arm. A JPEG's reader ignores what follows its end.
_MARK = struct.Struct("<8s2q8d")
_MAGIC = b"dwell-im"
# Pixels of a drawn plane by metre, and by cell of the tag; the family 36h11 has 8 cells an edge,
# and needs a white one around them.
_TABLE_PPM, _TABLE_M = 1000, 1.0
_CELL_PX, _CELLS, _QUIET = 16, 8, 1
_NOISE_PX = 64


class Renderer:
    """Draws the scene as it is seen from the arm.

    Parameters
    ----------
    scene : Scene
    noise : float
        Standard deviation of a pixel, grey levels.
    clutter : int
        Dark patches on the table.
    """

    def __init__(self, scene: Scene, *, noise: float = 3.0, clutter: int = 60) -> None:
        self.scene = scene
        camera = scene.camera
        random = np.random.default_rng((scene.seed, 1))
        self._size = (camera.width, camera.height)
        self._table = _table(random, clutter)
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        tag = cv2.aruco.generateImageMarker(family, scene.tag, _CELLS * _CELL_PX)
        self._tag = np.pad(np.asarray(tag, np.uint8), _QUIET * _CELL_PX, constant_values=230)
        across = np.linspace(1.0, 0.7, camera.width)[None, :]
        down = np.linspace(1.0, 0.85, camera.height)[:, None]
        self._light = (255 * across * down).astype(np.uint8)
        shape = (camera.height + _NOISE_PX, camera.width + _NOISE_PX)
        self._noise = np.clip(random.normal(128, noise, shape), 0, 255).astype(np.uint8)

    def draw(self, arm: Array, at_ns: int) -> Picture:
        """Return the picture, shape (height, width).

        Parameters
        ----------
        arm : float array, shape (4,)
            Position of the arm.
        at_ns : int
            The tag's place and the noise follow from it.
        """
        camera = rotation(0, 0, arm[3]).T
        target = self.scene.target(at_ns)
        table = np.array([0, 0, self.scene.table_m])
        picture: Picture = np.full(self._size[::-1], 90, np.uint8)
        self._paint(picture, self._table, _TABLE_PPM, camera, camera @ (table - arm[:3]))
        turned = camera @ rotation(*target[3:])
        cell_m = self.scene.tag_m / _CELLS
        self._paint(picture, self._tag, _CELL_PX / cell_m, turned, camera @ (target[:3] - arm[:3]))
        cv2.multiply(picture, self._light, dst=picture, scale=1 / 255)
        # One sheet of noise, shifted: drawing a new one took longer than everything else here.
        right, down = np.random.default_rng((self.scene.seed, at_ns)).integers(_NOISE_PX, size=2)
        noise = self._noise[down : down + self._size[1], right : right + self._size[0]]
        cv2.addWeighted(picture, 1.0, noise, 1.0, -128.0, dst=picture)
        return picture

    def _paint(
        self, picture: Picture, plane: Picture, pixels_per_m: float, turned: Array, at: Array
    ) -> None:
        """Warp a plane, drawn around its middle, into the picture."""
        normal = turned[:, 2]
        if at[2] <= 0 or normal @ at <= 0:
            return  # behind the camera, or seen from its back
        middle = (np.array(plane.shape[::-1]) - 1) / 2
        metric = np.diag([1 / pixels_per_m, 1 / pixels_per_m, 1.0])
        metric[:2, 2] = -middle / pixels_per_m
        seen = self.scene.camera.matrix @ np.column_stack([turned[:, :2], at]) @ metric
        cv2.warpPerspective(
            plane,
            seen,
            self._size,
            dst=picture,
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_TRANSPARENT,
        )


def _table(random: np.random.Generator, clutter: int) -> Picture:
    """Draw the table: a grain, and dark patches that a detector has to look at."""
    side = int(_TABLE_M * _TABLE_PPM)
    grain = random.normal(150, 12, (side // 8, side // 8)).astype(np.float32)
    smooth = np.asarray(cv2.resize(grain, (side, side), interpolation=cv2.INTER_LINEAR))
    table = np.clip(smooth, 0, 255).astype(np.uint8)
    for _ in range(clutter):
        middle, size = random.uniform(0, side, 2), random.uniform(15, 60, 2)
        box = (middle.tolist(), size.tolist(), float(random.uniform(0, 90)))
        corners = np.asarray(cv2.boxPoints(box)).astype(np.int32)
        cv2.fillConvexPoly(table, corners, int(random.integers(20, 90)))
    return table


def write_mark(data: Picture, pose: Pose) -> None:
    """Write into the last bytes of a picture when and from where it was taken."""
    mark = _MARK.pack(_MAGIC, pose.taken_ns, pose.waited_ns, *pose.camera, *pose.camera_velocity)
    data.reshape(-1)[-_MARK.size :] = np.frombuffer(mark, np.uint8)


def read_mark(data: Picture) -> Pose:
    """Return when and from where a picture was taken, the tag not found yet.

    Raises
    ------
    LiveError
        If it does not say.
    """
    last = data.reshape(-1)[-_MARK.size :].tobytes()
    if len(last) < _MARK.size or not last.startswith(_MAGIC):
        raise LiveError("a picture that does not say when and from where it was taken")
    _, taken_ns, waited_ns, *values = _MARK.unpack(last)
    if not all(math.isfinite(value) for value in values):
        raise LiveError("a picture taken from nowhere: a place that is not a number")
    return Pose(taken_ns, waited_ns, axes(values[:4]), axes(values[4:]))


class Sensing:
    """Takes a picture a cycle: the payload is an array of 8-bit pixels, or of a JPEG's bytes.

    Parameters
    ----------
    world : Path, optional
        Where the arm's motion is read; see `World.open`.
    jpeg : int, optional
        Quality in percent; raw pixels where None.
    threads : int
        Of OpenCV.
    clock : callable
        The machine's monotonic clock, ns.
    """

    def __init__(
        self,
        world: Path | None = None,
        *,
        jpeg: int | None = None,
        threads: int = 1,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        cv2.setNumThreads(threads)
        self.world = World.open(world, clock())
        self.renderer = Renderer(self.world.scene)
        self._jpeg = jpeg
        self._clock = clock

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Take the picture of a cycle, now."""
        (stamp,) = inputs.values()
        now_ns = self._clock()
        position, velocity = self.world.state(now_ns)
        picture = self.renderer.draw(position, now_ns)
        if self._jpeg is not None:
            _, packed = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg])
            picture = np.append(np.asarray(packed, np.uint8), np.zeros(_MARK.size, np.uint8))
        waited_ns = now_ns - stamp.released_ns
        write_mark(picture, Pose(now_ns, waited_ns, axes(position), axes(velocity)))
        return Message(picture)

    def stop(self) -> None:
        """Let go of the world."""
        self.world.close()
