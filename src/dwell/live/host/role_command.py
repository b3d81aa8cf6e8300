"""A process of a cell, as agents start it.

``python -m dwell.live.host.role_command --cell FILE --who NAME --state FOLDER``

With ``--serve`` it is the one that an agent has them forked from, which has done their imports.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from dwell.errors import DwellError, ExitCode, missing_package
from dwell.live.host.ending import end_when_told

if TYPE_CHECKING:
    from dwell.live.host.hosting import Platform


def server(
    cell: Path, program: Sequence[str], owner: int | None = None, state: Path | None = None
) -> list[str]:
    """Return the command of the process that those of a cell are forked from.

    Parameters
    ----------
    cell : Path
        File that it reads once, so that the modules for reading are imported.
    program : sequence of str
        Module that runs this one or stands for it, with its first arguments (see `Platform`).
    owner : int, optional
        Id of the process that all of them end with.
    state : Path, optional
        Folder of the node's files.
    """
    ends_with = [] if owner is None else ["--owner", str(owner)]
    kept = [] if state is None else ["--state", str(state)]
    return [sys.executable, "-m", *program, "--cell", str(cell), "--serve", *kept, *ends_with]


def words(
    cell: Path,
    who: str,
    state: Path,
    cpus: Iterable[int] | None = None,
    priority: int | None = None,
) -> list[str]:
    """Return the arguments of a process of a cell.

    Parameters
    ----------
    state : Path
        Folder of its node's files.
    cpus : iterable of int, optional
        CPUs that it may use; its agent's if not given.
    priority : int, optional
        Real-time priority, 1 to 99.
    """
    arguments = ["--who", who, "--cell", str(cell), "--state", str(state)]
    if cpus is not None:
        arguments += ["--cpus", ",".join(map(str, sorted(cpus)))]
    if priority is not None:
        arguments += ["--realtime", str(priority)]
    return arguments


def main(arguments: Sequence[str] | None = None, platform: Platform | None = None) -> int:
    """Run the process until it is told to end; returns the exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the module; those of this process if not given.
    platform : Platform, optional
        Clock and transport; without faults if not given.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", type=Path, required=True)
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--who", default="")
    parser.add_argument("--state", type=Path, default=Path())
    parser.add_argument("--cpus", default="")
    parser.add_argument("--realtime", type=int, default=0)
    parser.add_argument("--owner", type=int)
    options = parser.parse_args(arguments)
    try:
        if options.serve:
            return _serve(options.cell, options.state, options.owner, platform)
        return _run(options, platform)
    except DwellError as error:
        print(error, file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        missing = missing_package(error)
        if missing is None:
            raise
        print(missing, file=sys.stderr)
        return 2


def _serve(cell: Path, state: Path, owner: int | None, platform: Platform | None) -> int:
    """Import what every process needs, and fork; in a forked process, run it."""
    from dwell.live.host import supervision  # noqa: F401
    from dwell.live.host.kept_cell import KeptCell
    from dwell.live.host.launcher import serve

    KeptCell.of(cell, [state]).problem()
    words = serve()
    if words is None:
        return 0
    # Stages may look who they are.
    sys.argv[1:] = words
    return main(words if owner is None else [*words, "--owner", str(owner)], platform)


def _run(options: argparse.Namespace, platform: Platform | None) -> int:
    _name(options.who)
    _schedule(options.who, options.cpus, options.realtime)
    stopped = threading.Event()
    end_when_told(stopped, lambda: os._exit(ExitCode.FAILED))

    from dwell.live.host.hosting import PLAIN
    from dwell.live.host.kept_cell import KeptCell
    from dwell.live.host.memory import keep_memory
    from dwell.live.host.parent_death import end_with_owner
    from dwell.live.host.process_group import end_helpers
    from dwell.live.host.role_process import run_process
    from dwell.live.host.supervision import claim
    from dwell.live.log import escape_output

    # What a user's code prints, and its exceptions, are shown on terminals.
    escape_output()
    keep_memory()
    end_with_owner(stopped, options.owner)
    claim(options.state, options.who)
    # What the node's agent keeps; the files, where the process was started by hand.
    kept = KeptCell.of(options.cell, [options.state])
    kept.install()
    problem = kept.problem()
    try:
        in_order = run_process(problem, options.who, options.state, stopped, platform or PLAIN)
    finally:
        end_helpers()
    return ExitCode.DONE if in_order else ExitCode.FAILED


def _name(who: str) -> None:
    """Have `ps -o comm` and `top` show who it is: the command line is that of the fork server."""
    with suppress(OSError):
        Path("/proc/self/comm").write_text(who)


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
