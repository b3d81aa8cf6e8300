"""Checks of `dwell doctor` for live cells: CPUs, clocks, ports, certificates."""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from dwell.calibration.machine_conditions import STOLEN_MOST, MachineCounters, processor
from dwell.cli.findings import Finding, Part, optional
from dwell.errors import LiveError, TrustError, installing
from dwell.live.local.cgroups import find_cgroups
from dwell.live.roles.control_group import groups_of
from dwell.live.wire.local_addresses import is_here, taken_ports
from dwell.model import Host, Problem

#: Number of ports to check without a cell file.
DEFAULT_PORTS = 50
#: Clock sources whose reading is slow.
SLOW_CLOCKS = ("acpi_pm", "hpet", "jiffies", "refined-jiffies")


def checks(problem: Problem | None, keys: Path | None) -> Iterator[Part]:
    """Yield the findings about CPUs, clocks, ports and certificates."""
    yield Part("CPU", list(_cpu(MachineCounters(os.sched_getaffinity(0)))))
    yield Part("clocks", [_synchronised(), _clock_source()])
    yield Part("ports", [_ports(problem)])
    yield Part("certificates", list(_certificates(keys, problem)))


# ------------------------------------------------------------------------- CPU and clocks


def _cpu(counters: MachineCounters) -> Iterator[Finding]:
    """Yield the findings about the CPUs of this process, and their disturbances."""
    seen, usable = counters.conditions(), len(os.sched_getaffinity(0))
    yield Finding("CPUs", True, f"{usable} of {seen.cpus} for this process; {processor()}")
    quota = _quota()
    found = "none on this process" if quota is None else f"this process gets {quota:g} CPU at most"
    remedy = "start it in a control group without (docker --cpus, systemd CPUQuota=)"
    yield optional("quota", quota is None, found, remedy)
    governor = seen.governor or "not told, as in virtual machines"
    well = seen.governor in (None, "performance")
    remedy = "cpupower frequency-set --governor performance"
    yield optional("governor", well, governor, remedy)
    if seen.steal is not None:
        found = f"{seen.steal:.1%} of the time of these CPUs goes to other virtual machines"
        well = seen.steal <= STOLEN_MOST
        yield optional("steal", well, found, "a machine that is not shared")
    well = seen.load < seen.cpus
    found = f"{seen.load:.1f} threads wanted a CPU in the last minute; there are {seen.cpus}"
    yield optional("load", well, found, "measure when nothing else runs")


def _quota() -> float | None:
    """Return the smallest quota of this process's control group and its parents, in CPUs."""
    try:
        groups = find_cgroups()
        paths = groups_of(Path("/proc/self/cgroup").read_text(encoding="utf-8"))
        path = paths["cpu" if groups.version == 1 else ""]
    except (LiveError, OSError, KeyError):
        return None
    top = groups.folders["cpu"]
    folder = top / path.lstrip("/")
    around = (group for group in (folder, *folder.parents) if group.is_relative_to(top))
    quotas = map(_limit, around)
    return min((quota for quota in quotas if quota is not None), default=None)


def _limit(folder: Path) -> float | None:
    """Return the quota of a group in CPUs, if any."""
    with suppress(OSError, ValueError):
        quota, period = (folder / "cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    with suppress(OSError, ValueError):
        quota_us = int((folder / "cpu.cfs_quota_us").read_text())
        return None if quota_us < 0 else quota_us / int((folder / "cpu.cfs_period_us").read_text())
    return None


class _Timex(ctypes.Structure):
    """First fields of the structure of adjtimex(2)."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 512),
    )


def _synchronised() -> Finding:
    """Read from the kernel whether its clock is synchronised, without a change to the clock."""
    name, unsynchronised = "synchronised", 0x40
    state = _Timex()
    try:
        failed = ctypes.CDLL(None).adjtimex(ctypes.byref(state)) < 0
    except (AttributeError, OSError):
        failed = True
    if failed:
        return Finding(name, True, "not told by this system")
    if not state.status & unsynchronised:
        return Finding(name, True, f"to within {state.maxerror / 1e3:.1f} ms, says the kernel")
    found = "no; a cell with `clock: system` on several computers needs it, others do not"
    return optional(name, False, found, "apt-get install chrony")


def _clock_source() -> Finding:
    file = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    source = "unknown source"
    with suppress(OSError):
        source = file.read_text(encoding="utf-8").strip()
    found = f"{source}, {time.get_clock_info('monotonic').resolution * 1e9:.0f} ns"
    well = source not in SLOW_CLOCKS
    return optional("resolution", well, found, "boot with clocksource=tsc")


# ------------------------------------------------------------------------- ports and keys


def _ports(problem: Problem | None) -> Finding:
    """Check the ports of the cell's nodes on this computer, or the default ports of cells."""
    try:
        wanted = _ports_here(problem)
    except LiveError as error:
        return Finding("TCP", False, "; ".join(str(error).splitlines()), "mend live.hosts")
    if not wanted:
        return Finding("TCP", True, "no node of the cell is this computer")
    span = f"{min(wanted)} to {max(wanted)}"
    whom = taken_ports(wanted)
    if not whom:
        return Finding("TCP", True, f"{span} are free")
    remedy = "end it, or give the nodes in live.hosts other ports"
    return optional("TCP", False, f"of {span} are taken: {whom}", remedy)


def _ports_here(problem: Problem | None) -> set[int]:
    if problem is None or not problem.live.hosts:
        first = Host().port
        return set(range(first, first + DEFAULT_PORTS))
    try:
        from dwell.live.wire.wiring import PORTS_PER_ROLE, wire
    except ImportError:
        return {host.port for host in problem.live.hosts.values() if is_here(host.address)}
    ports: set[int] = set()
    wiring = wire(problem)
    for node, host in problem.live.hosts.items():
        if is_here(host.address):
            count = PORTS_PER_ROLE * len(list(wiring.on(node)))
            ports.update(range(host.port, host.port + count))
    return ports


def _certificates(keys: Path | None, problem: Problem | None) -> Iterator[Finding]:
    """Check a keyring, or all keyrings in a folder."""
    name = "keyring"
    if keys is None:
        yield Finding(name, True, "none is named, by --keys or DWELL_KEYS")
        return
    try:
        from dwell.live.trust.keyring import Keyring
    except ImportError:
        found = f"{keys} cannot be read without cryptography"
        yield Finding(name, False, found, installing("live"))
        return
    folders = [file.parent for file in sorted(keys.glob("*/cert.pem"))] or [keys]
    cell = None if problem is None else problem.name
    for folder in folders:
        try:
            keyring = Keyring.open(folder, cell=cell)
        except TrustError as error:
            yield Finding(name, False, str(error), "dwell keys issue")
            continue
        found = f"{keyring.own.common_name} in {folder} holds until {keyring.expires:%Y-%m-%d}"
        warning = keyring.warning()
        yield optional(name, not warning, warning or found, "dwell keys issue")
