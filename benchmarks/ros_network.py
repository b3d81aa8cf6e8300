"""A process of a ROS network: `python -m benchmarks.ros_network router | talk | hear ENDPOINT`.

Each prints `open` when it is ready. `talk` publishes images. `hear` subscribes without Dwell, on
request with a `dwell.ros2.Source` next to it; at a line on stdin it prints its counts and ends.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from dwell import ros2
from dwell.live.ros2.images import stamp_ns, with_stamp
from dwell.live.ros2.message_types import message_types
from dwell.live.ros2.rmw_zenoh import Attachment, Topic
from dwell.live.stage import StagePlace

TOPIC, IMAGE = "/camera/image_raw", "sensor_msgs/msg/Image"
#: Longest time for which a publisher that drops messages waits for room, for one message.
DROP_AFTER = "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments"
#: Zenoh's value of it.
USUAL_MS = 50.0


@contextmanager
def ros_process(
    *words: str, inside: Callable[[Sequence[str]], Sequence[str]] = list
) -> Iterator[subprocess.Popen[str]]:
    """Run a process of this module, which ends with the context; `inside` wraps its command."""
    command = inside([sys.executable, "-m", "benchmarks.ros_network", *words])
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "open\n":
                raise RuntimeError(f"{words[0]} did not start")
            yield process
        finally:
            process.kill()


def counts_of(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Return the counts of a process that hears."""
    printed, _ = process.communicate("\n")
    found: dict[str, Any] = json.loads(printed)
    return found


def key_of(topic: str, kind: str) -> str:
    """Return the key of a topic's messages."""
    return Topic(topic, kind, message_types().hash(kind)).key(0)


def opened(
    endpoint: str, mode: str = "peer", drop_after_ms: float = USUAL_MS, *, shared: bool = True
) -> Any:
    """Return a plain session of Zenoh; `shared`: with shared memory, which emulated links miss."""
    import zenoh

    config = zenoh.Config()
    values: dict[str, object] = {
        "mode": mode,
        f"{'listen' if mode == 'router' else 'connect'}/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": shared,
        DROP_AFTER: round(drop_after_ms * 1e3),
    }
    for path, value in values.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _talk(session: Any, given: argparse.Namespace) -> None:
    """Publish images; a reliable publisher waits for room, another one drops messages."""
    import zenoh

    reliable = given.qos == "reliable"
    publisher = session.declare_publisher(
        key_of(TOPIC, IMAGE),
        reliability=zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
        congestion_control=(
            zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        ),
    )
    height, width = given.size
    pixels = np.zeros(height * width * 3, np.uint8)
    fields = {"height": height, "width": width, "encoding": "rgb8", "step": 3 * width}
    data = ros2.encode({**fields, "data": pixels}, IMAGE)
    due_s, number = time.monotonic(), 0
    while True:
        due_s, number = max(due_s + 1 / given.hertz, time.monotonic()), number + 1
        time.sleep(max(due_s - time.monotonic(), 0.0))
        now_ns = time.time_ns()
        attachment = Attachment(number, now_ns, bytes(16)).pack()
        publisher.put(with_stamp(data, now_ns), attachment=attachment)


def _hear(session: Any, given: argparse.Namespace) -> None:
    """Subscribe without Dwell, and with it; print ages and lost messages of both."""
    import zenoh

    source = ros2.Source(TOPIC, IMAGE, "sensor_data", connect=given.endpoint, mode=given.mode)
    source.placed(StagePlace("bench", "camera", payload_bytes=4_000_000))
    ages_ms: list[float] = []
    numbers: list[int] = []

    def take(sample: Any) -> None:
        now_ns = time.time_ns()
        numbers.append(Attachment.read(sample.attachment.to_bytes()).sequence)
        ages_ms.append((now_ns - stamp_ns(sample.payload.to_bytes())) / 1e6)

    subscriber = session.declare_subscriber(
        key_of(TOPIC, IMAGE), zenoh.handlers.Callback(take, indirect=False)
    )
    if given.source:
        source.start()
        while "no router" in (note := source.report().note) or "not open" in note:
            time.sleep(0.01)
    print("open", flush=True)
    sys.stdin.readline()
    subscriber.undeclare()
    lost = numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0
    found = {"ages_ms": ages_ms, "lost": lost, "source": source.rates().lost}
    print(json.dumps(found), flush=True)
    source.stop()


def main() -> None:
    """Run a process."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ros_network", description=__doc__)
    parser.add_argument("what", choices=("router", "talk", "hear"))
    parser.add_argument("endpoint")
    parser.add_argument("--mode", default="peer")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 640))
    parser.add_argument("--hertz", type=float, default=30.0)
    parser.add_argument("--qos", choices=("best-effort", "reliable"), default="best-effort")
    parser.add_argument("--drop-after-ms", type=float, default=USUAL_MS)
    parser.add_argument("--source", action="store_true", help="hear with Dwell, too")
    parser.add_argument("--copied", action="store_true", help="without shared memory")
    given = parser.parse_args()
    mode = "router" if given.what == "router" else given.mode
    with opened(given.endpoint, mode, given.drop_after_ms, shared=not given.copied) as session:
        if given.what == "hear":
            _hear(session, given)
            return
        print("open", flush=True)
        if given.what == "talk":
            _talk(session, given)
        threading.Event().wait()


if __name__ == "__main__":
    main()
