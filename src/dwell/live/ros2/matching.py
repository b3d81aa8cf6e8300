"""Which endpoints of a topic are connected, and why others are not."""

from __future__ import annotations

from collections.abc import Collection, Iterator

from dwell.live.ros2.rmw_zenoh import NO_HASH, PUBLISHER, RosEndpoint


def matches(own: RosEndpoint, other: RosEndpoint) -> bool:
    """Whether messages go from one endpoint to the other."""
    return own.kind != other.kind and own.topic == other.topic


def faults(own: RosEndpoint, others: Collection[RosEndpoint]) -> Iterator[str]:
    """Yield the endpoints of the topic that cannot be connected to ours, with both names."""
    for other in others:
        if other.kind == own.kind or other.topic == own.topic:
            continue
        does = "publishes" if other.kind == PUBLISHER else "reads"
        if other.topic.hash == NO_HASH:
            yield (
                f"{other.node.name} {does} {other.topic.name} by ROS 2 Humble ({NO_HASH}), which "
                "is not supported: use Jazzy or later"
            )
        elif other.topic.type != own.topic.type:
            yield (
                f"{other.node.name} {does} {other.topic.name} as {other.topic.type}, and "
                f"{own.node.name} has {own.topic.type}"
            )
        else:
            yield (
                f"{other.node.name} {does} {other.topic.name} with another definition of "
                f"{own.topic.type}: {other.topic.hash[:15]}…, and {own.node.name} has "
                f"{own.topic.hash[:15]}…; name the folder of its .msg file as `messages`"
            )


def notes(own: RosEndpoint, others: Collection[RosEndpoint]) -> Iterator[str]:
    """Yield the QoS of connected endpoints that give less than required, and rivals."""
    for other in others:
        if not matches(own, other):
            continue
        publisher, reader = (own, other) if own.kind == PUBLISHER else (other, own)
        who = f"{publisher.topic.name}: {publisher.node.name}"
        if reader.qos.transient_local and not publisher.qos.transient_local:
            yield f"{who} is volatile: {reader.node.name} gets no earlier messages"
        if reader.qos.reliable and not publisher.qos.reliable:
            yield f"{who} is best-effort: {reader.node.name} may miss messages"
    publishers = [one.node.name for one in others if one.kind == PUBLISHER]
    if own.kind == PUBLISHER:
        publishers = [own.node.name, *publishers] if publishers else []
    if len(publishers) > 1:
        yield f"{own.topic.name} has {len(publishers)} publishers: {', '.join(sorted(publishers))}"
