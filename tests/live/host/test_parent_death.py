"""Processes that end with their owner, however that ends."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from dwell.live.host.parent_death import OPTION, end_those_of, end_with_owner
from dwell.live.transport.orphans import SHARED_MEMORY

PATIENCE_S = 60.0

#: Starts a process that ends with its parent, tells its id, and waits to be killed.
OWNER_CODE = """
import os, subprocess, sys, time
code = '''
import sys, threading
from dwell.live.host.parent_death import end_with_owner
stopped = threading.Event()
end_with_owner(stopped, int(sys.argv[1]))
print("waits", flush=True)
stopped.wait()
print("ends", flush=True)
'''
child = subprocess.Popen([sys.executable, "-c", code, str(os.getpid())], process_group=0)
time.sleep(3600)
"""


def test_a_process_ends_when_its_owner_is_killed() -> None:
    owner = subprocess.Popen([sys.executable, "-c", OWNER_CODE], stdout=subprocess.PIPE, text=True)
    assert owner.stdout is not None
    with owner.stdout as told:
        assert told.readline() == "waits\n"
        owner.send_signal(signal.SIGKILL)
        owner.wait()
        assert told.readline() == "ends\n"
        # End of file: nobody has the pipe any more.
        assert told.read() == ""


def test_an_owner_that_has_gone_already_is_noticed() -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    stopped = threading.Event()
    end_with_owner(stopped, gone.pid)
    assert stopped.is_set()


def test_those_of_a_cell_are_ended_and_no_others(tmp_path: Path) -> None:
    """By owner and cell file; those of another cell, or of another owner, go on."""
    waits = [sys.executable, "-c", "import time; print('waits', flush=True); time.sleep(3600)"]
    mine, other, me = tmp_path / "cell.yaml", tmp_path / "other.yaml", str(os.getpid())
    with ExitStack() as stack:
        started = []
        for cell, owner in ((mine, me), (mine, me), (other, me), (mine, "1")):
            words = ["--cell", str(cell), "--serve", OPTION, owner]
            one = subprocess.Popen([*waits, *words], stdout=subprocess.PIPE)
            stack.enter_context(one)
            stack.callback(one.kill)
            assert one.stdout is not None
            assert one.stdout.readline() == b"waits\n"
            started.append(one)
        end_those_of(me, mine, PATIENCE_S)
        assert [one.poll() for one in started] == [-signal.SIGKILL, -signal.SIGKILL, None, None]


#: As above; the process holds a file as Zenoh holds a segment, and a sweeper waits as well.
HOLDER_CODE = """
import os, subprocess, sys, time
from dwell.live.host.parent_death import start_sweeper
code = '''
import fcntl, os, sys, threading, time
from dwell.live.host.parent_death import end_with_owner
fcntl.flock(os.open(sys.argv[1], os.O_RDWR), fcntl.LOCK_SH)
stopped = threading.Event()
end_with_owner(stopped, int(sys.argv[3]))
print("waits", flush=True)
stopped.wait()
time.sleep(0.5)
print(os.path.exists(sys.argv[1]), flush=True)
'''
words = [sys.argv[1], "--owner", str(os.getpid())]
child = subprocess.Popen([sys.executable, "-c", code, *words])
sweeper = start_sweeper()
print(sweeper.pid, flush=True)
time.sleep(3600)
"""


def test_shared_memory_goes_when_the_last_of_an_owner_has_ended() -> None:
    # No process of Zenoh's ends here that would remove it.
    segment = SHARED_MEMORY / f"test-{os.getpid()}.zenoh"
    segment.touch()
    try:
        words = [sys.executable, "-c", HOLDER_CODE, str(segment)]
        owner = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert owner.stdout is not None
        with owner.stdout as told:
            lines = {told.readline(), told.readline()}
            lines.discard("waits\n")
            (sweeper,) = map(int, lines)
            ended = os.pidfd_open(sweeper)
            owner.send_signal(signal.SIGKILL)
            owner.wait()
            # It was there while somebody held it.
            assert told.readline() == "True\n"
        assert select.select([ended], [], [], PATIENCE_S)[0]
        os.close(ended)
        assert not segment.exists()
    finally:
        segment.unlink(missing_ok=True)


@pytest.mark.parametrize("owner", [None, os.getpid()], ids=["no owner", "this process"])
def test_without_an_owner_that_ends_nothing_happens(owner: int | None) -> None:
    stopped = threading.Event()
    end_with_owner(stopped, owner)
    assert not stopped.is_set()
