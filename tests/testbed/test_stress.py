"""Stress: busy threads in a node's group, as many as asked for, gone with whoever asked."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.model import Quota
from dwell.testbed.cgroups import find_cgroups
from dwell.testbed.groups import Groups, Share, group_name, remove_group
from dwell.testbed.stress import STRESS_NG, Stress
from tests.testbed.machine import CPU, no_groups, own_name

pytestmark = pytest.mark.skipif(bool(no_groups()), reason=no_groups())

PATIENCE_S = 30.0
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


@pytest.mark.parametrize("program", PROGRAMS)
def test_as_many_threads_as_asked_for_use_the_groups_time(
    groups: Groups, program: tuple[str, ...]
) -> None:
    each = 2 if program else 1  # stress-ng is one process that watches, and one that is busy
    with Stress(groups.inside(NODE, []), [CPU], program=program) as stress:
        assert groups.pids(NODE) == [stress.pid]
        for threads in (1, 3, 2, 0):
            stress.set(threads)
            assert len(stress.pids) == threads
            soon(groups, 1 + each * threads, 1 + each * threads)
            if threads:
                before = groups.used_ns(NODE)
                until = time.monotonic() + PATIENCE_S
                while groups.used_ns(NODE) < before + 20_000_000:
                    assert time.monotonic() < until
                    time.sleep(0.01)
    assert groups.pids(NODE) == []


def test_it_is_stress_ng_where_that_is_installed(groups: Groups) -> None:
    stress = Stress(groups.inside(NODE, []))
    assert stress.kind == ("stress-ng" if shutil.which("stress-ng") else "burner")


OWNER = """
import sys, time
from dwell.testbed.stress import Stress
cpu, prefix = int(sys.argv[1]), sys.argv[3:]
with Stress(prefix, [cpu], program=sys.argv[2].split()) as stress:
    stress.set(2)
    print("ready", flush=True)
    time.sleep(600)
"""


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


def test_a_group_that_is_removed_takes_its_stress_along(name: str) -> None:
    with Groups(name, {NODE: Share()}) as groups, Stress(groups.inside(NODE, []), [CPU]) as stress:
        stress.set(2)
        remove_group(group_name(name), find_cgroups())
        assert not any(Path(f"/proc/{pid}/exe").exists() for pid in stress.pids)
