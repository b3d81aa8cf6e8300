"""Groups: who is in them, what they may use, and that nothing in them outlives them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.local.cgroups import Cgroups, find_cgroups
from dwell.model import Quota
from dwell_lab.testbed.groups import Groups, Share, group_name
from lab.tests.testbed.machine import CPU, no_groups, own_name
from tests.waiting import PATIENCE_S

here = pytest.mark.skipif(bool(no_groups()), reason=no_groups())

BUSY = ["sh", "-c", "while :; do :; done"]
SHARES = {"A": Share((CPU,), Quota(0.2, 10.0)), "B": Share()}


@pytest.fixture
def name() -> str:
    return own_name()


@pytest.fixture
def groups(name: str) -> Iterator[Groups]:
    with Groups(name, SHARES) as made:
        yield made


def use_ns(groups: Groups, node: str, least_ns: int) -> None:
    """Wait until a group has used so much."""
    until = time.monotonic() + PATIENCE_S
    while groups.used_ns(node) < least_ns:
        assert time.monotonic() < until
        time.sleep(0.02)


@here
def test_a_group_uses_no_more_than_its_quota(groups: Groups) -> None:
    began = time.monotonic_ns()
    words = groups.inside("A", BUSY)
    with subprocess.Popen(words) as one, subprocess.Popen(words) as two:
        use_ns(groups, "A", 200_000_000)
        # However slow this machine is: what was used came out of as much time as has passed. The
        # kernel looks every few milliseconds, and takes back what it granted beyond.
        used, passed = groups.used_ns("A"), time.monotonic_ns() - began
        assert used <= 0.2 * passed + 30_000_000
        assert set(groups.pids("A")) == {one.pid, two.pid}
        groups.kill("A")
        assert groups.pids("A") == []
        assert one.wait(PATIENCE_S) == two.wait(PATIENCE_S) == -signal.SIGKILL


@here
def test_quotas_hold_again_after_they_were_lifted(groups: Groups, name: str) -> None:
    stat = find_cgroups().folders["cpu"] / group_name(name) / "A" / "cpu.stat"

    def throttled() -> int:
        counts = stat.read_text().split()
        return int(counts[counts.index("nr_throttled") + 1])

    with subprocess.Popen(groups.inside("A", BUSY)):
        with groups.unlimited():
            before = throttled()
            use_ns(groups, "A", groups.used_ns("A") + 200_000_000)
            assert throttled() <= before + 1
        use_ns(groups, "A", groups.used_ns("A") + 100_000_000)
        assert throttled() > before + 1
        groups.kill("A")


@here
def test_a_group_without_quota_has_its_time_counted_too(groups: Groups) -> None:
    with subprocess.Popen(groups.inside("B", BUSY)):
        use_ns(groups, "B", 50_000_000)
        groups.kill("B")
    assert groups.used_ns("A") == 0


@here
def test_who_sleeps_again_and_again_is_counted_and_who_is_busy_is_not(groups: Groups) -> None:
    sleeps = "import time\nfor _ in range(200): time.sleep(0.001)\ntime.sleep(60)"
    busy, sleeper = groups.inside("B", BUSY), groups.inside("B", [sys.executable, "-c", sleeps])
    with subprocess.Popen(busy) as one, subprocess.Popen(sleeper) as two:
        until = time.monotonic() + PATIENCE_S
        while groups.switches("B").get(two.pid, 0) < 200:
            assert time.monotonic() < until
            time.sleep(0.02)
        found = groups.switches("B")
        assert found.keys() == {one.pid, two.pid}
        assert found[one.pid] < 100
        groups.kill("B")
    assert groups.switches("B") == {}


@here
def test_a_group_runs_on_its_cpus(groups: Groups) -> None:
    look = ["grep", "Cpus_allowed_list", "/proc/self/status"]
    said = subprocess.run(groups.inside("A", look), capture_output=True, text=True, check=True)
    assert said.stdout.split()[-1] == str(CPU)


@here
def test_words_reach_the_command_as_they_are(groups: Groups) -> None:
    words = ["printf", "%s|", "a b", "$HOME", "'", ""]
    said = subprocess.run(groups.inside("B", words), capture_output=True, text=True, check=True)
    assert said.stdout == "a b|$HOME|'||"


@here
def test_stopped_and_frozen_processes_end_with_their_group(name: str) -> None:
    cgroups = find_cgroups()
    with Groups(name, SHARES, cgroups=cgroups) as groups:
        stopped = subprocess.Popen(groups.inside("A", ["sleep", "600"]))
        frozen = subprocess.Popen(groups.inside("B", ["sleep", "600"]))
        for process in (stopped, frozen):
            asleep(process)
        stopped.send_signal(signal.SIGSTOP)
        freeze(cgroups, name, "B")
    assert stopped.wait(PATIENCE_S) == frozen.wait(PATIENCE_S) == -signal.SIGKILL
    assert not any(folder.exists() for folder in cgroups.groups(group_name(name)))


def asleep(process: subprocess.Popen[bytes]) -> None:
    """Wait until it has entered its group and become what it is to be."""
    until = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{process.pid}/comm").read_text() != "sleep\n":
        assert time.monotonic() < until
        time.sleep(0.01)


def freeze(cgroups: Cgroups, name: str, node: str) -> None:
    for folder in cgroups.groups(group_name(name), node):
        for file, value in (("freezer.state", "FROZEN"), ("cgroup.freeze", "1")):
            if (folder / file).exists():
                (folder / file).write_text(value)
                return
    pytest.skip("this machine has no controller freezer")


@here
def test_processes_that_start_others_while_they_are_killed_all_end(groups: Groups) -> None:
    fork = 'while :; do sleep 600 & [ "$(jobs -p | wc -l)" -gt 30 ] && wait; done'
    with subprocess.Popen(groups.inside("B", ["sh", "-c", fork])):
        use_ns(groups, "B", 5_000_000)
        groups.kill("B")
        assert groups.pids("B") == []


@here
def test_a_name_that_is_taken_is_an_error_and_what_is_there_stays(
    groups: Groups, name: str
) -> None:
    with pytest.raises(LiveError, match="exists already"), Groups(name, {"Z": Share()}):
        pass
    assert groups.pids("A") == []


@here
def test_an_unknown_node_is_an_error(groups: Groups) -> None:
    with pytest.raises(LiveError, match="node 'X' has no group; nodes with a group: A, B"):
        groups.inside("X", ["true"])


def test_what_the_kernel_would_not_take_is_refused_before_anything_is_made() -> None:
    many = max(os.sched_getaffinity(0)) + 1
    shares = {"A": Share((many,)), "B": Share((), Quota(0.1, 4.0))}
    with pytest.raises(LiveError) as caught:
        Groups(own_name(), shares)
    first, second = str(caught.value).splitlines()
    assert first.startswith(f"nodes.A: CPU {many} is not available")
    assert second.startswith("nodes.B.quota: 0.1 CPU in every 4 ms is 0.4 ms per period")


# ------------------------------------------------------------------------- how they are laid out


def test_version_two_is_told_what_it_is_to_share(tmp_path: Path) -> None:
    """On files that stand for the kernel's: the machine of the tests has one version only."""
    (tmp_path / "cgroup.subtree_control").write_text("memory cpu")
    cgroups = Cgroups(2, {"cpu": tmp_path, "cpuset": tmp_path})
    groups = Groups("t", {"A": Share((CPU,), Quota(0.4, 4.0))}, cgroups=cgroups)
    groups.__enter__()
    group = tmp_path / "dwell-t" / "A"
    assert (tmp_path / "cgroup.subtree_control").read_text() == "+cpuset"
    assert (tmp_path / "dwell-t" / "cgroup.subtree_control").read_text() == "+cpu +cpuset"
    assert (tmp_path / "dwell-t" / "cpu.weight").read_text() == "10000"
    assert (group / "cpu.max").read_text() == "1600 4000"
    assert (group / "cpuset.cpus").read_text() == str(CPU)
    assert groups.inside("A", ["true"])[-1] == "true"
    (group / "cpu.stat").write_text("usage_usec 12\nuser_usec 12\nsystem_usec 0\n")
    assert groups.used_ns("A") == 12_000
