"""The keys of ROS 2 topics in a cell file, and their faults."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import yaml

from dwell.cellfile import from_document
from dwell.errors import ProblemError
from dwell.model import Problem
from dwell.model.document import digests, to_document
from dwell.model.ros_topics import RosActuator
from dwell.sim import simulate

CELL: dict[str, Any] = yaml.safe_load("""
dwell: 1
name: hall
period_ms: 33
nodes: {R: {tier: robot}, E: {tier: edge}}
links: [{from: R, to: E, both_ways: true, delay_ms: 1}]
tasks:
  camera:
    "on": {R: {exec_ms: 1}}
    ros2: {topic: /camera/image_raw, type: sensor_msgs/msg/Image, qos: sensor_data}
  odometry:
    "on": {R: {exec_ms: 1}}
    ros2: {topic: odom, type: nav_msgs/msg/Odometry, namespace: /robot}
  perception: {"on": {R: {exec_ms: 5}, E: {exec_ms: 2}}, run: "stages:perceive"}
  control: {"on": {R: {exec_ms: 1}}, run: "stages:Control"}
flows:
  - {from: camera, to: perception, bytes: 921600}
  - {from: odometry, to: perception, bytes: 800}
  - {from: perception, to: control, bytes: 60}
candidates: {LOC: {perception: R}, SO: {perception: E}}
live:
  silence: zero
  actuators:
    control: {ros2: {topic: /cmd_vel, type: geometry_msgs/msg/Twist, stamp_from: camera}}
""")


def cell(path: str = "", value: object = None) -> Problem:
    document = copy.deepcopy(CELL)
    part: Any = document
    *steps, last = path.split(".") if path else [""]
    for step in steps:
        part = part[step]
    if last:
        part[last] = value
    return from_document(document)


def test_a_cell_with_topics_is_itself_again() -> None:
    problem = cell()
    actuator = problem.live.actuators["control"]
    assert isinstance(actuator, RosActuator)
    assert actuator.ros2.topic == "/cmd_vel"
    odometry = problem.pipeline.tasks["odometry"].ros2
    assert odometry is not None
    assert odometry.resolved == "/robot/odom"
    assert from_document(to_document(problem)) == problem


def test_zero_message_is_kept() -> None:
    path = "live.actuators.control.ros2.zero"
    zero = {"angular": {"z": 0.5}, "joints": [1, {"x": 2.0}]}
    problem = cell(path, zero)
    assert to_document(problem)["live"]["actuators"]["control"]["ros2"]["zero"] == zero
    assert from_document(to_document(problem)) == problem
    hash(problem.live.actuators)


def test_topics_are_code_that_may_differ_between_nodes() -> None:
    one = digests(cell())
    for path in ("tasks.camera.ros2.topic", "live.actuators.control.ros2.topic"):
        other = digests(cell(path, "/other"))
        assert [part for part in one if one[part] != other[part]] == ["code"]


def test_the_simulator_plays_it_as_without_topics() -> None:
    plain = copy.deepcopy(CELL)
    for task in ("camera", "odometry"):
        del plain["tasks"][task]["ros2"]
    plain["live"]["actuators"] = {}
    runs = [simulate(one, seed=1, windows=3) for one in (cell(), from_document(plain))]
    assert runs[0].cycles.equals(runs[1].cycles)


TWIST = "geometry_msgs/msg/TwistStamped"
TRAJECTORY = {"topic": "/arm", "type": "trajectory_msgs/msg/JointTrajectory"}
FAULTS: dict[str, tuple[str, object, str, str]] = {
    "run, too": ("tasks.camera.run", "stages:Camera", "tasks.camera.run", "next to `ros2`"),
    "on two nodes": (
        "tasks.camera.on",
        {"R": {"exec_ms": 1}, "E": {"exec_ms": 1}},
        "tasks.camera.ros2",
        "camera can run on R and E; a task at a ROS 2 topic runs on one node",
    ),
    "with inputs": (
        "tasks.perception",
        {"on": {"R": {"exec_ms": 1}}, "ros2": {"topic": "/a", "type": "a/msg/B"}},
        "tasks.perception.ros2",
        "perception has inputs; only a source reads a topic",
    ),
    "topic read twice": (
        "tasks.odometry.ros2",
        CELL["tasks"]["camera"]["ros2"],
        "tasks.odometry.ros2.topic",
        "/camera/image_raw is read by camera, too",
    ),
    "topic": ("tasks.camera.ros2.topic", "/camera//x", "tasks.camera.ros2.topic", "a topic, as /"),
    "type": ("tasks.camera.ros2.type", "Image", "tasks.camera.ros2.type", "a type of messages"),
    "qos": ("tasks.camera.ros2.qos", "best", "tasks.camera.ros2.qos", "one of"),
    "unknown key": ("tasks.camera.ros2.topics", "/a", "tasks.camera.ros2.topics", "unknown key"),
    "sink on two nodes": (
        "tasks.control.on",
        {"R": {"exec_ms": 1}, "E": {"exec_ms": 1}},
        "live.actuators.control.ros2",
        "control can run on R and E, and each would publish",
    ),
    "no zero message": (
        "live.actuators.control.ros2",
        TRAJECTORY,
        "live.actuators.control.ros2.zero",
        "missing, with live.silence zero: trajectory_msgs/msg/JointTrajectory",
    ),
    "zero is a number": (
        "live.actuators.control.ros2.zero",
        0.0,
        "live.actuators.control.ros2.zero",
        "a mapping of the message's fields",
    ),
    "stamp of no source": (
        "live.actuators.control.ros2.stamp_from",
        "perception",
        "live.actuators.control.ros2.stamp_from",
        "unknown task with `ros2` 'perception'",
    ),
    "neither name nor topic": ("live.actuators.control", 5, "live.actuators.control", "a text"),
    "another mapping": (
        "live.actuators.control",
        {"ros": {}},
        "live.actuators.control.ros",
        "did you mean 'ros2'?",
    ),
}


@pytest.mark.parametrize(("path", "value", "where", "message"), FAULTS.values(), ids=FAULTS.keys())
def test_faulty_topics(path: str, value: object, where: str, message: str) -> None:
    with pytest.raises(ProblemError) as caught:
        cell(path, value)
    found = {fault.path: fault.message for fault in caught.value.faults}
    assert message in found.get(where, ""), found


def test_a_pose_of_zeros_may_be_what_stops() -> None:
    assert cell("live.actuators.control.ros2", {**TRAJECTORY, "zero": {}})
    assert cell("live.actuators.control.ros2", {"topic": "/cmd", "type": TWIST})
