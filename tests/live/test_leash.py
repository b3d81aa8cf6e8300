"""Processes that end with their owner, however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from dwell.live.leash import OWNER, end_with_owner

#: Starts a process that waits on the leash of its parent, tells its id, and waits to be killed.
OWNER_CODE = """
import os, subprocess, sys, time
code = '''
import sys, threading
from dwell.live.leash import end_with_owner
stopped = threading.Event()
end_with_owner(stopped)
print("waits", flush=True)
stopped.wait()
print("ends", flush=True)
'''
environment = {**os.environ, "DWELL_OWNER": str(os.getpid())}
child = subprocess.Popen([sys.executable, "-c", code], env=environment, process_group=0)
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


def test_an_owner_that_has_gone_already_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    monkeypatch.setenv(OWNER, str(gone.pid))
    stopped = threading.Event()
    end_with_owner(stopped)
    assert stopped.is_set()


@pytest.mark.parametrize("text", [None, "", "nobody", "this process"])
def test_without_an_owner_that_ends_nothing_happens(
    text: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if text is None:
        monkeypatch.delenv(OWNER, raising=False)
    else:
        own = text == "this process"
        monkeypatch.setenv(OWNER, str(os.getpid()) if own else text)
    stopped = threading.Event()
    end_with_owner(stopped)
    assert not stopped.is_set()
