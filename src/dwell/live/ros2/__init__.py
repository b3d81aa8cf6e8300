"""ROS 2 topics as ends of a cell, over Zenoh as rmw_zenoh speaks it; no ROS is installed.

`Source` is a stage whose frames are the messages of a topic, `Sink` an actuator that publishes
commands. `decode` and `encode` convert CDR bytes. They need the extra `ros2`, from `start()` on.
"""

from __future__ import annotations

from dwell.live.ros2.message_types import decode, encode
from dwell.live.ros2.topic_sink import Sink
from dwell.live.ros2.topic_source import Source

__all__ = ["Sink", "Source", "decode", "encode"]
