"""A cell of real processes between a ROS camera and a ROS base."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zenoh

import dwell
from dwell import ros2
from dwell.live.ros2.message_types import message_types
from dwell.live.ros2.rmw_zenoh import QOS, Attachment, RosEndpoint, RosNode, Topic, gid
from dwell.model.document import to_document
from tests.cli.live_cell import EXAMPLE, RealCell, in_window
from tests.live.ros2.ros_network import RosNetwork, kill, ros_network

IMAGE, TWIST = "sensor_msgs/msg/Image", "geometry_msgs/msg/TwistStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


class RosRobot:
    """A camera that publishes numbered images, and a base that keeps its commands."""

    def __init__(self, network: RosNetwork) -> None:
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps([network.router]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.commands: list[Any] = []
        self.diagnostics: list[Any] = []
        self._stopped = threading.Event()
        self.number = 0
        self._kept = [
            self._endpoint("MP", 1, "/camera/image_raw", IMAGE),
            self._endpoint("MS", 2, "/cmd_vel", TWIST),
            self._endpoint("MS", 3, "/diagnostics", DIAGNOSTICS),
        ]
        self._keep("/cmd_vel", TWIST, self.commands)
        self._keep("/diagnostics", DIAGNOSTICS, self.diagnostics)
        self.takes = threading.Event()
        self.takes.set()
        self._thread = threading.Thread(target=self._film, daemon=True)
        self._thread.start()

    def _topic(self, name: str, kind: str) -> Topic:
        return Topic(name, kind, message_types().hash(kind))

    def _endpoint(self, kind: str, number: int, name: str, message: str) -> Any:
        node = RosNode(0, str(self.session.zid()), 0, "robot")
        token = RosEndpoint(node, number, kind, self._topic(name, message), QOS["default"]).token()
        if kind == "MP":
            self.gid = gid(token)
        return self.session.liveliness().declare_token(token)

    def _keep(self, name: str, kind: str, kept: list[Any]) -> None:
        def take(sample: Any) -> None:
            kept.append(ros2.decode(sample.payload.to_bytes(), kind))

        key = self._topic(name, kind).key(0)
        self._kept.append(self.session.declare_subscriber(key, take))

    def _film(self) -> None:
        publisher = self.session.declare_publisher(self._topic("/camera/image_raw", IMAGE).key(0))
        pixels = np.zeros((120, 160), np.uint8)
        while not self._stopped.wait(0.05):
            if not self.takes.is_set():
                continue
            self.number += 1
            pixels[:] = 0
            pixels[60, 150] = 255
            fields = {"height": 120, "width": 160, "encoding": "mono8", "step": 160}
            stamp = {"stamp": {"sec": self.number, "nanosec": 7}}
            data = ros2.encode({"header": stamp, **fields, "data": pixels.ravel()}, IMAGE)
            about = Attachment(self.number, time.time_ns(), self.gid)
            publisher.put(data, attachment=about.pack())

    def close(self) -> None:
        self._stopped.set()
        self._thread.join()
        self.session.close()


@contextmanager
def real_cell(
    folder: Path, network: RosNetwork, *, every: int = 1, **controller: object
) -> Iterator[RealCell]:
    """The example's cell of ROS topics, with the ports and times of a test.

    The camera is due in every n-th cycle, under a timer if n is above 1.
    """
    cell = RealCell(folder)
    given = to_document(dwell.load(EXAMPLE / "ros2.yaml"))
    document = cell.document
    document["name"] = given["name"]
    for task in ("camera", "control"):
        document["tasks"][task] = given["tasks"][task]
    camera, actuators = document["tasks"]["camera"]["ros2"], given["live"]["actuators"]
    camera["connect"] = actuators["control"]["ros2"]["connect"] = network.router
    actuators["control"]["ros2"]["type"] = TWIST
    document["live"] |= {"actuators": actuators, "silence": "zero"}
    document["controller"] |= controller
    if every > 1:
        document["tasks"]["camera"]["every"] = every
        document["live"]["release"] = "timer"
    document["tasks"]["control"]["run"] = "stamped:Steer"
    cell.module.with_name("stamped.py").write_text(STAMPED)
    cell.file.write_text(yaml.safe_dump(document, sort_keys=False))
    cell.problem = dwell.load(cell.file)
    try:
        yield cell
    finally:
        cell.close()


#: The example's last stage for a base that takes stamped commands.
STAMPED = """
import msgspec
import ros_stages
from dwell.live.stage import Message

