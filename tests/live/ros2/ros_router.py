"""A Zenoh router in a process of its own: `python -m tests.live.ros2.ros_router PORT`."""

from __future__ import annotations

import json
import sys
import threading


def main() -> None:
    import zenoh

    config = zenoh.Config()
    values = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{sys.argv[1]}"],
        "listen/retry": {
            "period_init_ms": 20,
            "period_max_ms": 100,
            "period_increase_factor": 2,
        },
        "listen/timeout_ms": 5_000,
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }
    for path, value in values.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config):
        print("open", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main()
