"""Control groups: what a node's counters say, in both versions of the kernel's interface."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from dwell.live.roles.control_group import ControlGroup, own_group

V1 = "31 23 0:28 / {at}/cpu rw - cgroup cgroup rw,cpu\n"
ACCOUNT = "32 23 0:29 {root} {at}/cpuacct rw - cgroup cgroup rw,cpuacct\n"
V2 = "33 23 0:30 / {at}/unified rw - cgroup2 cgroup2 rw\n"


def process_in(folder: Path, groups: Sequence[str], mounts: str, root: str = "/") -> Path:
    """Write what the kernel says of a process."""
    (folder / "cgroup").write_text("".join(f"{line}\n" for line in groups))
    (folder / "mountinfo").write_text(mounts.format(at=folder, root=root))
    return folder


def test_a_group_of_version_1_counts_nanoseconds(tmp_path: Path) -> None:
    process = process_in(
        tmp_path, ["2:cpuacct:/node-E", "1:cpu:/node-E", "0::/"], V1 + ACCOUNT + V2
    )
    assert own_group(process) is None
    (tmp_path / "cpuacct" / "node-E").mkdir(parents=True)
    (tmp_path / "cpuacct" / "node-E" / "cpuacct.usage").write_text("123456789\n")
    group = own_group(process)
    assert group is not None
    assert group.used_ns() == 123_456_789


def test_others_of_a_group_are_all_but_the_process_that_asks(tmp_path: Path) -> None:
    counter = tmp_path / "cpuacct.usage"
    counter.write_text("1000000000000\n")
    before_ns = time.process_time_ns()
    found = ControlGroup(counter).counts()
    assert before_ns <= 10**12 - found.others_ns <= time.process_time_ns()
    assert found.group_ns == 10**12


def test_a_group_of_version_2_counts_microseconds(tmp_path: Path) -> None:
    process = process_in(tmp_path, ["0::/dwell/node-E"], V2)
    (tmp_path / "unified" / "dwell" / "node-E").mkdir(parents=True)
    stat = "usage_usec 1234\nuser_usec 1000\nsystem_usec 234\n"
    (tmp_path / "unified" / "dwell" / "node-E" / "cpu.stat").write_text(stat)
    group = own_group(process)
    assert group is not None
    assert group.used_ns() == 1_234_000


@pytest.mark.parametrize(("root", "group"), [("/", "/"), ("/box", "/box"), ("/box", "/boxes/E")])
def test_the_root_is_no_group_of_its_own(tmp_path: Path, root: str, group: str) -> None:
    process = process_in(tmp_path, [f"2:cpuacct:{group}", "0::/"], ACCOUNT + V2, root)
    (tmp_path / "cpuacct").mkdir()
    (tmp_path / "unified").mkdir()
    (tmp_path / "cpuacct" / "cpuacct.usage").write_text("1\n")
    (tmp_path / "unified" / "cpu.stat").write_text("usage_usec 1\n")
    assert own_group(process) is None
    assert own_group(tmp_path / "nowhere") is None
