"""Doctor: test whether this machine can be a testbed, and report what is missing.

Everything created for a test is removed at once.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

from dwell.cli.findings import Finding, Part, optional
from dwell.errors import LiveError
from dwell.live.local.burner import STRESS_NG
from dwell.live.local.cgroups import find_cgroups
from dwell.model import Problem, Quota
from dwell_lab.testbed.allotment import FREE_CORES, FREE_OF_A_CORE, allot
from dwell_lab.testbed.groups import Groups, Share
from dwell_lab.testbed.hosts import Hosts
from dwell_lab.testbed.leftovers import Claim
from dwell_lab.testbed.pressure import Rule
from dwell_lab.testbed.probe import Probe
from dwell_lab.testbed.sampling import EVERY_S

#: Quota periods to try, shortest first; the kernel refuses short periods with small shares.
PERIODS_MS = (2.0, 4.0, 10.0, 20.0, 100.0)
SHARE = 0.5
#: A longer period hardly affects short tasks; this is short for tasks of some ten milliseconds.
SHORT_MS = 10.0
TRIAL_S = 0.3
#: CPU time over quota that a test accepts: the kernel lets a group overrun and corrects it later.
ALLOWANCE = 1.25
# Fixed names, so a later test can remove the remains of a killed test.
TRIALS = tuple(f"doctor-{number}" for number in range(8))
ALONE = "one"
PAIR = ("one", "two")
#: Window length for the watch if no cell sets it.
WINDOW_S = 2.0
PRIVILEGED = "run it as root; in a container, start that with --privileged"


def examine(problems: Sequence[Problem] = (), *, watch_s: float = 0.0) -> list[Finding]:
    """Check everything that a testbed needs from this machine.

    The quotas of all `problems` must fit together. For `watch_s` seconds the check watches for
    standstills, as on a virtual machine with a busy host; 0 skips it. The cells can run here if
    all needed findings are good.
    """
    return [
        _root(),
        _command("ip", "iproute2"),
        _command("nsenter", "util-linux"),
        *_tried(),
        _pinning(),
        _cores(problems),
        _command(STRESS_NG[0], STRESS_NG[0], "; Dwell uses its own busy loop", needed=False),
        _pressure(),
        _fifo(),
        *([_standstill(problems, watch_s)] if watch_s > 0 else ()),
    ]


def checks(problem: Problem | None, keys: Path | None) -> Iterator[Part]:
    """Yield the section of `dwell doctor` about testbeds."""
    found = examine([] if problem is None else [problem])
    rows = [optional(row.name, row.ok, row.found, row.remedy) for row in found]
    required = [row for row in found if row.needed]
    yield Part("testbed", rows, "dwell testbed", "live", required)


def _root() -> Finding:
    if os.geteuid() == 0:
        return Finding("root", True, "root")
    return Finding("root", False, f"user {os.geteuid()}", "sudo dwell testbed ...")


def _command(name: str, package: str, instead: str = "", *, needed: bool = True) -> Finding:
    if where := shutil.which(name):
        return Finding(name, True, where, needed=needed)
    found = f"not installed{instead}"
    return Finding(name, False, found, f"apt-get install {package}", needed=needed)


# ------------------------------------------------------------------------- what is tried


def _tried() -> list[Finding]:
    try:
        with ExitStack() as stack:
            name = _take_name(stack)
            return [
                _attempt("network namespaces", lambda: _hosts(name, [ALONE], []), PRIVILEGED),
                _attempt(
                    "TUN devices",
                    lambda: _hosts(name, PAIR, [PAIR]),
                    "modprobe tun; in a container, start that with --device /dev/net/tun",
                ),
                _attempt("CPU quotas", lambda: _quotas(name), PRIVILEGED),
                _shortest_period(name),
            ]
    except LiveError as error:
        return [Finding("trials", False, str(error), PRIVILEGED)]


def _take_name(stack: ExitStack) -> str:
    for name in TRIALS[:-1]:
        with suppress(LiveError):
            return stack.enter_context(Claim(name, PAIR)).name
    return stack.enter_context(Claim(TRIALS[-1], PAIR)).name


def _attempt(name: str, attempt: Callable[[], str], remedy: str) -> Finding:
    try:
        return Finding(name, True, attempt())
    except LiveError as error:
        return Finding(name, False, str(error), remedy)


def _hosts(name: str, nodes: Sequence[str], pairs: Sequence[tuple[str, str]]) -> str:
    with Hosts(name, nodes, pairs):
        return "made and removed"


def _quotas(name: str) -> str:
    cgroups = find_cgroups()
    with Groups(name, {ALONE: Share(quota=Quota(SHARE, 100.0))}, cgroups=cgroups):
        return str(cgroups)


def _shortest_period(name: str) -> Finding:
    what = "shortest period of a quota"
    said = "none was accepted"
    for period_ms in PERIODS_MS:
        try:
            used = _share_used(name, Quota(SHARE, period_ms))
        except LiveError as error:
            said = str(error)
            continue
        if used <= ALLOWANCE * SHARE:
            found = f"{period_ms:g} ms (a busy process with {SHARE:g} CPU got {used:.2f})"
            remedy = "" if (ok := period_ms <= SHORT_MS) else "another kernel"
            return Finding(what, ok, found, remedy)
        said = f"a busy process with {SHARE:g} CPU got {used:.2f}"
    return Finding(what, False, said, "a kernel with CFS_BANDWIDTH, and rights to use it")


def _share_used(name: str, quota: Quota) -> float:
    """Return the share of a CPU that a busy process gets under a quota."""
    with Groups(name, {ALONE: Share(quota=quota)}) as groups:
        words = groups.inside(ALONE, ["/bin/sh", "-c", "while :; do :; done"])
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as busy:  # noqa: S603 (our own words)
            try:
                used_ns, began_ns = groups.used_ns(ALONE), time.monotonic_ns()
                time.sleep(TRIAL_S)
                used_ns = groups.used_ns(ALONE) - used_ns
                return used_ns / (time.monotonic_ns() - began_ns)
            finally:
                busy.kill()


# ------------------------------------------------------------------------- what is looked up


def _pinning() -> Finding:
    name = "CPUs of a group"
    with suppress(LiveError):
        if "cpuset" in find_cgroups().folders:
            return Finding(name, True, "by cpuset")
    if shutil.which("taskset"):
        return Finding(name, True, "by affinity (no controller cpuset)")
    return Finding(name, False, "no cpuset, no taskset", "apt-get install util-linux")


def _cores(problems: Sequence[Problem]) -> Finding:
    cpus = sorted(os.sched_getaffinity(0))
    most = len(cpus) - FREE_CORES
    free = f"{most:g} for nodes, at most {1 - FREE_OF_A_CORE:g} of each"
    found = f"{len(cpus)} ({free})"
    if most <= 0:
        return Finding("CPUs", False, found, "a machine with more CPUs")
    if not problems:
        return Finding("CPUs", True, found)
    try:
        shares = allot(problems, cpus)
    except LiveError as error:
        return Finding("CPUs", False, str(error), "smaller quotas, or a machine with more CPUs")
    told = ", ".join(
        f"{node} on {','.join(map(str, share.cpus))}" for node, share in shares.items()
    )
    return Finding("CPUs", True, f"{found}: {told}")


def _pressure() -> Finding:
    name = "pressure (PSI)"
    try:
        Path("/proc/pressure/cpu").read_text()
    except OSError as error:
        found = f"/proc/pressure/cpu: {error.strerror}"
        return Finding(name, False, found, "boot with psi=1", needed=False)
    return Finding(name, True, "/proc/pressure/cpu", needed=False)


def _fifo() -> Finding:
    name = "real-time priority (SCHED_FIFO)"
    try:
        with ThreadPoolExecutor(1) as thread:  # the priority is that thread's, which ends at once
            thread.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)).result()
    except OSError as error:
        found = f"refused ({error.strerror}); links may be late while CPUs are busy"
        return Finding(name, False, found, PRIVILEGED, needed=False)
    return Finding(name, True, "granted", needed=False)


# ------------------------------------------------------------------------- what takes a while


def _standstill(problems: Sequence[Problem], watch_s: float) -> Finding:
    """Watch idle CPUs for standstills, which would also stop a testbed run."""
    name, rule = "no standstills", Rule()
    window_s = min((one.window_ms / 1e3 for one in problems), default=WINDOW_S)
    try:
        late_ms = _lateness(watch_s)
    except LiveError as error:
        return Finding(name, False, str(error), needed=False)
    stalls = {at_s: ms for at_s, ms in late_ms.items() if ms > rule.stall_ms}
    windows = math.ceil(watch_s / window_s)
    # The last reading may be a little late.
    share = len({min(int(at_s / window_s), windows - 1) for at_s in stalls}) / windows
    watched = f"in {watch_s:g} s the longest was {max(late_ms.values(), default=0.0):.1f} ms"
    if not stalls:
        return Finding(name, True, watched, needed=False)
    found = (
        f"{watched}; {share:.0%} of the windows of {window_s:.3g} s had one longer than "
        f"{rule.stall_ms:g} ms; a run fails above {rule.excluded_most:.0%}"
    )
    remedy = "another time of day, or a machine without other users"
    ok = share <= rule.excluded_most
    return Finding(name, ok, found, "" if ok else remedy, needed=False)


def _lateness(watch_s: float) -> dict[float, float]:
    """Largest lateness of a probe on any CPU, ms, by the time of each reading, s."""
    late_ms = {}
    with ExitStack() as stack:
        probes = [stack.enter_context(Probe(cpu)) for cpu in sorted(os.sched_getaffinity(0))]
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < watch_s:
            time.sleep(EVERY_S)
            at_s = time.monotonic() - begun_s
            late_ms[at_s] = max(probe.read().max_ms for probe in probes)
    return late_ms
