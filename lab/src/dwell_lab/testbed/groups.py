"""Control groups that emulate the CPUs of nodes: a quota, a set of CPUs, and the time used.

A quota is the kernel's CPU bandwidth control (Turner, Rao, Rao: CPU bandwidth control for CFS,
Linux Symposium 2010): in every period the group runs for at most the quota. All groups of a
testbed are in one group named ``dwell-NAME``, so other processes can find them.
"""

from __future__ import annotations

import os
import shlex
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from dwell.errors import LiveError
from dwell.live.local.cgroups import Cgroups, find_cgroups
from dwell.live.local.child import Started
from dwell.live.roles.control_group import COUNTERS, ControlGroup
from dwell.model import Quota

#: Limits of the kernel (kernel/sched/core.c: min_cfs_quota_period, max_cfs_quota_period).
MIN_US = 1_000
MAX_PERIOD_US = 1_000_000
# Longest wait for killed processes; a group with a quota takes longer to end.
GONE_S = 10.0
CHECK_S = 0.005


@dataclass(frozen=True, slots=True)
class Share:
    """Share of a node in this machine's CPUs: permitted CPUs (all if empty), and a quota."""

    cpus: tuple[int, ...] = ()
    quota: Quota | None = None

    def faults(self, node: str) -> list[str]:
        """Return why the kernel refuses the quota; empty if it accepts the quota."""
        if self.quota is None:
            return []
        period_us, quota_us = _microseconds(self.quota)
        faults = []
        if not MIN_US <= period_us <= MAX_PERIOD_US:
            period = f"{self.quota.period_ms:g}"
            faults.append(f"nodes.{node}.quota.period_ms: {period} is not between 1 and 1000")
        if quota_us < MIN_US:
            faults.append(
                f"nodes.{node}.quota: {self.quota.cpu:g} CPU in every {self.quota.period_ms:g} ms "
                f"is {quota_us / 1e3:g} ms per period; the kernel needs at least 1 ms: use a "
                "longer period"
            )
        return faults


def _missing(node: str, share: Share) -> list[str]:
    allowed = os.sched_getaffinity(0)
    if not (missing := sorted(set(share.cpus) - allowed)):
        return []
    asked, known = (", ".join(map(str, some)) for some in (missing, sorted(allowed)))
    return [f"nodes.{node}: CPU {asked} is not available; this process may use {known}"]


def _microseconds(quota: Quota) -> tuple[int, int]:
    """Return the period and the quota in it, µs."""
    return round(quota.period_ms * 1e3), round(quota.cpu * quota.period_ms * 1e3)


#: Group for the probes, with the same weight as a node's group. No node can have
#: this name.
PROBES = "~probes"


def group_name(name: str) -> str:
    """Return the name of the group that contains all groups of a testbed."""
    return f"dwell-{name}"


