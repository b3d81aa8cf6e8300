"""What ROS 2 topics at both ends of a cell add to its latency, beside Zenoh's own.

`python -m benchmarks.ros_ends router | talk | listen PORT` runs a part of the network.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import Figure, Goal, Section
from benchmarks.live import everywhere
from benchmarks.live_cell import RECORD, Actuator, Applied, LightCell, document
from dwell import ros2
from dwell.live.stage import CellStage, Message

RUNS, SECONDS = 5, 20.0
#: What the ends are meant to add to the median at most, ms.
ADDED = 0.5
RATE_HZ, HEIGHT, WIDTH = 30.0, 480, 640
PORT = 7_447
TOPIC, IMAGE = "/camera/image_raw", "sensor_msgs/msg/Image"
COMMANDS, TWIST = "/cmd_vel", "geometry_msgs/msg/TwistStamped"
#: Cycles at the beginning that do not count.
SETTLES = 60


class Frames(CellStage):
    """A camera in Python: the same frame, 30 times per second."""

    def start(self) -> None:
        """Make the frame."""
        self.frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        self.next_s = time.monotonic()

    def wait(self) -> None:
        """Wait for its time."""
        self.next_s = max(self.next_s + 1 / RATE_HZ, time.monotonic())
        time.sleep(max(self.next_s - time.monotonic(), 0.0))
        self.stamp_ns = time.time_ns()

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return the frame with the time at which it was ready."""
        return Message(self.frame, stamp_ns=self.stamp_ns)


class Stamped(Actuator):
    """Writes down cycle, stamp and the time of day, in order."""

    def apply(self, command: Message) -> None:
        """Write."""
        self.write(command)

    def write(self, command: Message) -> None:
        """Write cycle, stamp and the time of day."""
        now_ns = time.time_ns()
        os.write(self._file, RECORD.pack(command.cycle, command.stamp_ns or 0, now_ns))


class Publishing(ros2.Sink):  # type: ignore[misc]
    """The same behind a ROS topic."""

    def __init__(self) -> None:
        super().__init__(COMMANDS, TWIST, connect=f"tcp/127.0.0.1:{PORT}", require_subscriber=False)
        self.book = Stamped()

    def apply(self, command: Message) -> None:
        """Publish, then write."""
        super().apply(command)
        self.book.write(command)


class Turning:
    """The last stage: a command that both actuators take."""

    def process(self, inputs: Mapping[str, Message]) -> Message:
        """Return a TwistStamped of zeros."""
        return Message(ZERO)


ZERO = b"\0\1\0\0" + bytes(12) + bytes(48)


def measure(quick: bool) -> Section:
    """See the module."""
    everywhere()
    runs, seconds = (1, 8.0) if quick else (RUNS, SECONDS)
    python, topics, bare = [], [], []
    for _ in range(runs):
        python.append(_latencies(_cell(), seconds))
        with _network() as listener:
            topics.append(_latencies(_with_topics(), seconds))
            bare.append(_heard(listener))
    figures = []
    for share in (50, 99):
        each = [
            [float(np.percentile(one, share)) for one in found] for found in (python, topics, bare)
        ]
        added = [one - other - own for other, one, own in zip(*each, strict=True)]
        goal = Goal(high=ADDED) if share == 50 else None
        figures += [
            Figure(f"Python ends, frame to command, p{share}", each[0], "ms"),
            Figure(f"ROS ends, frame to command, p{share}", each[1], "ms"),
            Figure(f"bare Zenoh, the image alone, p{share}", each[2], "ms"),
            Figure(f"the ROS ends add, p{share}", added, "ms", goal),
        ]
    return Section(
        f"Images of {WIDTH} × {HEIGHT} rgb8 at {RATE_HZ:g} Hz, {runs} × {seconds:g} s each way",
        figures,
        ["a command counts once it is published; `bare` is what a subscriber beside the cell sees"],
    )


