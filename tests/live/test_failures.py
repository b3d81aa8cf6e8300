"""What cannot go on ends its process, and says why."""

from __future__ import annotations

import subprocess
import sys

import pytest

#: A worker of a cell in memory; what is appended makes something of it fail.
WORKER = """
import sys, threading, time
from dwell.live.host.hosting import Hosted, work
from dwell.live.roles.role import Pulse
from dwell.live.wire.transport import Arrival
from tests.live.small_world import Passing, World, canonical

world = World(canonical())
worker = world.worker("perception@E")
"""

FAILING = {
    "thread 'beats' failed: MemoryError": """
def wake(*_):
    raise MemoryError
Pulse.wake = wake
work(worker, worker.place.transport, stopped=threading.Event())
""",
    "a message under dwell/canonical/x failed: SystemExit: 3": """
worker.receive = lambda *_: sys.exit(3)
hosted = Hosted(worker, worker.place.transport, complain=worker.place.complain)
hosted._receive(Arrival("dwell/canonical/x", b""))
""",
    "thread 'frames' failed: SystemExit": """
class Camera(Passing):
    def wait(self):
        raise SystemExit
worker.triggers, worker.stage = True, Camera("perception")
work(worker, worker.place.transport, stopped=threading.Event())
""",
}


@pytest.mark.parametrize("words", FAILING)
def test_what_cannot_go_on_ends_its_process_and_says_why(words: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", WORKER + FAILING[words]],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 1, ended.stderr
    last = ended.stderr.splitlines()[-1]
    assert last.startswith(words)
    assert last.endswith("; the process ends")
