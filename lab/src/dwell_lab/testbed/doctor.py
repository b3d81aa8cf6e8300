"""Doctor: test whether this machine can be a testbed, and report what is missing.

Everything created for a test is removed at once.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from dwell.cli.findings import Check, Finding, Part, optional
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


def checks_for(problems: Sequence[Problem] = (), *, watch_s: float = 0.0) -> list[Check]:
    """Return all checks of a machine for testbeds, each with its remedy.

    The quotas of all `problems` must fit together. For `watch_s` seconds the last check watches for
    standstills, as on a virtual machine with a busy host; 0 leaves it out.
    """
    watch = partial(_standstill, problems, watch_s)
    another = "another time of day, or a machine without other users"
    return [
        Check("root", _root, "sudo dwell testbed ..."),
        _command("ip", "iproute2"),
        _command("nsenter", "util-linux"),
        Check("network namespaces", partial(_hosts, [ALONE], []), PRIVILEGED),
        Check(
            "TUN devices",
            partial(_hosts, PAIR, [PAIR]),
            "modprobe tun; in a container, start that with --device /dev/net/tun",
        ),
        Check("CPU quotas", _quotas, PRIVILEGED),
        Check(
            "shortest period of a quota",
            _shortest_period,
            "a kernel with CFS_BANDWIDTH and short periods, and rights to use it",
        ),
        Check("CPUs of a group", _pinning, "apt-get install util-linux"),
        Check("CPUs", partial(_cores, problems), "smaller quotas, or a machine with more CPUs"),
        _command(STRESS_NG[0], STRESS_NG[0], "; Dwell uses its own busy loop", needed=False),
        Check("pressure (PSI)", _pressure, "boot with psi=1", needed=False),
        Check("real-time priority (SCHED_FIFO)", _fifo, PRIVILEGED, needed=False),
        *([Check("no standstills", watch, another, needed=False)] if watch_s > 0 else ()),
    ]


def examine(problems: Sequence[Problem] = (), *, watch_s: float = 0.0) -> list[Finding]:
    """Run all checks. The cells can run here if all needed findings are good."""
    return [check.finding() for check in checks_for(problems, watch_s=watch_s)]


def checks(problem: Problem | None, keys: Path | None) -> Iterator[Part]:
    """Yield the section of `dwell doctor` about testbeds."""
    found = examine([] if problem is None else [problem])
    rows = [optional(row.name, row.ok, row.found, row.remedy) for row in found]
    required = [row for row in found if row.needed]
    yield Part("testbed", rows, "dwell testbed", "live", required)


def _root() -> tuple[bool, str]:
    return os.geteuid() == 0, f"user {os.geteuid()}" if os.geteuid() else "root"


def _command(name: str, package: str, instead: str = "", *, needed: bool = True) -> Check:
    def look() -> tuple[bool, str]:
        where = shutil.which(name)
        return where is not None, where or f"not installed{instead}"

    return Check(name, look, f"apt-get install {package}", needed)


# ------------------------------------------------------------------------- what is tried


@contextmanager
def _trial() -> Iterator[str]:
    """Take a name for a trial, and release it at the end."""
    with ExitStack() as stack:
        for name in TRIALS[:-1]:
            with suppress(LiveError):
                stack.enter_context(Claim(name, PAIR))
                break
        else:
            name = stack.enter_context(Claim(TRIALS[-1], PAIR)).name
        yield name


def _hosts(nodes: Sequence[str], pairs: Sequence[tuple[str, str]]) -> tuple[bool, str]:
    with _trial() as name, Hosts(name, nodes, pairs):
        return True, "made and removed"


def _quotas() -> tuple[bool, str]:
    cgroups, quota = find_cgroups(), Quota(SHARE, 100.0)
    with _trial() as name, Groups(name, {ALONE: Share(quota=quota)}, cgroups=cgroups):
        return True, str(cgroups)


def _shortest_period() -> tuple[bool, str]:
    said = "none was accepted"
    for period_ms in PERIODS_MS:
        try:
            used = _share_used(Quota(SHARE, period_ms))
        except LiveError as error:
            said = str(error)
            continue
        said = f"a busy process with {SHARE:g} CPU got {used:.2f}"
        if used <= ALLOWANCE * SHARE:
            return period_ms <= SHORT_MS, f"{period_ms:g} ms ({said})"
    return False, said


def _share_used(quota: Quota) -> float:
    """Return the share of a CPU that a busy process gets under a quota."""
    with _trial() as name, Groups(name, {ALONE: Share(quota=quota)}) as groups:
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


def _pinning() -> tuple[bool, str]:
    with suppress(LiveError):
        if "cpuset" in find_cgroups().folders:
            return True, "by cpuset"
    if shutil.which("taskset"):
        return True, "by affinity (no controller cpuset)"
    return False, "no cpuset, no taskset"


def _cores(problems: Sequence[Problem]) -> tuple[bool, str]:
    cpus = sorted(os.sched_getaffinity(0))
    most = len(cpus) - FREE_CORES
    free = f"{most:g} for nodes, at most {1 - FREE_OF_A_CORE:g} of each"
    found = f"{len(cpus)} ({free})"
    if most <= 0 or not problems:
        return most > 0, found
    shares = allot(problems, cpus).items()
    told = ", ".join(f"{node} on {','.join(map(str, share.cpus))}" for node, share in shares)
    return True, f"{found}: {told}"


def _pressure() -> tuple[bool, str]:
    file = Path("/proc/pressure/cpu")
    try:
        file.read_text()
    except OSError as error:
        return False, f"{file}: {error.strerror}"
    return True, str(file)


def _fifo() -> tuple[bool, str]:
    try:
        with ThreadPoolExecutor(1) as thread:  # the priority is that thread's, which ends at once
            thread.submit(os.sched_setscheduler, 0, os.SCHED_FIFO, os.sched_param(1)).result()
    except OSError as error:
        return False, f"refused ({error.strerror}); links may be late while CPUs are busy"
    return True, "granted"


# ------------------------------------------------------------------------- what takes a while


def _standstill(problems: Sequence[Problem], watch_s: float) -> tuple[bool, str]:
    """Watch idle CPUs for standstills, which would also stop a testbed run."""
    rule = Rule()
    window_s = min((one.window_ms / 1e3 for one in problems), default=WINDOW_S)
    late_ms = _lateness(watch_s)
    stalls = {at_s: ms for at_s, ms in late_ms.items() if ms > rule.stall_ms}
    windows = math.ceil(watch_s / window_s)
    # The last reading may be a little late.
    share = len({min(int(at_s / window_s), windows - 1) for at_s in stalls}) / windows
    watched = f"in {watch_s:g} s the longest was {max(late_ms.values(), default=0.0):.1f} ms"
    if not stalls:
        return True, watched
    found = (
        f"{watched}; {share:.0%} of the windows of {window_s:.3g} s had one longer than "
        f"{rule.stall_ms:g} ms; a run fails above {rule.excluded_most:.0%}"
    )
    return share <= rule.excluded_most, found


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
