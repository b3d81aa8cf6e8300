"""Process groups: what is left of one is killed, and of nobody else's."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace

import pytest

from dwell.live.host.process_group import ProcessGroup
from tests.waiting import wait_until

#: Starts a helper, says its process id, and waits.
PARENT = """
import subprocess, sys, time
helper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
print(helper.pid, flush=True)
time.sleep(60)
"""


@pytest.fixture
def parent() -> Iterator[subprocess.Popen[bytes]]:
    """A process that leads a group, with a helper in it."""
    made = subprocess.Popen([sys.executable, "-c", PARENT], process_group=0, stdout=subprocess.PIPE)
    assert made.stdout is not None
    made.stdout.readline()
    group = ProcessGroup.of(made.pid)
    assert group is not None
    yield made
    made.kill()
    made.wait()
    made.stdout.close()
    wait_until(lambda: not group.kill())


def test_a_group_outlives_its_leader_and_is_killed(parent: subprocess.Popen[bytes]) -> None:
    group = ProcessGroup.of(parent.pid)
    assert group is not None
    assert group.leader() is not None
    parent.kill()
    parent.wait()
    assert group.leader() is None
    assert group.kill() == 1
    wait_until(lambda: not group.kill())


def test_a_group_of_somebody_else_is_left_alone(parent: subprocess.Popen[bytes]) -> None:
    group = ProcessGroup.of(parent.pid)
    assert group is not None
    # Who had this id before started earlier, or in another session.
    for former in (
        replace(group, started=group.started - 100),
        replace(group, session=group.session + 1),
        replace(group, session=-1),
    ):
        assert former.kill() == 0
    assert parent.poll() is None


def test_nobody_leads_the_group_of_a_process_that_has_ended() -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""], process_group=0)
    ended.wait()
    assert ProcessGroup.of(ended.pid) is None
    assert ProcessGroup(ended.pid, 0.0, 1).kill() == 0
