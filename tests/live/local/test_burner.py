"""Busy threads: how many, where, until when; how busy is the machine's business.

Those in a node's group use its time, and are gone with whoever asked for them.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.errors import LiveError, ProblemError
from dwell.live.local.burner import STRESS_NG, Burner, stress
from dwell.live.local.cgroups import find_cgroups
from dwell.model import Quota
from dwell_lab.testbed.groups import Groups, Share, group_name, remove_group
from lab.tests.testbed.machine import CPU, no_groups, own_name
from tests.waiting import PATIENCE_S, wait_until

needs_groups = pytest.mark.skipif(bool(no_groups()), reason=no_groups() or "there are groups")
NODE = "A"
PROGRAMS = [
    pytest.param((), id="burner"),
    pytest.param(
        STRESS_NG,
        id="stress-ng",
        marks=pytest.mark.skipif(not shutil.which(STRESS_NG[0]), reason="stress-ng: not installed"),
    ),
]


@pytest.fixture
def burner() -> Iterator[Burner]:
    with Burner([CPU]) as started:
        yield started


def used_s(pid: int) -> float:
    """CPU time of a process; its name has no spaces."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


def test_as_many_threads_as_asked_for_are_busy_where_they_should_be(burner: Burner) -> None:
    assert not burner.pids
    burner.set(3)
    three = burner.pids
    assert len(set(three)) == 3
    for pid in three:
        assert os.sched_getaffinity(pid) == {CPU}
        assert os.sched_getscheduler(pid) == os.SCHED_OTHER
        assert os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0)
        # In one session with the others, or a kernel with autogroup counts all of them as one.
        assert os.getsid(pid) == os.getsid(0)
    wait_until(lambda: all(used_s(pid) >= 0.03 for pid in three))
    burner.set(1)
    assert burner.pids == three[:1]
    assert gone(three[1])
    assert gone(three[2])
    burner.set(0)
    assert gone(three[0])


def test_all_threads_end_with_the_burner() -> None:
    burner = Burner([CPU])
    burner.start(2)
    pids = (burner.pid, *burner.pids)
    assert len(pids) == 3
    burner.stop()
    assert all(map(gone, pids))
    burner.stop()


PARENT = f"""
import sys
from dwell.live.local.burner import Burner
burner = Burner([{CPU}])
burner.start(2)
print(burner.pid, *burner.pids, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("victim", ["parent", "burner"])
def test_all_threads_end_with_what_they_belong_to(victim: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        descriptors = [os.pidfd_open(pid) for pid in pids]
        os.kill(parent.pid if victim == "parent" else pids[0], signal.SIGKILL)
        for descriptor in descriptors:
            assert select.select([descriptor], [], [], PATIENCE_S)[0]
            os.close(descriptor)
        parent.kill()


def test_mistakes_are_named(burner: Burner) -> None:
    with pytest.raises(LiveError, match="a burner cannot run on CPU 4095; this process may use"):
        Burner([CPU, 4095])
    with pytest.raises(LiveError, match="a burner cannot run on no CPU"):
        Burner([])
    with pytest.raises(ProblemError, match="threads: -1 is not allowed"):
        burner.set(-1)
    with pytest.raises(LiveError, match="has been started before"):
        burner.start()


# ------------------------------------------------------------------------------ in a group


@pytest.fixture
def name() -> str:
    return own_name()


@pytest.fixture
def groups(name: str) -> Iterator[Groups]:
    with Groups(name, {NODE: Share((CPU,), Quota(0.4, 10.0))}) as made:
        yield made


def soon(groups: Groups, least: int, most: int) -> None:
    """Wait until there are so many processes in the group."""
    until = time.monotonic() + PATIENCE_S
    while not least <= len(groups.pids(NODE)) <= most:
        assert time.monotonic() < until
        time.sleep(0.02)


@needs_groups
@pytest.mark.parametrize("program", PROGRAMS)
def test_as_many_threads_as_asked_for_use_the_groups_time(
    groups: Groups, program: tuple[str, ...]
) -> None:
    each = 2 if program else 1  # stress-ng is one process that watches, and one that is busy
    with Burner([CPU], prefix=groups.inside(NODE, []), program=program) as busy:
        assert groups.pids(NODE) == [busy.pid]
        for threads in (1, 3, 2, 0):
            busy.set(threads)
            assert len(busy.pids) == threads
            soon(groups, 1 + each * threads, 1 + each * threads)
            if threads:
                before = groups.used_ns(NODE)
                until = time.monotonic() + PATIENCE_S
                while groups.used_ns(NODE) < before + 20_000_000:
                    assert time.monotonic() < until
                    time.sleep(0.01)
    assert groups.pids(NODE) == []


@needs_groups
def test_it_is_stress_ng_where_that_is_installed(groups: Groups) -> None:
    with stress(groups.inside(NODE, [])) as busy:
        busy.set(1)
        command = Path(f"/proc/{busy.pids[0]}/cmdline")
        installed = shutil.which("stress-ng") is not None
        wait_until(lambda: command.read_bytes().startswith(b"stress-ng") == installed)


OWNER = """
import sys, time
from dwell.live.local.burner import Burner
cpu, prefix = int(sys.argv[1]), sys.argv[3:]
with Burner([cpu], prefix=prefix, program=sys.argv[2].split()) as busy:
    busy.set(2)
    print("ready", flush=True)
    time.sleep(600)
"""


@needs_groups
@pytest.mark.parametrize("program", PROGRAMS)
def test_nothing_burns_on_when_its_owner_is_killed(
    groups: Groups, program: tuple[str, ...]
) -> None:
    words = [sys.executable, "-c", OWNER, str(CPU), " ".join(program), *groups.inside(NODE, [])]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == b"ready\n"
        assert groups.pids(NODE)
        owner.send_signal(signal.SIGKILL)
    soon(groups, 0, 0)


@needs_groups
def test_a_group_that_is_removed_takes_its_stress_along(name: str) -> None:
    with Groups(name, {NODE: Share()}) as groups, stress(groups.inside(NODE, []), [CPU]) as busy:
        busy.set(2)
        remove_group(group_name(name), find_cgroups())
        assert not any(Path(f"/proc/{pid}/exe").exists() for pid in busy.pids)
