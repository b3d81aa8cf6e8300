"""Planning: where the tag will be, and the camera's best way there.

The picture is old when its pose arrives, and older when the plan takes effect. The tag is therefore
predicted to that instant, and so is the camera, by the plan it is following meanwhile; the plan
begins there. Without a tag for a while, the way leads home, where all of its motion is in view.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import ClassVar

import cv2
import msgspec
import numpy as np

from dwell.live.stage import Message

from .control import velocities
from .horizon import Horizon, HorizonSettings
from .messages import Plan, Pose
from .scene import Array, Scene, axes, rotation
from .tracking import Track, predicted, updated

# A plan that old says nothing any more of what the arm does now.
_FOLLOWED_STEPS = 3


def in_world(pose: Pose) -> Array:
    """Return the tag's x, y, z and yaw in the world, shape (4,)."""
    camera = rotation(0, 0, pose.camera[3])
    turned = camera @ np.asarray(cv2.Rodrigues(np.array(pose.turned))[0])
    yaw = np.arctan2(turned[1, 0], turned[0, 0])
    return np.array([*(pose.camera[:3] + camera @ pose.position), yaw])


class _State(msgspec.Struct, array_like=True):
    """What a planner remembers."""

    track: Track | None = None
    plan: Plan | None = None


class Planning:
    """Plans the camera's motion from the tag's poses.

    Parameters
    ----------
    scene : Scene
    settings : HorizonSettings
    lead_s : float
        From the start of a job to when its plan is expected to take effect.
    lost_s : float
        Without a tag for so long, the camera goes home.
    clock : callable
        This node's monotonic clock, ns.
    """

    inputs: ClassVar[Mapping[str, type[msgspec.Struct]]] = {"perception": Pose}

    def __init__(
        self,
        scene: Scene | None = None,
        settings: HorizonSettings | None = None,
        *,
        lead_s: float = 0.008,
        lost_s: float = 0.4,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.scene = scene or Scene()
        self.horizon = Horizon(self.scene, settings)
        self._lead_ns = round(lead_s * 1e9)
        self._lost_ns = round(lost_s * 1e9)
        self._clock = clock
        self._state = _State()

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Plan from the pose of a cycle."""
        (message,) = inputs.values()
        pose: Pose = message.payload
        since_ns = max(0, self._clock() - message.released_ns - pose.waited_ns)
        return Message(self.plan(pose, since_ns + self._lead_ns))

    def plan(self, pose: Pose, start_ns: int) -> Plan:
        """Plan from a pose.

        Parameters
        ----------
        pose : Pose
        start_ns : int
            From the picture to when the plan is to begin.
        """
        state, limits = self._state, self.scene.limits
        if pose.found:
            state.track = updated(state.track, in_world(pose), pose.taken_ns)
        begin_ns = pose.taken_ns + start_ns
        position, velocity = self._camera(pose, start_ns)
        track = state.track
        tracking = track is not None and pose.taken_ns - track.at_ns <= self._lost_ns
        target, speed = np.array(self.scene.home), np.zeros(4)
        if track is not None and tracking:
            target = predicted(track, begin_ns) - [0, 0, self.scene.distance_m, 0]
            speed = np.array(track.velocity)
        motions = self.horizon.solve(position, velocity, target, speed)
        planned = np.clip(motions.velocities[0], -np.array(limits.velocity), limits.velocity)
        step_ns = round(self.horizon.settings.step_s * 1e9)
        way = tuple(map(axes, planned))
        state.plan = Plan(
            pose.taken_ns, pose.waited_ns, start_ns, step_ns, way, tracking, motions.iterations
        )
        return state.plan

    def _camera(self, pose: Pose, start_ns: int) -> tuple[Array, Array]:
        """Return where the camera will be when the plan begins, and how fast."""
        position, velocity = np.array(pose.camera), np.array(pose.camera_velocity)
        plan = self._state.plan
        samples = (np.arange(16) + 0.5) / 16 * start_ns
        moving = np.tile(velocity, (16, 1))
        if plan is not None and 0 < pose.taken_ns - plan.taken_ns < _FOLLOWED_STEPS * plan.step_ns:
            earlier_ns = pose.taken_ns - plan.taken_ns
            moving = velocities(plan, samples + earlier_ns)
            velocity = velocities(plan, np.array([earlier_ns + start_ns - 1]))[0]
        most = np.array(self.scene.limits.velocity)
        return position + moving.mean(axis=0) * start_ns * 1e-9, np.clip(velocity, -most, most)

    def snapshot(self) -> bytes:
        """Write the track and the last plan."""
        return msgspec.msgpack.encode(self._state)

    def restore(self, state: bytes) -> None:
        """Take over the track and the last plan of another planner."""
        self._state = msgspec.msgpack.decode(state, type=_State)
