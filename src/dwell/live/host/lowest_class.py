"""Lowest scheduling class of the operating system, for threads that may only use idle CPU time."""

from __future__ import annotations

import os
from collections.abc import Callable


def take_lowest_class(who: str, say: Callable[[str], None]) -> None:
    """Set the lowest scheduling class for the calling thread and the threads that it starts.

    This is SCHED_IDLE on Linux (weight 3, compared with 1024 of a normal thread), elsewhere
    niceness 19. A thread with a real-time priority keeps it. If the system refuses the class, `say`
    gets a sentence that names the process `who`.
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
