"""Gives a process real-time priority, so that it runs as soon as something is due."""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct

from dwell.testbed.conditions import Scheduling

__all__ = ["come_first"]

# Linux lets timers of ordinary processes be 50 µs late to save power.
TIMER_SLACK = "/proc/self/timerslack_ns"
# The shortest time slice that Linux grants; the shorter it is, the sooner a process gets the CPU.
SLICE_NS = 100_000
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}


def come_first() -> Scheduling:
    """Get the CPU as soon as something is due, as far as the system lets this process.

    A real link does not wait for the CPU of a node that it connects; and foreign work is there to
    slow nodes, not links. Real-time priority does it, where the process may have it. Anybody may
    ask for short time slices (Linux 6.12), which halve the lateness beside busy threads.
    """
    with contextlib.suppress(OSError), open(TIMER_SLACK, "w") as slack:
        slack.write("1")
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        return "fifo"
    number = SCHED_SETATTR.get(os.uname().machine)
    # struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period.
    usual = struct.pack("=IIQiIQQQ", 48, os.SCHED_OTHER, 0, 0, 0, SLICE_NS, 0, 0)
    done = number is not None and ctypes.CDLL(None).syscall(number, 0, usual, 0) == 0
    return "short slices" if done else "usual"
