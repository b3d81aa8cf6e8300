"""Ends this process when its owner ends, however many processes stand between the two.

The processes of a cell outlive their agent, so that it can be started again. Where a whole cell
belongs to one process (the demo, a test), its variable `OWNER` says so to all of them, and none of
them is left when that process has ended, even if it was killed.

Nor is their shared memory. Zenoh removes a segment with the last process that lets go of it, but
where two do so at the same instant each finds it held by the other, and it stays until a Zenoh
starts again. So a process of its own, ``python -m dwell.live.parent_death OWNER``, waits until all
of them have ended, and removes the segments that nobody holds.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from dwell.live.failures import start_thread
from dwell.live.transport.orphans import remove_orphans

__all__ = ["OWNER", "end_with_owner", "start_sweeper"]

#: Environment variable: id of the process that all others of a cell end with.
OWNER = "DWELL_OWNER"
#: What does not end by itself within this time after its owner is ended.
PATIENCE_S = 8.0
#: How long the sweeper waits for those that end with its owner.
SWEEP_S = 60.0


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
    start_thread("parent-death", _wait, owner, stopped)


def _wait(owner: int, stopped: threading.Event) -> None:
    select.select([owner], [], [])
    stopped.set()
    time.sleep(PATIENCE_S)
    os._exit(1)


def start_sweeper() -> subprocess.Popen[bytes]:
    """Start what removes the shared memory of all that end with this process, once they have."""
    return subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-P", "-m", "dwell.live.parent_death", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0,
    )


def _sweep(owner: int) -> None:
    try:
        select.select([os.pidfd_open(owner)], [], [])
    except ProcessLookupError:
        pass  # it has ended already
    except OSError:
        return  # a kernel without them: nobody ends with an owner
    deadline = time.monotonic() + SWEEP_S
    # Whoever is waited for may have started another one meanwhile.
    while (left_s := deadline - time.monotonic()) > 0 and (left := _those_of(owner)):
        for process in left:
            # Readable when it has let go of all its files.
            select.select([process], [], [], left_s)
            os.close(process)
    remove_orphans()


def _those_of(owner: int) -> list[int]:
    """Return a descriptor of every process that ends with an owner."""
    mark = f"{OWNER}={owner}".encode()
    found = []
    for file in Path("/proc").glob("[0-9]*/environ"):
        # Some have just ended, and some are other users'.
        with suppress(OSError):
            if mark in file.read_bytes().split(b"\0"):
                found.append(os.pidfd_open(int(file.parent.name)))
    return found


if __name__ == "__main__":
    _sweep(int(sys.argv[1]))
