"""Command of a process of a cell; agents start it.

``python -m dwell.live.host.role_command --cell FILE --who NAME --state FOLDER``

With ``--serve`` it is the fork server: it imports the modules, and forks the other processes.
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
    """Return the command of the fork server of a cell.

    The server reads `cell` once, to import the modules for reading. `program` is the module that
    runs or replaces this module, with its first arguments (see `Platform`). All the processes end
    with the process `owner`.
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

    `cpus` default to the agent's CPUs; `priority` is a real-time priority from 1 to 99.
    """
    arguments = ["--who", who, "--cell", str(cell), "--state", str(state)]
    if cpus is not None:
        arguments += ["--cpus", ",".join(map(str, sorted(cpus)))]
    if priority is not None:
        arguments += ["--realtime", str(priority)]
    return arguments


def main(arguments: Sequence[str] | None = None, platform: Platform | None = None) -> int:
    """Run the process until a signal ends it; return the exit code."""
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
    """Import the modules of all processes and fork at each request; run each forked process."""
    from dwell.live.host import supervision  # noqa: F401
    from dwell.live.host.kept_cell import KeptCell
    from dwell.live.host.launcher import serve

    KeptCell.of(cell, [state]).problem()
    words = serve()
    if words is None:
        return 0
    # Stages may read their names there.
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

    # Terminals show the output and the exceptions of users' code.
    escape_output()
    keep_memory()
    end_with_owner(stopped, options.owner)
    claim(options.state, options.who)
    # Read the agent's copy, or the files if a user started the process.
    kept = KeptCell.of(options.cell, [options.state])
    kept.install()
    problem = kept.problem()
    try:
        in_order = run_process(problem, options.who, options.state, stopped, platform or PLAIN)
    finally:
        end_helpers()
    return ExitCode.DONE if in_order else ExitCode.FAILED


def _name(who: str) -> None:
    """Set the name that `ps -o comm` and `top` show; the command line is the fork server's."""
    with suppress(OSError):
        Path("/proc/self/comm").write_text(who)


def _schedule(who: str, cpus: str, priority: int) -> None:
    """Set the CPUs and the priority of this process; later threads inherit both.

    If the system refuses, the process prints an error and continues, as the loop must not stop.
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