class Groups(Started):
    """Groups of processes, one per node; a context manager that kills all their processes at exit.

    `name` is the testbed's name. `cgroups` is where to create the groups, found if left out.

    Raises `LiveError` if this machine has no groups with quotas, or refuses these.
    """

    def __init__(
        self, name: str, shares: Mapping[str, Share], *, cgroups: Cgroups | None = None
    ) -> None:
        faults = [
            fault
            for node, share in shares.items()
            for fault in (*share.faults(node), *_missing(node, share))
        ]
        if faults:
            raise LiveError("\n".join(faults))
        super().__init__()
        self._cgroups = find_cgroups() if cgroups is None else cgroups
        self._parent = group_name(name)
        self._shares = dict(shares)

    def _start(self) -> None:
        for folder in self._cgroups.groups(self._parent):
            if folder.exists():
                raise LiveError(f"the group {folder} exists already; use another name")
        self._stack.callback(remove_group, self._parent, self._cgroups)
        try:
            self._make()
        except OSError as error:
            reason = f"{error.filename}: {error.strerror}"
            raise LiveError(f"no groups of processes can be made here ({reason})") from None

    def _make(self) -> None:
        for folder in self._cgroups.groups(self._parent):
            self._hand_down(folder.parent)
            folder.mkdir()
            if self._cgroups.version == 1:
                _inherit_cpus(folder)
            self._hand_down(folder)
        self._weigh()
        for node, share in self._shares.items():
            for folder in self._cgroups.groups(self._parent, node):
                folder.mkdir()
                if self._cgroups.version == 1:
                    _inherit_cpus(folder)
            if share.cpus and "cpuset" in self._cgroups.folders:
                cpus = ",".join(map(str, share.cpus))
                _write(self._folder("cpuset", node) / "cpuset.cpus", cpus)
            if share.quota is not None:
                self._limit(node, share.quota)

    def _hand_down(self, folder: Path) -> None:
        """Enable the controllers for the groups inside a group; version 2 needs this."""
        if self._cgroups.version == 1:
            return
        control = folder / "cgroup.subtree_control"
        has = control.read_text().split() if control.exists() else []
        if wanted := [name for name in self._cgroups.folders if name not in has]:
            _write(control, " ".join(f"+{name}" for name in wanted))

    def _weigh(self) -> None:
        """Set the weight of the testbed's group against all other processes of the machine.

        If every node has a quota, the weight is the maximum: the quotas already leave the machine
        its share, and no other process should reduce a node's quota. Otherwise it is the sum of
        the default weights of the nodes' groups.
        """
        folder, count = self._cgroups.folders["cpu"] / self._parent, max(1, len(self._shares))
        nodes = [share for name, share in self._shares.items() if name != PROBES]
        bounded = all(share.quota is not None for share in nodes)
        if self._cgroups.version == 2:
            _write(folder / "cpu.weight", str(10_000 if bounded else min(100 * count, 10_000)))
        else:
            _write(folder / "cpu.shares", str(262_144 if bounded else min(1_024 * count, 262_144)))

    def _limit(self, node: str, quota: Quota | None) -> None:
        folder = self._folder("cpu", node)
        period_us, quota_us = (None, None) if quota is None else _microseconds(quota)
        if self._cgroups.version == 2:
            _write(folder / "cpu.max", "max" if quota is None else f"{quota_us} {period_us}")
            return
        if quota is not None:
            _write(folder / "cpu.cfs_period_us", str(period_us))
        _write(folder / "cpu.cfs_quota_us", "-1" if quota is None else str(quota_us))

    @contextmanager
    def unlimited(self) -> Iterator[None]:
        """Lift the quotas for a while, as for starting processes.

        Raises `LiveError` if the kernel refuses.
        """
        limited = {node: share.quota for node, share in self._shares.items() if share.quota}
        try:
            for node in limited:
                self._limit(node, None)
        except OSError as error:
            raise LiveError(f"{error.filename}: {error.strerror}") from None
        try:
            yield
        finally:
            for node, quota in limited.items():
                self._limit(node, quota)

    def _folder(self, controller: str, node: str) -> Path:
        self._require(node)
        return self._cgroups.folders[controller] / self._parent / node

    def _require(self, node: str) -> None:
        if node not in self._shares:
            known = ", ".join(self._shares)
            raise LiveError(f"node {node!r} has no group; nodes with a group: {known}")

    def inside(self, node: str, words: Sequence[str]) -> list[str]:
        """Return a command that runs another command in a node's group, in the same process."""
        self._require(node)
        cpus = self._shares[node].cpus
        folders = " ".join(
            shlex.quote(str(folder)) for folder in self._cgroups.groups(self._parent, node)
        )
        enter = f'for to in {folders}; do echo 0 > "$to/cgroup.procs" || exit 126; done; exec "$@"'
        pinned: list[str] = []
        if cpus and "cpuset" not in self._cgroups.folders:
            pinned = ["taskset", "--cpu-list", ",".join(map(str, cpus))]
        return ["/bin/sh", "-c", enter, "sh", *pinned, *words]

    def used_ns(self, node: str) -> int:
        """Return the CPU time that a node's group has used since its creation."""
        of_v1 = self._cgroups.version == 1
        controller, counter = ("cpuacct", "cgroup") if of_v1 else ("cpu", "cgroup2")
        return ControlGroup(self._folder(controller, node) / COUNTERS[counter]).used_ns()

    def switches(self, node: str) -> dict[int, int]:
        """Return the number of voluntary context switches of each thread of a node."""
        counts = {}
        for pid in self.pids(node):
            with suppress(OSError):  # it has ended
                for folder in Path(f"/proc/{pid}/task").iterdir():
                    with suppress(OSError):
                        counts[int(folder.name)] = _voluntary((folder / "status").read_text())
        return counts

    def pids(self, node: str) -> list[int]:
        """Return the processes in a node's group."""
        return _pids(self._folder("cpu", node))

    def kill(self, node: str) -> None:
        """Kill all processes of a node, including stopped and frozen processes, and wait.

        Raises `LiveError` if some do not end.
        """
        self._require(node)
        _kill(self._cgroups.groups(self._parent, node))


