"""What an agent starts: ``python -m dwell.cli.process --cell FILE --who NAME --state FOLDER``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Iterable
from pathlib import Path

from dwell.errors import DwellError

__all__ = ["command", "main"]


def command(
    cell: Path,
    who: str,
    state: Path,
    cpus: Iterable[int] | None = None,
    priority: int | None = None,
) -> list[str]:
    """Return the command of a process of a cell.

    Parameters
    ----------
    cell : Path
    who : str
    state : Path
        Folder of its node's files.
    cpus : iterable of int, optional
        Those that it may use; those of its agent where None.
    priority : int, optional
        Its real-time priority, 1 to 99.
    """
    words = ["--cell", str(cell), "--state", str(state)]
    if cpus is not None:
        words += ["--cpus", ",".join(map(str, sorted(cpus)))]
    if priority is not None:
        words += ["--realtime", str(priority)]
    return [sys.executable, "-m", "dwell.cli.process", "--who", who, *words]


def main(arguments: list[str] | None = None) -> int:
    """Run the process until it is told to end; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", type=Path, required=True)
    parser.add_argument("--who", required=True)
    parser.add_argument("--state", type=Path, required=True)
    parser.add_argument("--cpus", default="")
    parser.add_argument("--realtime", type=int, default=0)
    asked = parser.parse_args(arguments)
    _schedule(asked.who, asked.cpus, asked.realtime)
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())
    # The user's stages lie beside their cell file.
    sys.path.insert(0, str(asked.cell.resolve().parent))
    try:
        from dwell.io import load
        from dwell.live.leash import end_with_owner
        from dwell.live.log import escape_output
        from dwell.live.process import run_process
        from dwell.profiling.memory import keep_memory

        # What a user's code prints, and its exceptions, are shown on terminals.
        escape_output()
        keep_memory()
        end_with_owner(stopped)
        run_process(load(asked.cell), asked.who, asked.state, stopped)
    except DwellError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _schedule(who: str, cpus: str, priority: int) -> None:
    """Take CPUs and a priority; threads that are started later inherit both.

    A process that may not goes on without: it says so, and the loop does not stop for it.
    """
    try:
        if cpus:
            os.sched_setaffinity(0, {int(cpu) for cpu in cpus.split(",")})
        if priority:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        what = f"real-time priority {priority}" if priority else f"CPUs {cpus}"
        print(f"{who}: no {what}: {error.strerror}; LimitRTPRIO?", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
