"""A Zenoh process that sends what it is told to: `python link_sender.py PORT`, a line an order.

`small COUNT` and `image COUNT` put so many messages, each with its number and the instant, and then
say so.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import zenoh

IMAGE_BYTES = 307_200


def session(*, listen: int | None = None, connect: int | None = None) -> zenoh.Session:
    """Open a session that meets nobody by itself, without shared memory."""
    config = zenoh.Config()
    address = "tcp/127.0.0.1:{}"
    for path, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "listen/endpoints": [address.format(listen)] if listen else [],
        "connect/endpoints": [address.format(connect)] if connect else [],
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def _matched(publisher: Any) -> bool:  # its stub is wrong about what the status is
    return bool(publisher.matching_status.matching)


def main() -> None:
    """Send until the orders end."""
    with session(connect=int(sys.argv[1])) as opened:
        # Blocking, so that only the link loses anything.
        block = zenoh.CongestionControl.BLOCK
        publishers = {
            "small": opened.declare_publisher(
                "t/small", congestion_control=block, priority=zenoh.Priority.REAL_TIME
            ),
            "image": opened.declare_publisher("t/image", congestion_control=block),
        }
        while not all(map(_matched, publishers.values())):
            time.sleep(0.01)
        print("ready", flush=True)
        numbers = dict.fromkeys(publishers, 0)
        for line in sys.stdin:
            name, count = line.split()
            for _ in range(int(count)):
                head = numbers[name].to_bytes(8, "little") + time.monotonic_ns().to_bytes(
                    8, "little"
                )
                publishers[name].put(head + bytes(IMAGE_BYTES if name == "image" else 0))
                numbers[name] += 1
            peers = len(opened.info.peers_zid())
            print(peers, flush=True)


if __name__ == "__main__":
    main()
