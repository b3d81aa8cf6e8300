"""Leash: a process that ends with another one, whatever becomes of those in between.

The processes of a cell outlive their agent, so that it can be started again. Where a whole cell
belongs to one process (the demo, a test), its variable `OWNER` says so to all of them, and none of
them is left when that process has ended, even if it was killed.
"""

from __future__ import annotations

import os
import select
import threading
import time

__all__ = ["OWNER", "end_with_owner"]

#: Environment variable: id of the process that all others of a cell end with.
OWNER = "DWELL_OWNER"
#: What does not end by itself within this time after its owner is ended.
PATIENCE_S = 8.0
#: All see at once that their owner has ended. Zenoh removes a segment of shared memory with the
#: last that lets go of it; where two do at the same instant it stays until a Zenoh starts again. So
#: each waits for one of so many turns.
TURNS, TURN_S = 20, 0.025


def end_with_owner(stopped: threading.Event) -> None:
    """Set an event when the owner has ended; nothing happens where there is none.

    Whoever hangs, and does not look at the event, ends some seconds later.
    """
    text = os.environ.get(OWNER, "")
    if not text.isdecimal():
        return
    try:
        owner = os.pidfd_open(int(text))
    except ProcessLookupError:
        stopped.set()
        return
    except OSError:
        return  # a kernel without them
    threading.Thread(target=_wait, args=(owner, stopped), name="leash", daemon=True).start()


def _wait(owner: int, stopped: threading.Event) -> None:
    select.select([owner], [], [])
    time.sleep(os.getpid() % TURNS * TURN_S)
    stopped.set()
    time.sleep(PATIENCE_S)
    os._exit(1)
