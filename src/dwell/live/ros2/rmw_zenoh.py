"""Names and bytes of rmw_zenoh: keys of topics, liveliness tokens, QoS, attachments.

As in ROS 2 Jazzy and later (docs/howto/ros2.md). Nothing here does I/O.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal, TypeAlias

from dwell.errors import LiveError
from dwell.live.stage import StagePlace

ADMIN = "@ros2_lv"
#: Hash in the keys of ROS 2 Humble, which has no hashes of types.
NO_HASH = "TypeHashNotSupported"
#: Depth that rmw_zenoh takes where a token names none.
DEFAULT_DEPTH = 42
#: Kinds of endpoints of a topic: its publishers and subscriptions.
PUBLISHER, SUBSCRIPTION = "MP", "MS"
KINDS = ("NN", PUBLISHER, SUBSCRIPTION, "SS", "SC")
#: Parts of the token of a node, and the fewest parts of the token of an endpoint.
NODE_PARTS, ENDPOINT_PARTS = 9, 13
#: Fewest parts of a QoS chunk.
QOS_PARTS = 6

Profile: TypeAlias = Literal["default", "sensor_data", "transient_local"]

_ATTACHMENT = struct.Struct("<qqB16s")
_GID_BYTES = 16


@dataclass(frozen=True, slots=True)
class TopicQos:
    """QoS of an endpoint; of a topic without deadline, lifespan and lease."""

    reliable: bool = True
    transient_local: bool = False
    depth: int = 10

    def chunk(self) -> str:
        """Return its chunk of a token; a field that is ROS's default is empty."""
        reliability = "" if self.reliable else "2"
        durability = "1" if self.transient_local else ""
        return f"{reliability}:{durability}:,{self.depth}:,:,:,,"

    @classmethod
    def read(cls, chunk: str) -> TopicQos:
        """Read a chunk; raise a ValueError if it is none."""
        parts = chunk.split(":")
        if len(parts) < QOS_PARTS:
            raise ValueError(f"a QoS of {len(parts)} parts; {QOS_PARTS} are needed")
        reliability, durability, history = parts[:3]
        kind, comma, depth = history.partition(",")
        if not comma or not {reliability, durability, kind} <= {"", "0", "1", "2", "3"}:
            raise ValueError(f"unknown QoS {chunk!r}")
        return cls(reliability != "2", durability == "1", int(depth or DEFAULT_DEPTH))


QOS: dict[Profile, TopicQos] = {
    "default": TopicQos(),
    "sensor_data": TopicQos(reliable=False, depth=5),
    "transient_local": TopicQos(transient_local=True, depth=1),
}


@dataclass(frozen=True, slots=True)
class RosNode:
    """A node in the graph of ROS, by the session that declares it."""

    domain: int
    zid: str
    number: int
    name: str
    namespace: str = ""

    def token(self) -> str:
        """Return the key of its liveliness token."""
        return self.part("NN", self.number)

    def part(self, kind: str, number: int) -> str:
        """Return the key of a token up to the name of the node."""
        return (
            f"{ADMIN}/{self.domain}/{self.zid}/{self.number}/{number}/{kind}/%/"
            f"{_mangled(self.namespace)}/{_mangled(self.name)}"
        )


@dataclass(frozen=True, slots=True)
class Topic:
    """Name, type and hash of a topic; only equal topics are connected."""

    name: str
    type: str
    hash: str

    def key(self, domain: int) -> str:
        """Return the key of its messages."""
        return f"{domain}/{self.name.strip('/')}/{dds_name(self.type)}/{self.hash}"


@dataclass(frozen=True, slots=True)
class RosEndpoint:
    """A publisher or subscription of a topic."""

    node: RosNode
    number: int
    kind: str
    topic: Topic
    qos: TopicQos

    def token(self) -> str:
        """Return the key of its liveliness token."""
        topic = self.topic
        return (
            f"{self.node.part(self.kind, self.number)}/{_mangled(topic.name)}/"
            f"{dds_name(topic.type)}/{topic.hash}/{self.qos.chunk()}"
        )


def read_token(key: str) -> RosNode | RosEndpoint:
    """Read a liveliness token; raise a ValueError if it is none of a node or an endpoint."""
    parts = key.split("/")
    if len(parts) < NODE_PARTS or parts[0] != ADMIN or parts[5] not in KINDS:
        raise ValueError("no token of a node or an endpoint")
    node = RosNode(int(parts[1]), parts[2], int(parts[3]), _plain(parts[8]), _plain(parts[7]))
    if parts[5] == "NN":
        return node
    if len(parts) < ENDPOINT_PARTS:
        raise ValueError(f"an endpoint of {len(parts)} parts; {ENDPOINT_PARTS} are needed")
    topic = Topic(_plain(parts[9]), ros_name(parts[10]), parts[11])
    if not re.fullmatch(rf"RIHS01_[0-9a-f]{{64}}|{NO_HASH}|EMPTY_TOPIC_HASH", topic.hash):
        raise ValueError(f"no hash of a type: {topic.hash[:80]!r}")
    return RosEndpoint(node, int(parts[4]), parts[5], topic, TopicQos.read(parts[12]))


def _mangled(name: str) -> str:
    """Return a name as one chunk of a key."""
    return name.replace("/", "%") or "%"


def _plain(chunk: str) -> str:
    return "" if chunk == "%" else chunk.replace("%", "/")


def dds_name(ros_type: str) -> str:
    """Return ``sensor_msgs::msg::dds_::Image_`` for ``sensor_msgs/msg/Image``."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def ros_name(dds_type: str) -> str:
    """Return the name of a type in ROS; a text that is no DDS name stays as it is."""
    found = re.fullmatch(r"(\w+)::(\w+)::dds_::(\w+)_", dds_type)
    return "/".join(found.groups()) if found else _plain(dds_type)


def node_name(place: StagePlace) -> str:
    """Return the name of a process as a ROS node; each character that ROS forbids becomes ``_``."""
    number = str(place.index) if place.index else ""
    words = "_".join(filter(None, ("dwell", place.cell, place.task, number)))
    return re.sub(r"_+", "_", re.sub(r"[^0-9A-Za-z]", "_", words)).strip("_")


def gid(token: str) -> bytes:
    """Return the id of the endpoint of a token: its XXH3-128, the low 64 bits first."""
    import xxhash

    # The digest is big-endian: high, then low.
    return xxhash.xxh3_128_digest(token.encode())[::-1]


@dataclass(frozen=True, slots=True)
class Attachment:
    """What rmw_zenoh sends with each message; `sent_ns` is the time of day of its publisher."""

    sequence: int
    sent_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """Return its bytes."""
        return _ATTACHMENT.pack(self.sequence, self.sent_ns, _GID_BYTES, self.gid)

    @classmethod
    def read(cls, data: bytes) -> Attachment:
        """Read an attachment; raise a LiveError if the bytes are none."""
        if len(data) != _ATTACHMENT.size or data[16] != _GID_BYTES:
            raise LiveError(
                f"an attachment of {len(data)} bytes is none of rmw_zenoh, which has "
                f"{_ATTACHMENT.size}: does another program publish here, or ROS 2 before Jazzy?"
            )
        sequence, sent_ns, _, gid_bytes = _ATTACHMENT.unpack(data)
        return cls(sequence, sent_ns, gid_bytes)
