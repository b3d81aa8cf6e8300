"""The scene: how the tag moves, what the camera is like, and where the arm ought to be.

The world's z axis points along the camera's view, into the scene; x points right and y down in a
picture taken at yaw 0. The camera hangs in the hand of an arm of four axes, as of a SCARA robot:
x, y, z and yaw about the view. The tag also tilts, which is beyond the arm and only to be seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from typing import TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
#: One value for each of `AXES`: metres and radians, or those a second.
Axes: TypeAlias = tuple[float, float, float, float]
AXES = ("x", "y", "z", "yaw")

# The tag's motion: a large slow sine for each degree of freedom, and seeded smaller, faster ones,
# so that no estimator with a simple model of it is ever quite right.
_AMPLITUDE = np.array([0.060, 0.040, 0.025, 0.06, 0.06, 0.35])
_HERTZ = np.array([0.45, 0.60, 0.25, 0.20, 0.27, 0.30])
_SHARE = np.array([1.0, 0.10, 0.03])
_PITCH = np.array([1.0, 2.3, 5.1])


class Camera(msgspec.Struct, frozen=True):
    """A pinhole camera without distortion; the optical axis goes through the picture's middle.

    Parameters
    ----------
    width, height : int
        Pixels.
    focal_px : float
    """

    width: int = 640
    height: int = 480
    focal_px: float = 600.0

    @property
    def matrix(self) -> Array:
        """K, shape (3, 3); the middle of the first pixel is (0, 0)."""
        middle_x, middle_y = (self.width - 1) / 2, (self.height - 1) / 2
        return np.array([[self.focal_px, 0, middle_x], [0, self.focal_px, middle_y], [0, 0, 1.0]])

    @property
    def slope(self) -> float:
        """Tangent of half the smaller field of view."""
        return min(self.width, self.height) / 2 / self.focal_px


class Limits(msgspec.Struct, frozen=True):
    """What the arm's drives allow, each for x, y, z and yaw.

    Parameters
    ----------
    low, high : tuple of float
        Soft end stops.
    velocity, acceleration : tuple of float
    """

    low: Axes = (-0.25, -0.25, -0.75, -1.6)
    high: Axes = (0.25, 0.25, -0.15, 1.6)
    velocity: Axes = (0.8, 0.8, 0.5, 3.0)
    acceleration: Axes = (6.0, 6.0, 4.0, 25.0)


class Scene(msgspec.Struct, frozen=True):
    """All that the processes of the demo have to agree on.

    Parameters
    ----------
    seed : int
        Of the tag's motion, the table and the picture's noise.
    tag : int
        Number of the tag in the family 36h11.
    tag_m : float
        Edge of its black square.
    distance_m : float
        How far from the tag the camera is to be, straight above it, turned as it is.
    table_m : float
        How far behind the tag's mean height the table is.
    speed : float
        How many times faster than usual the tag moves.
    home : tuple of float
        Where the arm waits for a tag: all of its way is in view from there.
    camera : Camera
    limits : Limits
    """

    seed: int = 1
    tag: int = 7
    tag_m: float = 0.08
    distance_m: float = 0.35
    table_m: float = 0.08
    speed: float = 1.0
    home: Axes = (0.0, 0.0, -0.55, 0.0)
    camera: Camera = Camera()
    limits: Limits = Limits()

    def target(self, at_ns: int) -> Array:
        """Return where the tag is.

        Returns
        -------
        float array, shape (6,)
            x, y, z, and the angles about x, y and z, in that order of turning.
        """
        turns = np.outer(_HERTZ, _PITCH) * (at_ns * 1e-9 * self.speed)
        moved: Array = _AMPLITUDE * (np.sin(2 * math.pi * turns + _phase(self.seed)) @ _SHARE)
        return moved

    def wanted(self, at_ns: int) -> Array:
        """Return where the arm ought to be, shape (4,)."""
        x, y, z, _, _, yaw = self.target(at_ns)
        return np.array([x, y, z - self.distance_m, yaw])

    def errors(self, position: Array, at_ns: int) -> tuple[float, float]:
        """Return how far the arm is from where it ought to be.

        Parameters
        ----------
        position : float array, shape (4,)
            Of the arm.
        at_ns : int

        Returns
        -------
        tuple of float
            In millimetres, x, y and z together; and in pixels, the tag's centre from the middle of
            the picture, at most the picture's diagonal.
        """
        offset = self.target(at_ns)[:3] - position[:3]
        far_px = math.hypot(self.camera.width, self.camera.height)
        lateral = math.hypot(offset[0], offset[1])
        seen = self.camera.focal_px * lateral < far_px * offset[2]
        pixels = self.camera.focal_px * lateral / offset[2] if seen else far_px
        offset[2] -= self.distance_m
        return 1e3 * float(np.linalg.norm(offset)), float(pixels)


@cache
def _phase(seed: int) -> Array:
    return np.random.default_rng((seed, 0)).uniform(0, 2 * math.pi, (6, 3))


def axes(values: Iterable[float]) -> Axes:
    """Return four numbers as plain ones, for messages."""
    x, y, z, yaw = values
    return float(x), float(y), float(z), float(yaw)


def rotation(about_x: float, about_y: float, about_z: float) -> Array:
    """Return the matrix that turns about x, then y, then z, each of them fixed; shape (3, 3)."""
    cx, cy, cz = math.cos(about_x), math.cos(about_y), math.cos(about_z)
    sx, sy, sz = math.sin(about_x), math.sin(about_y), math.sin(about_z)
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )
