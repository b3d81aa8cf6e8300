"""The end of processes is noticed, and nothing is left of it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

from dwell.live.host.process_ends import ProcessEnds
from tests.waiting import PATIENCE_S, wait_until


def watchers() -> int:
    return sum(thread.name == "process ends" for thread in threading.enumerate())


def start(program: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE)


def watch_two(ends: ProcessEnds) -> None:
    """Watch a process that ends at once and one that waits, until both have ended."""
    woken = threading.Event()
    ends.wake = woken.set
    waits, ended = start("input()"), start("")
    for program in (waits, ended):
        ends.watch(program.pid)
    assert woken.wait(PATIENCE_S)
    wait_until(lambda: ends.pending([ended.pid]))
    assert not ends.pending([waits.pid])
    waits.communicate(b"\n")
    ended.communicate()
    wait_until(lambda: ends.pending([waits.pid]))


def test_without_processes_no_thread_and_no_descriptor_is_left() -> None:
    before, running = len(os.listdir("/proc/self/fd")), watchers()
    ends = [ProcessEnds() for _ in range(50)]
    assert (len(os.listdir("/proc/self/fd")), watchers()) == (before, running)
    for _ in range(3):
        watch_two(ends[0])
        wait_until(lambda: watchers() == running)
    wait_until(lambda: len(os.listdir("/proc/self/fd")) <= before)
