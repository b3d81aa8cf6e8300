"""Where control groups are found."""

from __future__ import annotations

from pathlib import Path

import pytest

from dwell.errors import LiveError
from dwell.live.local.cgroups import Cgroups, find_cgroups

MOUNTS = """\
30 23 0:26 / /sys/fs/cgroup rw - tmpfs tmpfs rw,mode=755
31 30 0:27 / {top}/cpu,cpuacct rw - cgroup cgroup rw,cpu,cpuacct
32 30 0:28 / {top}/two\\040words rw - cgroup cgroup rw,cpuset
33 30 0:29 / {top}/unified rw - cgroup2 cgroup2 rw
"""


def test_controllers_are_found_where_they_are_mounted(tmp_path: Path) -> None:
    mounts = tmp_path / "mountinfo"
    mounts.write_text(MOUNTS.format(top=tmp_path))
    both = tmp_path / "cpu,cpuacct"
    found = find_cgroups(mounts)
    assert found == Cgroups(1, {"cpu": both, "cpuacct": both, "cpuset": tmp_path / "two words"})
    assert found.groups("x") == [both / "x", tmp_path / "two words" / "x"]
    (tmp_path / "unified").mkdir()
    (tmp_path / "unified" / "cgroup.controllers").write_text("cpu memory\n")
    assert find_cgroups(mounts) == Cgroups(2, {"cpu": tmp_path / "unified"})


def test_no_controller_for_the_cpu_is_an_error(tmp_path: Path) -> None:
    mounts = tmp_path / "mountinfo"
    mounts.write_text(MOUNTS.format(top=tmp_path).replace("cpuacct", "perf_event"))
    with pytest.raises(LiveError, match="no control groups for the CPU"):
        find_cgroups(mounts)
