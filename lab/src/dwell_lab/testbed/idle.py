"""Idle: whether the machine does nothing else before a run begins.

Two signs, both over a few seconds: the share of all CPUs' time that anything took, and the share of
time in which something that could have run waited for a CPU (PSI). The load average is none: it
remembers the run before for minutes.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

PSI = Path("/proc/pressure/cpu")


class Counters(NamedTuple):
    """Counters of the machine since it was started.

    Parameters
    ----------
    busy, all : float
        CPU time that was used and that passed, all CPUs together, seconds.
    waited_s : float or None
        Time in which something waited for a CPU; None where the kernel does not say.
    """

    at_s: float
    busy: float
    all: float
    waited_s: float | None


@dataclass(frozen=True, slots=True)
class Quiet:
    """Bounds below which a machine counts as idle.

    Parameters
    ----------
    busy : float
        Share of the CPUs' time at most.
    waiting : float
        Share of the time at most in which something waits for a CPU.
    for_s : float
        How long both have to hold.
    patience_s : float
        How long that is waited for; then the run begins anyway, and its record says so.
    """

    busy: float = 0.15
    waiting: float = 0.1
    for_s: float = 3.0
    patience_s: float = 120.0


class Idle(NamedTuple):
    """State of the machine when a run began.

    Parameters
    ----------
    waited_s : float
        Until it was, or until patience was over.
    busy : float
        Share of the CPUs' time in the last stretch.
    waiting : float or None
        Share of the time in which something waited for a CPU in the last stretch.
    """

    idle: bool
    waited_s: float
    busy: float
    waiting: float | None


def sample() -> Counters:
    """Read the counters of this machine."""
    import psutil  # what a campaign has measured is read without it

    times = psutil.cpu_times()
    # Guests are in user and nice already.
    passed = sum(times) - times.guest - times.guest_nice
    return Counters(time.monotonic(), passed - times.idle - times.iowait, passed, waited_s())


def waited_s() -> float | None:
    """Time of ``some`` in /proc/pressure/cpu."""
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
    """Wait until the machine has been idle for a while, or for as long as patience lasts."""
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
