"""The lowest class of the system's scheduler: for what runs on what all others leave of a CPU."""

from __future__ import annotations

import os
from collections.abc import Callable


def take_lowest_class(who: str, say: Callable[[str], None]) -> None:
    """Give the calling thread, and those that it starts, what others leave of the CPUs.

    Linux has SCHED_IDLE, whose threads weigh 3 beside 1024; elsewhere it is niceness 19. A thread
    that has a real-time priority keeps it. A system without either is told of, once.

    Parameters
    ----------
    who : str
        Name of the process, for what is said.
    say : callable
        Where the sentence goes.
    """
    try:
        if hasattr(os, "SCHED_IDLE"):
            if os.sched_getscheduler(0) == os.SCHED_OTHER:
                os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        else:
            os.nice(19)
    except (OSError, AttributeError) as error:
        why = error.strerror if isinstance(error, OSError) else "this system has none"
        say(f"{who}: no low scheduling class ({why}): shadow jobs compete with the cell's own")