def _cell() -> dict[str, Any]:
    found = document("ros-ends", period_ms=1e3 / RATE_HZ)
    found["tasks"]["sensing"]["run"] = "benchmarks.ros_ends:Frames"
    found["tasks"]["control"]["run"] = "benchmarks.ros_ends:Turning"
    found["flows"][0]["bytes"] = HEIGHT * WIDTH * 3
    found["live"] |= {"release": "frames", "actuators": {"control": "benchmarks.ros_ends:Stamped"}}
    return found


def _with_topics() -> dict[str, Any]:
    found = _cell()
    del found["tasks"]["sensing"]["run"]
    connect = f"tcp/127.0.0.1:{PORT}"
    topic = {"topic": TOPIC, "type": IMAGE, "qos": "sensor_data", "connect": connect}
    found["tasks"]["sensing"]["ros2"] = topic
    found["live"]["actuators"] = {"control": "benchmarks.ros_ends:Publishing"}
    return found


def _latencies(found: dict[str, Any], seconds: float) -> Sequence[float]:
    """Run a cell; return the times from frame to command, ms."""
    with tempfile.TemporaryDirectory() as folder, LightCell(found, Path(folder) / "cell") as cell:
        time.sleep(seconds)
        applied: Sequence[Applied] = cell.applied()
    # The record's second number is the stamp.
    return [(one.at_ns - one.released_ns) / 1e6 for one in applied[SETTLES:]]


@contextmanager
def _network() -> Iterator[subprocess.Popen[str]]:
    """Run router, camera and a bare subscriber, which prints its times at the end."""
    running = []
    try:
        for what in ("router", "talk", "listen"):
            command = [sys.executable, "-m", "benchmarks.ros_ends", what, str(PORT)]
            pipe = subprocess.PIPE
            process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
            running.append(process)
            assert process.stdout is not None
            process.stdout.readline()
        yield running[-1]
    finally:
        for process in running:
            process.kill()
            process.communicate()


def _heard(listener: subprocess.Popen[str]) -> Sequence[float]:
    assert listener.stdin is not None
    assert listener.stdout is not None
    listener.stdin.write("\n")
    listener.stdin.flush()
    found: list[float] = json.loads(listener.stdout.readline())
    return found[SETTLES:]


def main() -> None:
    """Run a part of the network."""
    import zenoh

    from dwell.live.ros2.images import stamp_ns, with_stamp
    from dwell.live.ros2.message_types import message_types
    from dwell.live.ros2.rmw_zenoh import Attachment, Topic

    what, port = sys.argv[1:]
    config = zenoh.Config()
    ends = json.dumps([f"tcp/127.0.0.1:{port}"])
    config.insert_json5("scouting/multicast/enabled", "false")
    if what == "router":
        config.insert_json5("mode", '"router"')
    config.insert_json5(f"{'listen' if what == 'router' else 'connect'}/endpoints", ends)
    key = Topic(TOPIC, IMAGE, message_types().hash(IMAGE)).key(0)
    times: list[float] = []
    with zenoh.open(config) as session:
        if what == "listen":

            def take(sample: Any) -> None:
                data = sample.payload.to_bytes()
                times.append((time.time_ns() - stamp_ns(data)) / 1e6)

            session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False))
        print("open", flush=True)
        if what == "talk":
            publisher = session.declare_publisher(key)
            fields = {"height": HEIGHT, "width": WIDTH, "encoding": "rgb8", "step": 3 * WIDTH}
            pixels = np.zeros(HEIGHT * WIDTH * 3, np.uint8)
            data = ros2.encode({**fields, "data": pixels}, IMAGE)
            due_s, number = time.monotonic(), 0
            while True:
                due_s, number = due_s + 1 / RATE_HZ, number + 1
                time.sleep(max(due_s - time.monotonic(), 0.0))
                now_ns = time.time_ns()
                attachment = Attachment(number, now_ns, bytes(16)).pack()
                publisher.put(with_stamp(data, now_ns), attachment=attachment)
        elif what == "listen":
            sys.stdin.readline()
            print(json.dumps(times), flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
