"""Ends this process when its owner ends, however many processes stand between the two.

The processes of a cell outlive their agent, so that it can be started again. Where a whole cell
belongs to one process (a testbed, a test), all of them have its process id on their command lines
(`OPTION`), and none of them is left when that process has ended, even if it was killed.

Nor is their shared memory. Zenoh removes a segment with the last process that lets go of it, but
where two do so at the same instant each finds it held by the other, and it stays until a Zenoh
starts again. So a separate process, ``python -m dwell.live.host.parent_death OWNER``, waits until
all of them have ended, and removes the segments that no process holds.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from dwell.live.failures import start_thread
from dwell.live.transport.orphans import remove_orphans

#: Option of agent, controller and processes: id of the process that they end with.
OPTION = "--owner"
#: What does not end by itself within this time after its owner is ended.
PATIENCE_S = 8.0
#: How long the sweeper waits for those that end with its owner.
SWEEP_S = 60.0


def end_with_owner(stopped: threading.Event, owner: int | None) -> None:
    """Set an event when the owner has ended; nothing happens where there is none.

    A process that hangs, and does not look at the event, ends some seconds later.

    Parameters
    ----------
    owner : int, optional
        Its process id.
    """
    if owner is None:
        return
    try:
        descriptor = os.pidfd_open(owner)
    except ProcessLookupError:
        stopped.set()
        return
    except OSError:
        return  # a kernel without them
    start_thread("parent-death", _wait, descriptor, stopped)


def _wait(owner: int, stopped: threading.Event) -> None:
    select.select([owner], [], [])
    stopped.set()
    time.sleep(PATIENCE_S)
    os._exit(1)


def start_sweeper() -> subprocess.Popen[bytes]:
    """Start what removes the shared memory of all that end with this process, once they have."""
    return subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-P", "-m", "dwell.live.host.parent_death", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0,
    )


def end_those_of(owner: str, cell: Path, patience_s: float) -> None:
    """Kill those of a cell that end with an owner, and wait until they have ended.

    Parameters
    ----------
    owner : str
        What follows `OPTION` on their command lines.
    cell : Path
        Cell file there.
    """
    _await({OPTION: owner, "--cell": str(cell.resolve())}, patience_s, signal.SIGKILL)


def _sweep(owner: int) -> None:
    try:
        select.select([os.pidfd_open(owner)], [], [])
    except ProcessLookupError:
        pass  # it has ended already
    except OSError:
        return  # a kernel without them: nobody ends with an owner
    _await({OPTION: str(owner)}, SWEEP_S)
    remove_orphans()


def _await(options: Mapping[str, str], patience_s: float, number: int = 0) -> None:
    """Wait until those have ended that have such options; a signal goes to each, if not 0."""
    deadline = time.monotonic() + patience_s
    # Whoever is waited for may have started another one meanwhile.
    while (left_s := deadline - time.monotonic()) > 0 and (left := _with_options(options)):
        for process in left:
            with suppress(OSError):
                signal.pidfd_send_signal(process, number)
        for process in left:
            # Readable when it has let go of all its files.
            select.select([process], [], [], left_s)
            os.close(process)


def _with_options(options: Mapping[str, str]) -> list[int]:
    """Return a descriptor of every process whose command line has some options."""
    parts = [os.fsencode(f"\0{name}\0{value}\0") for name, value in options.items()]
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        # Some have just ended, and some are other users'.
        with suppress(OSError):
            read = file.read_bytes()
            if all(part in read for part in parts):
                found.append(os.pidfd_open(int(file.parent.name)))
    return found


if __name__ == "__main__":
    _sweep(int(sys.argv[1]))
