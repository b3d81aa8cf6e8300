"""`dwell doctor`: what this computer has for Dwell, what it lacks, and the line that mends it."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version
from pathlib import Path

import typer

import dwell
from dwell.calibration.machine_conditions import MachineCounters, processor
from dwell.cli.output import print_json
from dwell.errors import DISTRIBUTION, OPTIONAL, KernelError, LiveError, TrustError, installing
from dwell.kernels import library
from dwell.kernels.library_file import NAME
from dwell.live.local_addresses import is_here, taken_ports
from dwell.model import Host, Problem
from dwell.testbed import doctor as testbed_doctor
from dwell.testbed.cgroups import find_cgroups
from dwell.testbed.doctor import Finding
from dwell.testbed.pressure import Rule

#: What each extra is for.
EXTRAS = {
    "sim": "dwell run, study, demo, validate",
    "report": "dwell report",
    "live": "dwell live, agent, controller, keys",
    "mcap": "dwell report --mcap, dwell dash --mcap",
    "dask": "dwell study --dask",
    "dash": "dwell dash",
}
#: How many ports are looked at where no cell says which.
DEFAULT_PORTS = 50
#: Clocks that take long to be read.
SLOW_CLOCKS = ("acpi_pm", "hpet", "jiffies", "refined-jiffies")


def consult(problem: Problem | None, *, keys: Path | None, as_json: bool) -> bool:
    """Look at everything and print it.

    Parameters
    ----------
    keys : Path or None
        A keyring, or a folder of keyrings.

    Returns
    -------
    bool
        Whether nothing is broken; what is merely not installed is not.
    """
    counters = MachineCounters(os.sched_getaffinity(0))
    extras = [_extra(name) for name in EXTRAS]
    kernel = _kernel()
    testbed = testbed_doctor.examine([] if problem is None else [problem])
    parts = {
        "extras": extras,
        "kernel": [kernel],
        "CPU": list(_cpu(counters)),
        "clocks": [_synchronised(), _clock_source()],
        "ports": [_ports(problem)],
        "certificates": list(_certificates(keys, problem)),
        "testbed": [_optional(row.name, row.ok, row.found, row.remedy) for row in testbed],
        "runs here": list(_runs(extras, kernel, testbed)),
    }
    well = all(row.ok or not row.needed for rows in parts.values() for row in rows)
    if as_json:
        findings = [{"part": part, **asdict(row)} for part, rows in parts.items() for row in rows]
        print_json({"ok": well, "version": dwell.__version__, "findings": findings})
        return well
    system = f"{platform.system()} {platform.release()} ({platform.machine()})"
    typer.echo(f"dwell {dwell.__version__}, Python {platform.python_version()}, {system}")
    for part, rows in parts.items():
        typer.echo(f"\n{part}")
        print_findings(rows, broken="BROKEN", lacking="note")
    return well


def _optional(name: str, ok: bool, found: str, remedy: str = "") -> Finding:
    """Return a finding on what Dwell can do without; its remedy is there where it is not well."""
    return Finding(name, ok, found, "" if ok else remedy, needed=False)


def print_findings(findings: Iterable[Finding], *, broken: str, lacking: str) -> None:
    """Print findings, each with its remedy below; long lines are broken on a terminal.

    Parameters
    ----------
    broken, lacking : str
        Marks of what is needed and not well, and of what is not well and not needed.
    """
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
    for finding in findings:
        mark = "ok" if finding.ok else broken if finding.needed else lacking
        lines = [f"{mark:8} {finding.name}: {finding.found}"]
        lines += [f"{'':8} {finding.remedy}"] * bool(not finding.ok and finding.remedy)
        for line in lines:
            indent = " " * 9
            typer.echo(
                textwrap.fill(line, columns, subsequent_indent=indent, break_on_hyphens=False)
            )


# ------------------------------------------------------------------------- extras and kernel


@cache
def _modules() -> dict[str, str]:
    """Return the module of every optional package, by the package; looks at all installed ones."""
    packages = packages_distributions()
    return {package: module for module in OPTIONAL for package in packages.get(module, ())}


def _extra(name: str) -> Finding:
    """Import what an extra brings: installed is not enough."""
    try:
        lines = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        found = f"{DISTRIBUTION} itself is not installed, only its sources are there"
        return _optional(name, False, found, installing(name))
    modules = _modules()
    wanted = [
        re.split(r"[^\w.-]", line)[0]
        for line in lines
        if re.search(rf"extra == ['\"]{name}['\"]", line)
    ]
    missing, failed, there = [], [], []
    for package in wanted:
        try:
            there.append(f"{package} {version(package)}")
            if package in modules:
                import_module(modules[package])
        except PackageNotFoundError:
            missing.append(package)
        except Exception as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            failed.append(f"{package} cannot be imported: {reason}")
    if failed:
        again = installing(name).replace("install", "install --force-reinstall")
        return Finding(name, False, "; ".join(failed), again)
    if missing:
        found = f"not installed: {', '.join(missing)}"
        return _optional(name, False, found, installing(name))
    return Finding(name, True, ", ".join(there))


def _kernel() -> Finding:
    """Load the compiled kernel; who does not simulate needs none, but none that is damaged."""
    name = "compiled kernel"
    try:
        found = f"of the sources {library.digest()[:12]}, by {library.compiler()}"
    except KernelError as error:
        there = Path(library.__file__).with_name(NAME).is_file()
        return Finding(name, False, error.flaw, error.remedy, needed=there)
    return Finding(name, True, found)


# ------------------------------------------------------------------------- CPU and clocks


def _cpu(counters: MachineCounters) -> Iterator[Finding]:
    """Yield what this process may use, and what disturbs it."""
    seen, usable = counters.conditions(), len(os.sched_getaffinity(0))
    yield Finding("CPUs", True, f"{usable} of {seen.cpus} for this process; {processor()}")
    quota = _quota()
    found = "none on this process" if quota is None else f"this process gets {quota:g} CPU at most"
    remedy = "start it in a control group without (docker --cpus, systemd CPUQuota=)"
    yield _optional("quota", quota is None, found, remedy)
    governor = seen.governor or "not told, as in virtual machines"
    well = seen.governor in (None, "performance")
    remedy = "cpupower frequency-set --governor performance"
    yield _optional("governor", well, governor, remedy)
    if seen.steal is not None:
        found = f"{seen.steal:.1%} of the time of these CPUs goes to other virtual machines"
        well = seen.steal <= Rule().stolen_most
        yield _optional("steal", well, found, "a machine that is not shared")
    well = seen.load < seen.cpus
    found = f"{seen.load:.1f} threads wanted a CPU in the last minute; there are {seen.cpus}"
    yield _optional("load", well, found, "measure when nothing else runs")


def _quota() -> float | None:
    """Return the CPUs that the quotas of this process's group and those around it leave it."""
    try:
        groups = find_cgroups()
        lines = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (LiveError, OSError):
        return None
    top = groups.folders["cpu"]
    quotas = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers.split(",").count("cpu" if groups.version == 1 else ""):
            folder = top / path.lstrip("/")
            around = (group for group in (folder, *folder.parents) if group.is_relative_to(top))
            quotas += [_limit(group) for group in around]
    return min((quota for quota in quotas if quota is not None), default=None)


