"""CPU time of this process's control group, from the kernel's counters."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from dwell.errors import LiveError

UNKNOWN = -1
PROCESS = Path("/proc/self")
#: File with the CPU time in a group's folder, in versions 1 and 2.
COUNTERS = {"cgroup": "cpuacct.usage", "cgroup2": "cpu.stat"}
#: File with the CPU time per CPU, only in version 1.
BY_CPU = "cpuacct.usage_percpu"


class Counts(NamedTuple):
    """CPU time used by others than this process, ns; `UNKNOWN` if the kernel does not count it.

    Parameters
    ----------
    others_ns : int
        CPU time of the other processes of its group.
    outside_ns : int
        CPU time of processes outside the group, on the CPUs that this process may use; version 2
        does not count it.
    group_ns : int
        CPU time of its group, including this process.
    """

    others_ns: int = UNKNOWN
    outside_ns: int = UNKNOWN
    group_ns: int = UNKNOWN

    def since(self, before: Counts) -> tuple[int, int]:
        """Return the CPU time since then of others in the group, and of processes outside, ns."""
        others_ns, outside_ns = (
            UNKNOWN if UNKNOWN in (then, now) else max(now - then, 0)
            for then, now in zip(before[:2], self[:2], strict=True)
        )
        return others_ns, outside_ns


class _Counter:
    """A counter file of the kernel; it stays open between reads."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: int | None = None

    def read(self) -> bytes:
        """Return the current content; raise an OSError if it cannot be read."""
        if self._file is None:
            self._file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
        return os.pread(self._file, 1 << 16, 0)

    def __del__(self) -> None:
        if self._file is not None:
            os.close(self._file)


class ControlGroup:
    """A control group; its files stay open, because workers read them twice per job.

    Parameters
    ----------
    counter : Path
        ``cpuacct.usage`` (version 1, nanoseconds) or ``cpu.stat`` (version 2, microseconds).
    root : Path
        Folder of the root group.
    """

    def __init__(self, counter: Path, root: Path = Path()) -> None:
        self._nanoseconds = counter.name == COUNTERS["cgroup"]
        self._path, self._used = counter, _Counter(counter)
        self._by_cpu = [_Counter(folder / BY_CPU) for folder in (root, counter.parent)]

    def used_ns(self) -> int:
        """Return the CPU time of all its processes, including ended ones, ns.

        Raises a LiveError if it cannot be read.
        """
        # Reading this clock first adds this thread's CPU time to the group's counter.
        time.process_time_ns()
        try:
            text = self._used.read()
            if self._nanoseconds:
                return int(text)
            return int(dict(line.split() for line in text.splitlines())[b"usage_usec"]) * 1000
        except (OSError, ValueError, KeyError) as error:
            raise LiveError(f"{self._path}: cannot be read ({error})") from None

    def taken_ns(self) -> int:
        """Return `used_ns`, or `UNKNOWN` if it cannot be read."""
        try:
            return self.used_ns()
        except LiveError:
            return UNKNOWN

    def counts(self) -> Counts:
        """Return the CPU time of others up to now."""
        own_ns = time.process_time_ns()
        group_ns = self.taken_ns()
        if group_ns == UNKNOWN:
            return Counts()
        return Counts(group_ns - own_ns, self._outside_ns(), group_ns)

    def _outside_ns(self) -> int:
        taken, cpus = [], os.sched_getaffinity(0)
        for counter in self._by_cpu:
            try:
                by_cpu = counter.read().split()
                taken.append(sum(int(by_cpu[cpu]) for cpu in cpus))
            except (OSError, ValueError, IndexError):
                return UNKNOWN
        return taken[0] - taken[1]


def own_group(process: Path = PROCESS) -> ControlGroup | None:
    """Return this process's control group; None for the root group or if counters are missing."""
    try:
        groups = _groups((process / "cgroup").read_text())
        mounts = list(cgroup_mounts((process / "mountinfo").read_text()))
    except OSError:
        return None
    for kind, options, root, folder in mounts:
        wanted = "cpuacct" if kind == "cgroup" else ""
        group = groups.get(wanted)
        if group is None or wanted not in ("", *options) or not _below(group, root):
            continue
        counter = folder / group.removeprefix(root).lstrip("/") / COUNTERS[kind]
        if group != root and counter.is_file():
            return ControlGroup(counter, folder)
    return None


def _below(group: str, root: str) -> bool:
    return group == root or group.startswith(root.rstrip("/") + "/")


def _groups(text: str) -> dict[str, str]:
    """Return the group in each hierarchy, by controller; version 2 has the empty name."""
    found = {}
    for line in text.splitlines():
        _, controllers, group = line.split(":", 2)
        found.update(dict.fromkeys(controllers.split(","), group))
    return found


def cgroup_mounts(text: str) -> Iterator[tuple[str, list[str], str, Path]]:
    """Yield kind, options, root and folder of each mounted hierarchy (proc_pid_mountinfo(5))."""
    for line in text.splitlines():
        before, _, after = line.partition(" - ")
        words = after.split()
        if words and words[0] in COUNTERS:
            root, place = before.split()[3:5]
            folder = os.fsdecode(place.encode().decode("unicode_escape"))
            yield words[0], words[2].split(","), root, Path(folder)
