"""A node of zenoh-ros2-sdk in a process of its own, another implementation of rmw_zenoh's protocol.

`python -m tests.live.ros2.sdk_node talk PORT TOPIC TYPE RATE_HZ [COUNT]` publishes messages whose
numbers grow; `listen PORT TOPIC TYPE` prints the fields of each message as a line of JSON.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from typing import Any

#: Definitions without further types, so that the SDK clones no repository.
DEFINITIONS = {
    "std_msgs/msg/String": "string data\n",
    "std_msgs/msg/Float64MultiArray": "",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "own_msgs/msg/Wheels": "float64[4] speeds\nuint32 number\n",
}


def talk(port: int, topic: str, kind: str, rate_hz: float, count: int) -> None:
    from zenoh_ros2_sdk import ROS2Publisher

    publisher = ROS2Publisher(topic, kind, DEFINITIONS[kind], router_port=port)
    print("open", flush=True)
    for number in range(count) if count else itertools.count():
        publisher.publish(**_fields(kind, number))
        time.sleep(1 / rate_hz)


def _fields(kind: str, number: int) -> dict[str, Any]:
    if kind == "own_msgs/msg/Wheels":
        import numpy as np

        return {"speeds": np.arange(4.0) + number, "number": number}
    if kind == "geometry_msgs/msg/Vector3":
        return {"x": float(number), "y": 0.5, "z": -1.0}
    return {"data": str(number)}


def listen(port: int, topic: str, kind: str) -> None:
    from zenoh_ros2_sdk import ROS2Subscriber

    def heard(message: Any) -> None:
        names = [name for name in message.__dataclass_fields__ if name[0] != "_"]
        fields = {name: getattr(message, name) for name in names}
        plain = {
            name: getattr(one, "tolist", lambda one=one: one)() for name, one in fields.items()
        }
        print(json.dumps(plain), flush=True)

    ROS2Subscriber(topic, kind, heard, DEFINITIONS[kind], router_port=port)
    print("open", flush=True)
    while True:
        time.sleep(1)


def main() -> None:
    what, port, topic, kind, *more = sys.argv[1:]
    if what == "talk":
        talk(int(port), topic, kind, float(more[0]), int(more[1]) if len(more) > 1 else 0)
    else:
        listen(int(port), topic, kind)


if __name__ == "__main__":
    main()