class Stamped(msgspec.Struct):
    twist: ros_stages.Twist

class Steer(ros_stages.Steer):
    def process(self, inputs):
        return Message(Stamped(super().process(inputs).payload))
"""


def test_a_cell_between_two_topics(tmp_path: Path) -> None:
    with ExitStack() as stack:
        network = stack.enter_context(ros_network())
        # Before the cell looks for free ports.
        router = network.start_router()
        cell = stack.enter_context(real_cell(tmp_path, network))
        robot = RosRobot(network)
        try:
            cell.begin()
            status = cell.until(lambda status: len(robot.commands) > 20 and status["topics"])
            topic = status["topics"]["camera@R1"]
            assert topic["topic"] == "/camera/image_raw"
            assert topic["period_ms"] == 50
            command = robot.commands[-1]
            # The stamp of a frame comes back with the command that was made of it.
            assert command.header.stamp.nanosec == 7
            assert 0 < command.header.stamp.sec <= robot.number
            assert command.twist.angular.z < 0  # the light is at the right
            assert "stamp to arrival" in cell.show(lambda text: "/camera/image_raw: " in text)
            words = "ros2", "diagnostics", cell.file, "--once", "--connect", network.router
            subprocess.run([cell.python, "-m", "dwell", *words], timeout=120, check=True)
            names = {one.name for one in robot.diagnostics[-1].status}
            assert names >= {
                "dwell: light-follower-ros",
                "dwell: light-follower-ros: node R1",
                "dwell: light-follower-ros: stage camera",
            }
            # The camera stops: health names its topic, and the base stops.
            robot.takes.clear()
            stopped = cell.until(lambda status: "/camera/image_raw" in (status["headline"] or ""))
            assert stopped["health"] == "degraded"
            cell.until(lambda _: robot.commands[-1].twist.angular.z == 0.0)
            robot.takes.set()
            count = len(robot.commands)
            cell.until(lambda status: status["health"] == "ok" and len(robot.commands) > count + 9)
            # Peers that know each other need no router.
            kill(router)
            count = len(robot.commands)
            cell.until(lambda _: len(robot.commands) > count + 20)
        finally:
            robot.close()


def test_killed_stages_between_two_topics_cost_at_most_the_bound_of_the_guard(
    tmp_path: Path,
) -> None:
    guard_cycles = 20
    with ExitStack() as stack:
        network = stack.enter_context(ros_network())
        network.start_router()
        given: dict[str, Any] = {"policy": "SO", "initial": "SO", "guard_cycles": guard_cycles}
        cell = stack.enter_context(real_cell(tmp_path, network, **given))
        robot = RosRobot(network)
        try:
            cell.controller()
            for node in ("R2", "E", "R1"):
                cell.agent(node)
            cell.until(lambda status: in_window("SO")(status) and len(robot.commands) > 20)
            # The agent would restart the workers.
            cell.processes["agent-E"].kill()
            for mark in cell.state("E").glob("*@E*.pid"):
                with suppress(ProcessLookupError):
                    os.kill(json.loads(mark.read_text())["pid"], signal.SIGKILL)
            # Windows are recorded when they end.
            cell.until(in_window("LOC"))
        finally:
            robot.close()
        assert cell.end("controller") == 0
        (folder,) = (cell.folder / "runs").iterdir()
        run = dwell.open_run(folder)
        assert "guard" in run.decisions["reason"].cast(str)
        actuated = run.cycles.filter("actuated")["number"].to_numpy()
        assert 0 < np.diff(actuated).max() - 1 <= guard_cycles + 1


def test_a_slower_topic_is_a_source_in_every_second_cycle(tmp_path: Path) -> None:
    with ExitStack() as stack:
        network = stack.enter_context(ros_network())
        network.start_router()
        cell = stack.enter_context(real_cell(tmp_path, network, every=2))
        robot = RosRobot(network)
        try:
            cell.begin()
            cell.until(lambda status: len(robot.commands) > 20 and in_window("LOC")(status))
        finally:
            robot.close()
        assert cell.end("controller") == 0
        (folder,) = (cell.folder / "runs").iterdir()
        run = dwell.open_run(folder)
        actuated = run.cycles.filter("actuated")["number"].to_numpy()
        assert len(actuated) > 0
        assert not (actuated % 2).any()
        idle = run.cycles.filter(run.cycles["number"] % 2 == 1)["outcome"].cast(str)
        assert set(idle) == {"idle"}
