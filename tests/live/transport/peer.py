"""A process that answers whatever it hears, to be killed and frozen.

``python -m tests.live.transport.peer '{"names": [...], "who": ..., "first_port": ...}'``
"""

from __future__ import annotations

import hashlib
import json
import signal
import sys

from dwell.live.transport.zenoh import ZenohTransport
from dwell.live.wire.transport import Arrival, Lane
from tests.live.transport.meshes import full_entry


def digest(sample: Arrival) -> bytes:
    """Short for everything that arrived."""
    parts = (sample.key.encode(), sample.payload, sample.header)
    return hashlib.sha256(b"|".join(hashlib.sha256(part).digest() for part in parts)).digest()


def main() -> None:
    """Answer every message with its digest and the beginning of its payload."""
    asked = json.loads(sys.argv[1])
    transport = ZenohTransport(full_entry(asked["names"], asked["who"], asked["first_port"]))

    def answer(sample: Arrival) -> None:
        transport.put(f"dwell/t/done/{asked['who']}", sample.payload[:16], digest(sample))

    lanes: tuple[Lane, ...] = ("control", "images")
    for lane in lanes:
        transport.subscribe(f"dwell/t/in/{lane}/**", answer)
    signal.sigwait({signal.SIGTERM})
    transport.close()


if __name__ == "__main__":
    main()
