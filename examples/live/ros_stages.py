"""The last stage of ros2.yaml: a turn becomes the Twist that a ROS base takes."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from dwell.live.stage import Message


class Vector(msgspec.Struct):
    """A `geometry_msgs/msg/Vector3`."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Twist(msgspec.Struct):
    """A `geometry_msgs/msg/Twist`, m/s and rad/s."""

    linear: Vector
    angular: Vector


class Steer:
    """The sink task: forward, and towards the light."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the command; positive z turns left. A struct without `inputs` is a dict."""
        rate = min(max(inputs["planning"].payload["rate"], -0.8), 0.8)
        return Message(Twist(Vector(x=0.1), Vector(z=-rate)))
