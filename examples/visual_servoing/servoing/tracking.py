"""Where the tag will be: a Kalman filter of constant velocity on each axis.

The model is the discrete white-noise acceleration of Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, section 6.3.2, with dt the time between two pictures:

    F = [[1, dt], [0, 1]],  Q = sigma^2 [[dt^4 / 4, dt^3 / 2], [dt^3 / 2, dt^2]]
"""

from __future__ import annotations

import math
from typing import TypeAlias

import msgspec
import numpy as np

from .scene import Array, Axes, axes

#: Of x, y, z and yaw: what the tag's acceleration is like, and what the measurement's noise is.
_ACCELERATION = np.array([0.8, 0.8, 0.4, 4.0])
_NOISE = np.array([0.0004, 0.0004, 0.0015, 0.004])
#: What a velocity is like that nothing is known of.
_SPEED = np.array([0.3, 0.3, 0.1, 1.0])
#: A track that was not updated for so long begins anew.
_FORGOTTEN_S = 1.0

Pairs: TypeAlias = tuple[Axes, Axes, Axes]


class Track(msgspec.Struct, array_like=True, frozen=True):
    """What is known of the tag's motion.

    Parameters
    ----------
    at_ns : int
        When it was seen last, on the camera's clock.
    position, velocity : tuple of float
        x, y, z and yaw in the world.
    variances : three tuples of float
        Of position, of position with velocity, and of velocity.
    """

    at_ns: int
    position: Axes
    velocity: Axes
    variances: Pairs


def predicted(track: Track, at_ns: int | Array) -> Array:
    """Return where the tag is expected at instants, shape (..., 4)."""
    ahead_s = np.asarray(at_ns - track.at_ns, np.float64)[..., None] * 1e-9
    expected: Array = np.array(track.position) + ahead_s * np.array(track.velocity)
    return expected


def updated(track: Track | None, seen: Array, at_ns: int) -> Track:
    """Add a measurement.

    Parameters
    ----------
    track : Track or None
        None, or one too old, begins with the measurement alone.
    seen : float array, shape (4,)
        x, y, z and yaw in the world; yaw may be off by whole turns.
    at_ns : int
        On the camera's clock; a measurement older than the track leaves it as it is.
    """
    if track is not None and at_ns <= track.at_ns:
        return track
    if track is None or (at_ns - track.at_ns) * 1e-9 > _FORGOTTEN_S:
        variances = (axes(_NOISE**2), axes(np.zeros(4)), axes(_SPEED**2))
        return Track(at_ns, axes(seen), axes(np.zeros(4)), variances)
    dt = (at_ns - track.at_ns) * 1e-9
    pp, pv, vv = np.array(track.variances)
    noise = _ACCELERATION**2
    pp = pp + dt * (2 * pv + dt * vv) + noise * dt**4 / 4
    pv = pv + dt * vv + noise * dt**3 / 2
    vv = vv + noise * dt**2
    position = predicted(track, at_ns)
    surprise = seen - position
    surprise[3] = math.remainder(surprise[3], 2 * math.pi)
    spread = pp + _NOISE**2
    gain, gain_velocity = pp / spread, pv / spread
    return Track(
        at_ns,
        axes(position + gain * surprise),
        axes(np.array(track.velocity) + gain_velocity * surprise),
        (axes((1 - gain) * pp), axes((1 - gain) * pv), axes(vv - gain_velocity * pv)),
    )
