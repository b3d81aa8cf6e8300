"""Entry point of agents, controllers and other processes with emulated faults, for a testbed.

``python -m dwell.live.local.process [--links FILE] [--clocks FILE] COMMAND ...`` works like ``dwell
COMMAND ...`` for ``agent`` and ``controller`` (with the options that a testbed needs), and like
``python -m dwell.live.host.role_command`` for ``process``. A `LinkFile` delays and drops the
messages of the process, and a `ClockFile` shifts its clock.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from dwell.errors import ExitCode, line_and_code
from dwell.live.host import role_command
from dwell.live.host.hosting import Clock, Platform
from dwell.live.host.security import Security
from dwell.live.local.clocks import wrong_clock
from dwell.live.local.linked_transport import LinkedTransport
from dwell.live.local.message_links import LinkEnds
from dwell.live.log import say
from dwell.live.wire.transport import Transport
from dwell.model import Problem


def program(*, links: Path | None = None, clocks: Path | None = None) -> tuple[str, ...]:
    """Return this module and its first arguments, for a `LinkFile` and a `ClockFile`."""
    given = {"--links": links, "--clocks": clocks}
    words = [word for name, path in given.items() if path is not None for word in (name, str(path))]
    return "dwell.live.local.process", *words


class FaultyPlatform(Platform):
    """Clock and transport with the faults of a `ClockFile` and a `LinkFile`, if given."""

    def __init__(self, *, links: Path | None = None, clocks: Path | None = None) -> None:
        self.program = (*program(links=links, clocks=clocks), "process")
        self._links, self._clocks = links, clocks

    def clock(self, problem: Problem, node: str) -> Clock:
        """Return the clock of a node's processes."""
        clock = super().clock(problem, node)
        return clock if self._clocks is None else wrong_clock(clock, self._clocks, node)

    def transport(self, security: Security, who: str, node: str) -> Transport:
        """Open the sessions of a process on a node."""
        if self._links is None:
            return super().transport(security, who, node)
        ends = LinkEnds(self._links, who, node)
        return LinkedTransport(super().transport(security, who, node), ends)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command until a signal ends it; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--links", type=Path)
    parser.add_argument("--clocks", type=Path)
    parser.add_argument("command", choices=("agent", "controller", "process"))
    parser.add_argument("words", nargs=argparse.REMAINDER)
    asked = parser.parse_args(arguments)
    platform = FaultyPlatform(links=asked.links, clocks=asked.clocks)
    if asked.command == "process":
        return role_command.main(asked.words, platform)
    # Pydantic would search all installed packages for plugins; Dwell uses none.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    return _run_node(asked.command, asked.words, platform)


def _run_node(command: str, words: Sequence[str], platform: Platform) -> int:
    """Run an agent or a controller."""
    from dwell.live.host import node_command

    parser = _parser(command)
    options = vars(parser.parse_args(words))
    file, jobs = options.pop("cell"), os.environ.get("DWELL_JOBS", "")
    try:
        if command == "agent":
            node_command.agent(cell=file, **options, platform=platform)
        else:
            options.setdefault("jobs", jobs.lower() in ("1", "on", "t", "true", "y", "yes"))
            node_command.controller([file], **options, platform=platform)
    except node_command.OptionError as error:
        parser.error(str(error))
    except Exception as error:
        known = line_and_code(error)
        if known is None:
            raise
        line, code = known
        say(line)
        return code
    return ExitCode.DONE


def _parser(command: str) -> argparse.ArgumentParser:
    """Return a parser of the options that testbeds and restarts give to a command.

    The `dwell` command would need 0.2 s more per start for its parser.
    """
    parser = argparse.ArgumentParser(
        command, allow_abbrev=False, argument_default=argparse.SUPPRESS
    )
    parser.add_argument("--cell", type=Path, required=True)
    parser.add_argument("--state", type=Path)
    parser.add_argument("--cpus")
    parser.add_argument("--owner", type=int)
    if command == "agent":
        parser.add_argument("--node", required=True)
        parser.add_argument("--renews", action="store_true")
        return parser
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--policy")
    parser.add_argument("--continues")
    parser.add_argument("--jobs", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(main())
