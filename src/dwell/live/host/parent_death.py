"""End of a process with its owner, which may be a distant ancestor.

The processes of a cell outlive their agent, so it can be restarted. If a complete cell belongs to
one process (a testbed, a test), all its processes have the owner's process id on their command
lines (`OPTION`). They end with the owner, even if it was killed.

Their shared memory is removed, too. Zenoh removes a segment when the last process releases it. If
two processes release it at the same instant, each finds it held by the other, and the segment stays
until another process starts Zenoh. So a separate process, ``python -m
dwell.live.host.parent_death OWNER``, waits until all of them have ended, and removes the segments
that no process holds.
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

#: Option of agents, controllers and processes: id of the owner.
OPTION = "--owner"
#: Time from the owner's end to the forced end of a process.
PATIENCE_S = 8.0
#: Longest time that the sweeper waits for the processes of its owner.
SWEEP_S = 60.0


def end_with_owner(stopped: threading.Event, owner: int | None) -> None:
    """Set an event when the owner (a process id, if any) has ended.

    If this process hangs and ignores the event, it is ended after `PATIENCE_S`.
    """
    if owner is None:
        return
    try:
        descriptor = os.pidfd_open(owner)
    except ProcessLookupError:
        stopped.set()
        return
    except OSError:
        return  # a kernel without pidfd_open
    start_thread("parent-death", _wait, descriptor, stopped)


def _wait(owner: int, stopped: threading.Event) -> None:
    select.select([owner], [], [])
    stopped.set()
    time.sleep(PATIENCE_S)
    os._exit(1)


def start_sweeper() -> subprocess.Popen[bytes]:
    """Start the process that removes the shared memory of all processes with this owner."""
    return subprocess.Popen(  # noqa: S603 - our own command
        [sys.executable, "-P", "-m", "dwell.live.host.parent_death", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0,
    )


def end_those_of(owner: str, cell: Path, patience_s: float) -> None:
    """Kill the processes with this owner and cell file on their command lines; await their end."""
    _await({OPTION: owner, "--cell": str(cell.resolve())}, patience_s, signal.SIGKILL)


def _sweep(owner: int) -> None:
    try:
        select.select([os.pidfd_open(owner)], [], [])
    except ProcessLookupError:
        pass  # it has ended already
    except OSError:
        return  # a kernel without pidfd_open: no process ends with an owner
    _await({OPTION: str(owner)}, SWEEP_S)
    remove_orphans()


def _await(options: Mapping[str, str], patience_s: float, number: int = 0) -> None:
    """Wait for the end of all processes with some options; first send them a signal, if not 0."""
    deadline = time.monotonic() + patience_s
    # Search again: a process may have started another process before its end.
    while (left_s := deadline - time.monotonic()) > 0 and (left := _with_options(options)):
        for process in left:
            with suppress(OSError):
                signal.pidfd_send_signal(process, number)
        for process in left:
            # The descriptor is readable after the process has released all its files.
            select.select([process], [], [], left_s)
            os.close(process)


def _with_options(options: Mapping[str, str]) -> list[int]:
    """Return a descriptor of every process whose command line has all these options."""
    parts = [os.fsencode(f"\0{name}\0{value}\0") for name, value in options.items()]
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        # Skip processes that have just ended, or belong to other users.
        with suppress(OSError):
            read = file.read_bytes()
            if all(part in read for part in parts):
                found.append(os.pidfd_open(int(file.parent.name)))
    return found


if __name__ == "__main__":
    _sweep(int(sys.argv[1]))
