"""Which endpoints are connected, and the lines about all others."""

from __future__ import annotations

from dataclasses import replace

from dwell.live.ros2 import matching
from dwell.live.ros2.rmw_zenoh import NO_HASH, QOS, RosEndpoint, RosNode, Topic

ODOM = Topic("/odom", "nav_msgs/msg/Odometry", "RIHS01_" + "1" * 64)
OURS = RosEndpoint(RosNode(0, "a", 0, "dwell_cell_odom"), 1, "MS", ODOM, QOS["default"])
THEIRS = RosEndpoint(RosNode(0, "b", 0, "base"), 1, "MP", ODOM, QOS["default"])


def test_same_topic_type_and_hash() -> None:
    assert matching.matches(OURS, THEIRS)
    assert not matching.matches(OURS, OURS)
    assert list(matching.faults(OURS, [THEIRS])) == []
    assert list(matching.notes(OURS, [THEIRS])) == []


def test_another_type_has_both_names() -> None:
    other = replace(THEIRS, topic=replace(ODOM, type="geometry_msgs/msg/Pose"))
    assert not matching.matches(OURS, other)
    assert list(matching.faults(OURS, [other])) == [
        "base publishes /odom as geometry_msgs/msg/Pose, and dwell_cell_odom has "
        "nav_msgs/msg/Odometry"
    ]


def test_another_definition_has_both_hashes() -> None:
    other = replace(THEIRS, topic=replace(ODOM, hash="RIHS01_" + "2" * 64))
    (line,) = matching.faults(OURS, [other])
    assert "RIHS01_11111111" in line
    assert "RIHS01_22222222" in line


def test_humble_is_refused_by_name() -> None:
    other = replace(THEIRS, topic=replace(ODOM, hash=NO_HASH))
    (line,) = matching.faults(OURS, [other])
    assert "Humble" in line
    assert NO_HASH in line


def test_qos_that_gives_less_is_one_note_each() -> None:
    late = replace(OURS, qos=QOS["transient_local"])
    lossy = replace(THEIRS, qos=QOS["sensor_data"])
    assert list(matching.notes(late, [lossy])) == [
        "/odom: base is volatile: dwell_cell_odom gets no earlier messages",
        "/odom: base is best-effort: dwell_cell_odom may miss messages",
    ]
    # Seen from the publisher, the lines are the same.
    assert list(matching.notes(lossy, [late])) == list(matching.notes(late, [lossy]))
    assert not list(matching.notes(replace(OURS, qos=QOS["sensor_data"]), [THEIRS]))


def test_two_publishers_of_one_topic() -> None:
    second = replace(THEIRS, node=RosNode(0, "c", 0, "ekf"))
    assert list(matching.notes(OURS, [THEIRS, second])) == ["/odom has 2 publishers: base, ekf"]
    assert list(matching.notes(second, [THEIRS])) == ["/odom has 2 publishers: base, ekf"]
    assert not list(matching.notes(second, [OURS]))
