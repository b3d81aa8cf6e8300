"""ROS 2 topics at both ends of a cell, next to Zenoh: latency, intervals and lost messages."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import Figure, Goal, Section
from benchmarks.live import everywhere
from benchmarks.live_cell import RECORD, Actuator, Applied, LightCell, document
from benchmarks.ros_network import IMAGE, TOPIC, counts_of, key_of, opened, ros_process
from dwell import ros2
from dwell.live.ros2.rmw_zenoh import Attachment
from dwell.live.stage import CellStage, Message

RUNS, SECONDS = 5, 20.0
#: What the ends are meant to add to the median at most, ms.
ADDED = 0.5
RATE_HZ, HEIGHT, WIDTH = 30.0, 480, 640
ROUTER = "tcp/127.0.0.1:7447"
COMMANDS, TWIST = "/cmd_vel", "geometry_msgs/msg/TwistStamped"
#: Cycles at the beginning that do not count.
SETTLES = 60
#: Period of the commands whose intervals are measured, for how long, and the largest change of an
#: interval that counts as equal.
COMMANDS_MS, COMMANDS_S, EQUAL_MS = 10.0, 60.0, 1.0
#: Bytes of an image on an emulated link: about 2 MB at 10 Hz take 160 Mbit/s.
LARGE = ("--size", "833", "800", "--hertz", "10")
LINK_S = 20.0
#: Rate of the link in Mbit/s; QoS; longest wait of a publisher that drops messages, ms.
LINKS = (
    (1_000, "best-effort", 50),
    (1_000, "reliable", 50),
    (100, "best-effort", 50),
    (100, "best-effort", 1_000),
    (100, "reliable", 50),
)
LINK_PORT = 7_448
#: Key of messages without Dwell.
BARE = "bare"


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

    def note(self, number: int, side: int) -> None:
        """Write number and side of a message, and the instant."""
        os.write(self._file, RECORD.pack(number, side, time.monotonic_ns()))


class Publishing(ros2.Sink):  # type: ignore[misc]
    """The same behind a ROS topic."""

    def __init__(self) -> None:
        super().__init__(COMMANDS, TWIST, connect=ROUTER, require_subscriber=False)
        self.book = Stamped()

    def apply(self, command: Message) -> None:
        """Publish, then write."""
        super().apply(command)
        self.book.write(command)


class Echoed(Publishing):
    """The same, which writes when `apply` returned and when a bare subscriber got each message."""

    def start(self) -> None:
        """Open a session for the subscriber, too."""
        super().start()
        self._count = 0
        self._bare, self._out = opened(ROUTER), opened(ROUTER)
        self._kept = [
            self._bare.declare_subscriber(key_of(COMMANDS, TWIST), self._take),
            self._bare.declare_subscriber(BARE, self._take_bare),
        ]
        self._publisher = self._out.declare_publisher(BARE, express=True)

    def stop(self) -> None:
        """Close all sessions."""
        self._bare.close()
        self._out.close()
        super().stop()

    def apply(self, command: Message) -> None:
        """Publish, then write the number of the message; then the same without Dwell."""
        super(Publishing, self).apply(command)
        self._count += 1
        self.book.note(self._count, 0)
        self._publisher.put(self._count.to_bytes(8, "little") + ZERO)
        self.book.note(self._count, 2)

    def _take(self, sample: Any) -> None:
        self.book.note(Attachment.read(sample.attachment.to_bytes()).sequence, 1)

    def _take_bare(self, sample: Any) -> None:
        self.book.note(int.from_bytes(sample.payload.to_bytes()[:8], "little"), 3)


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
        with ExitStack() as stack:
            for words in (("router", ROUTER), ("talk", ROUTER)):
                stack.enter_context(ros_process(*words))
            subscriber = stack.enter_context(ros_process("hear", ROUTER))
            topics.append(_latencies(_with_topics(), seconds))
            bare.append(counts_of(subscriber)["ages_ms"][SETTLES:])
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
    figures += _intervals(8.0 if quick else COMMANDS_S)
    notes = [
        "a command counts once it is published; `bare` is what a subscriber beside the cell sees"
    ]
    if os.geteuid() == 0:
        for rate, qos, drop_after_ms in LINKS:
            figures += _over_a_link(rate, qos, drop_after_ms, 5.0 if quick else LINK_S)
        notes.append(
            "2 MB at 10 Hz are 160 Mbit/s: at 100 Mbit/s a best-effort publisher loses the rest "
            "once the buffers of the link are full. It drops a message that has waited 50 ms for "
            "room, and 2 MB take 160 ms; it loses less with a longer wait "
            "(drop/max_wait_before_drop_fragments in its configuration)"
        )
    else:
        notes.append("without root: no emulated links")
    title = f"Images of {WIDTH} × {HEIGHT} rgb8 at {RATE_HZ:g} Hz, {runs} × {seconds:g} s each way"
    return Section(title, figures, notes)


def _intervals(seconds: float) -> Iterator[Figure]:
    """Yield the shares of intervals at a subscriber that are those of `apply`, or of a bare put."""
    found = document("ros-commands", period_ms=COMMANDS_MS)
    found["tasks"]["control"]["run"] = "benchmarks.ros_ends:Turning"
    found["live"]["actuators"] = {"control": "benchmarks.ros_ends:Echoed"}
    with (
        ros_process("router", ROUTER),
        tempfile.TemporaryDirectory() as folder,
        LightCell(found, Path(folder) / "cell") as cell,
    ):
        time.sleep(seconds)
        noted: Sequence[Applied] = cell.applied()
    # The record's second number is the side: sent and arrived, then the same without Dwell.
    sides: list[dict[int, int]] = [{}, {}, {}, {}]
    for one in noted:
        sides[one.released_ns][one.cycle] = one.at_ns
    hertz = 1e3 / COMMANDS_MS
    what = f"intervals at {hertz:g} Hz within {EQUAL_MS:g} ms: of a topic and apply()"
    yield Figure(what, [_equal(*sides[:2])], "%", Goal(low=99))
    yield Figure("  of a bare subscriber and a bare put", [_equal(*sides[2:])], "%")


def _equal(sent: Mapping[int, int], arrived: Mapping[int, int]) -> float:
    """Return the share of the intervals between neighbours that are equal at both sides, %."""
    known = sorted(sent.keys() & arrived.keys())[SETTLES:]
    changes = [
        (arrived[number] - arrived[before]) - (sent[number] - sent[before])
        for before, number in pairwise(known)
        if number == before + 1
    ]
    return 100 * float(np.mean(np.abs(changes) <= EQUAL_MS * 1e6))


def _over_a_link(
    rate_mbps: float, qos: str, drop_after_ms: float, seconds: float
) -> Iterator[Figure]:
    """Yield messages received and lost behind an emulated link, by a bare subscriber and by us."""
    from dwell_lab.testbed.hosts import Hosts
    from dwell_lab.testbed.link import TunLink

    nodes = "A", "B"
    with ExitStack() as stack:
        hosts = stack.enter_context(Hosts(f"ros{os.getpid()}", nodes, [nodes]))
        tuns = {"A": hosts.tun("A", "B"), "B": hosts.tun("B", "A")}
        link = stack.enter_context(TunLink(nodes, tuns, seed=7))
        for source, target in (nodes, nodes[::-1]):
            link.set(source, target, rate_mbps=rate_mbps)
        router = f"tcp/{hosts.address('B')}:{LINK_PORT}"
        inside = {node: partial(hosts.inside, node) for node in nodes}
        as_client = router, "--mode", "client"
        stack.enter_context(ros_process("router", router, inside=inside["B"]))
        subscriber = stack.enter_context(
            ros_process("hear", *as_client, "--source", inside=inside["B"])
        )
        words = *as_client, "--copied", *LARGE, "--qos", qos, "--drop-after-ms", str(drop_after_ms)
        with ros_process("talk", *words, inside=inside["A"]):
            time.sleep(seconds)
        found = counts_of(subscriber)
    wait = f", drops after {drop_after_ms} ms" if qos == "best-effort" else ""
    yield Figure(
        f"2 MB at 10 Hz, {rate_mbps} Mbit/s, {qos}{wait}: received", [len(found["ages_ms"])], ""
    )
    yield Figure("  lost, by a bare subscriber", [found["lost"]], "")
    yield Figure("  lost, by Dwell more", [found["source"] - found["lost"]], "", Goal(0, 0))


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
    topic = {"topic": TOPIC, "type": IMAGE, "qos": "sensor_data", "connect": ROUTER}
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
