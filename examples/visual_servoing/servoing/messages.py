"""What the stages of the demo hand on to one another, besides pictures.

Nodes have clocks of their own. A picture's instant is therefore given twice: on the camera's clock,
for what is compared with other pictures, and from the release of its cycle, which every node knows
on its own clock.
"""

from __future__ import annotations

import msgspec

from .scene import Axes


class Pose(msgspec.Struct, array_like=True, frozen=True):
    """Where the tag was, seen from the camera, and where the camera was itself.

    Parameters
    ----------
    taken_ns : int
        When the picture was taken, on the camera's clock.
    waited_ns : int
        The same from the release of its cycle.
    camera, camera_velocity : tuple of float
        The arm's axes then, and their rates.
    found : bool
        Whether the tag was in the picture; without it, what follows is 0.
    corners : int
        How many corners were used.
    position : tuple of float
        The tag's middle in the camera's frame.
    turned : tuple of float
        The tag's rotation vector in it.
    """

    taken_ns: int
    waited_ns: int
    camera: Axes
    camera_velocity: Axes
    found: bool = False
    corners: int = 0
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Plan(msgspec.Struct, array_like=True, frozen=True):
    """Velocities of the camera for the near future.

    Parameters
    ----------
    taken_ns, waited_ns : int
        Of the picture behind it; see `Pose`.
    start_ns, step_ns : int
        Velocity k is the one from ``start_ns + k * step_ns`` after the picture was taken, for a
        step.
    velocities : tuple of tuple of float
        Of the arm's axes.
    tracking : bool
        False on the way home, for lack of a tag.
    iterations : int
        Of the solver.
    """

    taken_ns: int
    waited_ns: int
    start_ns: int
    step_ns: int
    velocities: tuple[Axes, ...]
    tracking: bool
    iterations: int


class Command(msgspec.Struct, array_like=True, frozen=True):
    """What the arm does until the next one.

    Parameters
    ----------
    taken_ns : int
        Of the picture behind it; see `Pose`.
    velocity : tuple of float
        Of the arm's axes.
    """

    taken_ns: int
    velocity: Axes
