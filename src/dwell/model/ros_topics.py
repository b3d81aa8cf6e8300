"""ROS 2 topics at the ends of a live cell: a source's frames, and a sink's commands."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from dwell.model.bounds import Bound, Pattern
from dwell.model.declaration import declared, key
from dwell.model.frozen import FrozenDict

_NAME = "[A-Za-z_][A-Za-z0-9_]*"
TOPIC = Pattern(f"/?{_NAME}(/{_NAME})*", "a topic, as /camera/image_raw or camera/image_raw")
TYPE = Pattern(f"{_NAME}/msg/{_NAME}", "a type of messages, as sensor_msgs/msg/Image")
NAMESPACE = Pattern(f"/?({_NAME}(/{_NAME})*)?", "a namespace, as /robot1")
LOCATOR = Pattern("(tcp|tls|quic|udp|ws|unixsock-stream)/.+", "an endpoint, as tcp/localhost:7447")
#: Types with a zero message that stops a robot; a pose or a position of zeros does not.
STOPPING = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")


@declared()
class RosTopic:
    """A ROS 2 topic that a source task reads."""

    topic: str = key("Topic; a relative name gets `namespace`.", TOPIC, tier="first")
    type: str = key("Type of its messages, as sensor_msgs/msg/Image.", TYPE, tier="first")
    qos: Literal["default", "sensor_data", "transient_local"] = key(
        "QoS: reliable (`default`), best-effort (`sensor_data`), or reliable with the last "
        "messages for late subscriptions (`transient_local`).",
        default="default",
        tier="first",
    )
    depth: int | None = key(
        "Messages that ROS keeps for the endpoint.",
        Bound(1, 10_000, whole=True),
        default=None,
        usual="10; 5 with sensor_data, 1 with transient_local",
    )
    namespace: str = key("Namespace of the node and of relative topics.", NAMESPACE, default="")
    domain: int | None = key(
        "Domain.", Bound(0, 232, whole=True), default=None, usual="ROS_DOMAIN_ID, or 0"
    )
    connect: str | None = key(
        "Endpoint of the Zenoh router.",
        LOCATOR,
        default=None,
        usual="that of ZENOH_SESSION_CONFIG_URI, or tcp/localhost:7447",
    )
    mode: Literal["peer", "client"] = key(
        "Whether messages go directly between processes (`peer`), or all through the router "
        "(`client`), as to another computer.",
        default="peer",
    )
    messages: str | None = key(
        "Folder with further types of messages, as .msg and .idl files.", default=None
    )

    @property
    def resolved(self) -> str:
        """Absolute name of the topic."""
        if self.topic.startswith("/"):
            return self.topic
        return "/".join(("", *filter(None, (self.namespace.strip("/"), self.topic))))


@declared()
class RosCommands(RosTopic):
    """A ROS 2 topic on which a sink task's commands are published."""

    zero: Mapping[str, Any] | None = key(
        "Fields of the message that stops the robot; missing fields are zero.",
        default=None,
        usual="the zero message of Twist and TwistStamped; other types have none",
    )
    require_subscriber: bool = key(
        "Whether a command counts as not applied while no subscription matches.", default=True
    )
    stamp_from: str | None = key(
        "Source task whose header.stamp the commands get.",
        default=None,
        usual="the oldest ROS source behind the command",
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "zero", _frozen(self.zero))

    @property
    def stops(self) -> bool:
        """Whether there is a message that stops the robot."""
        return self.zero is not None or self.type in STOPPING


@declared()
class RosActuator:
    """An actuator that publishes the commands of a sink task."""

    ros2: RosCommands = key("The topic of the commands.", tier="first")


def _frozen(value: Any) -> Any:
    """Return plain values with immutable mappings and lists."""
    if isinstance(value, Mapping):
        return FrozenDict({name: _frozen(item) for name, item in value.items()})
    return tuple(_frozen(item) for item in value) if isinstance(value, list | tuple) else value
