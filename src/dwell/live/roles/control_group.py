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


class Counts(NamedTuple):
    """CPU time used by a control group, ns; `UNKNOWN` if the kernel does not count it.

    Parameters
    ----------
    others_ns : int
        CPU time of all its processes except this one.
    group_ns : int
        CPU time of all its processes.
    """

    others_ns: int = UNKNOWN
    group_ns: int = UNKNOWN

    def others_since(self, before: Counts) -> int:
        """Return the CPU time of the other processes since then, ns."""
        if UNKNOWN in (before.others_ns, self.others_ns):
            return UNKNOWN
        return max(self.others_ns - before.others_ns, 0)


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
    """

    def __init__(self, counter: Path) -> None:
        self._nanoseconds = counter.name == COUNTERS["cgroup"]
        self._path, self._used = counter, _Counter(counter)

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
        return Counts(group_ns - own_ns, group_ns)


def own_group(process: Path = PROCESS) -> ControlGroup | None:
    """Return this process's control group; None for the root group or if counters are missing."""
    try:
        groups = groups_of((process / "cgroup").read_text())
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
            return ControlGroup(counter)
    return None


def _below(group: str, root: str) -> bool:
    return group == root or group.startswith(root.rstrip("/") + "/")


def groups_of(text: str) -> dict[str, str]:
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