def _limit(folder: Path) -> float | None:
    """Return the quota of one group, CPUs."""
    with suppress(OSError, ValueError):
        quota, period = (folder / "cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    with suppress(OSError, ValueError):
        quota_us = int((folder / "cpu.cfs_quota_us").read_text())
        return None if quota_us < 0 else quota_us / int((folder / "cpu.cfs_period_us").read_text())
    return None


class _Timex(ctypes.Structure):
    """The head of what adjtimex(2) fills in."""

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
    """Ask the kernel whether something keeps its clock right; nothing is set."""
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
    return _optional(name, False, found, "apt-get install chrony")


def _clock_source() -> Finding:
    file = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    source = "unknown source"
    with suppress(OSError):
        source = file.read_text(encoding="utf-8").strip()
    found = f"{source}, {time.get_clock_info('monotonic').resolution * 1e9:.0f} ns"
    well = source not in SLOW_CLOCKS
    return _optional("resolution", well, found, "boot with clocksource=tsc")


# ------------------------------------------------------------------------- ports and keys


def _ports(problem: Problem | None) -> Finding:
    """Look at the ports of the nodes that are this computer, or at the first that cells take."""
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
    return _optional("TCP", False, f"of {span} are taken: {whom}", remedy)


def _ports_here(problem: Problem | None) -> set[int]:
    if problem is None or not problem.live.hosts:
        first = Host().port
        return set(range(first, first + DEFAULT_PORTS))
    try:
        from dwell.live.wiring import PORTS_PER_ROLE, wire
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
    """Look at a keyring, or at all in a folder."""
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
        yield _optional(name, not warning, warning or found, "dwell keys issue")


# ------------------------------------------------------------------------- what runs here


def _runs(
    extras: Sequence[Finding], kernel: Finding, testbed: Sequence[Finding]
) -> Iterator[Finding]:
    """Yield what works on this computer, by what was found before."""
    named = {extra.name: replace(extra, name=f"the extra {extra.name}") for extra in extras}
    needs = {
        **{EXTRAS[name]: [extra] for name, extra in named.items()},
        EXTRAS["sim"]: [named["sim"], kernel],
        "dwell testbed": [named["live"], *(part for part in testbed if part.needed)],
    }
    for commands, needed in needs.items():
        lacking = [need for need in needed if not need.ok]
        remedies = dict.fromkeys(need.remedy for need in lacking if need.remedy)
        names = ", ".join(need.name for need in lacking)
        found = f"not without {names}" if lacking else "yes"
        yield _optional(commands, not lacking, found, "; ".join(remedies))