def remove_group(parent: str, cgroups: Cgroups) -> None:
    """Kill all processes in a group and its inner groups, and remove them; a missing group is fine.

    Raises `LiveError` if a process does not end.
    """
    inner = {
        group.name
        for folder in cgroups.groups(parent)
        if folder.is_dir()
        for group in folder.iterdir()
        if group.is_dir()
    }
    for names in [*((parent, group) for group in sorted(inner)), (parent,)]:
        folders = [folder for folder in cgroups.groups(*names) if folder.is_dir()]
        _kill(folders)
        for folder in folders:
            _remove(folder)


def _voluntary(status: str) -> int:
    """Return the voluntary switches in a thread's status file (proc_pid_status(5))."""
    _, _, behind = status.partition("\nvoluntary_ctxt_switches:")
    return int(behind.split()[0]) if behind else 0


def _inherit_cpus(folder: Path) -> None:
    """Copy the parent's CPUs and memory to a group of v1, which starts with none."""
    for name in ("cpuset.mems", "cpuset.cpus"):
        if (folder / name).exists():
            _write(folder / name, (folder.parent / name).read_text().strip())


def _write(file: Path, value: str) -> None:
    try:
        file.write_text(value)
    except OSError as error:
        # The error of a refused write has no file name.
        raise OSError(error.errno, f"{error.strerror} for {value!r}", str(file)) from None


def _pids(folder: Path) -> list[int]:
    try:
        pids = [int(pid) for pid in (folder / "cgroup.procs").read_text().split()]
    except FileNotFoundError:
        return []
    # 0 means a process of another PID namespace; killing 0 would kill this process's group.
    return [pid for pid in pids if pid > 0]


def kill_all(
    pids: Callable[[], Collection[int]], place: str, thaw: Callable[[], None] = lambda: None
) -> None:
    """Kill processes until none is left, including processes started in the meantime.

    `pids` is called repeatedly and returns the living processes. `place` completes the message:
    ``in the group``. `thaw` is called after each round of signals, because frozen processes of
    cgroup v1 do not receive signals.

    Raises `LiveError` if some processes do not end.
    """
    until = time.monotonic() + GONE_S
    while alive := pids():
        for pid in alive:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        thaw()
        if time.monotonic() > until:
            raise LiveError(f"processes {', '.join(map(str, alive))} {place} do not end")
        time.sleep(CHECK_S)


def _kill(folders: Sequence[Path]) -> None:
    def alive() -> list[int]:
        return sorted({pid for folder in folders for pid in _pids(folder)})

    def thaw() -> None:
        for folder in folders:
            for name, value in (("freezer.state", "THAWED"), ("cgroup.freeze", "0")):
                if (folder / name).exists():
                    with suppress(OSError):
                        (folder / name).write_text(value)

    kill_all(alive, f"of {folders[0]}" if folders else "", thaw)


def _remove(folder: Path) -> None:
    until = time.monotonic() + GONE_S
    while True:
        try:
            folder.rmdir()
        except FileNotFoundError:
            return
        except OSError as error:
            if time.monotonic() > until:
                raise LiveError(f"{folder} cannot be removed ({error.strerror})") from None
            time.sleep(CHECK_S)
        else:
            return
