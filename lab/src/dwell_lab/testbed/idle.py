"""Idle: check that the machine is idle before a run begins.

Two measures, each over a few seconds: the share of all CPUs' time in use, and the share of time in
which a runnable task waited for a CPU (PSI). The load average is unsuitable: it includes the
previous run for minutes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

PSI = Path("/proc/pressure/cpu")


class Counters(NamedTuple):
    """Counters of the machine since boot.

    `busy` and `all` are used and elapsed CPU time over all CPUs, seconds. `waited_s` is the time in
    which some task waited for a CPU; None if the kernel does not count it.
    """

    at_s: float
    busy: float
    all: float
    waited_s: float | None


@dataclass(frozen=True, slots=True)
class Quiet:
    """Bounds below which a machine counts as idle.

    `busy` is the largest share of CPU time, `waiting` the largest share of time in which a task
    waits for a CPU, and both must hold for `for_s`. After `patience_s` the run begins anyway, and
    its record states this.
    """

    busy: float = 0.15
    waiting: float = 0.1
    for_s: float = 3.0
    patience_s: float = 120.0


class Idle(NamedTuple):
    """State of the machine when a run began.

    `waited_s` is the time until the machine was idle or patience ended. `busy` and `waiting` are
    the shares (see `Quiet`) in the last interval.
    """

    idle: bool
    waited_s: float
    busy: float
    waiting: float | None


def sample() -> Counters:
    """Read the counters of this machine."""
    import psutil  # not needed to read the results of a campaign

    times = psutil.cpu_times()
    # User and nice time already include guest time.
    passed = sum(times) - times.guest - times.guest_nice
    return Counters(time.monotonic(), passed - times.idle - times.iowait, passed, waited_s())


def waited_s() -> float | None:
    """Return the total of ``some`` in /proc/pressure/cpu, s; None if unavailable."""
    try:
        line = PSI.read_text().splitlines()[0]
    except (OSError, IndexError):
        return None
    return float(line.rpartition("total=")[2]) / 1e6


def wait_until_idle(
    quiet: Quiet,
    *,
    read: Callable[[], Counters] = sample,
    sleep: Callable[[float], None] = time.sleep,
) -> Idle:
    """Wait until the machine has been idle for a while, or until patience ends."""
    begun = before = read()
    while True:
        sleep(quiet.for_s)
        now = read()
        passed, elapsed_s = now.all - before.all, now.at_s - before.at_s
        busy = (now.busy - before.busy) / passed if passed > 0 else 0.0
        waiting = None
        if before.waited_s is not None and now.waited_s is not None and elapsed_s > 0:
            waiting = round((now.waited_s - before.waited_s) / elapsed_s, 4)
        idle = busy <= quiet.busy and (waiting is None or waiting <= quiet.waiting)
        waited_s = now.at_s - begun.at_s
        if idle or waited_s >= quiet.patience_s:
            return Idle(idle, round(waited_s, 1), round(busy, 4), waiting)
        before = now
