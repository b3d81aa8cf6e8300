"""Agents, controllers and their processes with faults around them: a testbed's entry point.

``python -m dwell.testbed.process [--links FILE] [--clocks FILE] COMMAND ...`` runs the code of
``dwell COMMAND ...`` (``agent`` or ``controller``), and that of ``python -m dwell.cli.process``
where the command is ``process``. Its messages meet the links that a `LinkFile` says, and
its clock is wrong by what a `ClockFile` says.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from dwell.live.hosting import Clock, Platform
from dwell.live.security import Security
from dwell.live.transport.transport import Transport
from dwell.model import Problem
from dwell.testbed.clocks import wrong_clock
from dwell.testbed.linked_transport import LinkedTransport
from dwell.testbed.message_links import LinkEnds


def program(*, links: Path | None = None, clocks: Path | None = None) -> tuple[str, ...]:
    """Return the module, and its first arguments, that runs agents and controllers with faults.

    Parameters
    ----------
    links, clocks : Path, optional
        As a `LinkFile` and a `ClockFile` have written them.
    """
    given = {"--links": links, "--clocks": clocks}
    words = [word for name, path in given.items() if path is not None for word in (name, str(path))]
    return "dwell.testbed.process", *words


class FaultyPlatform(Platform):
    """Clock and transport with faults around them.

    Parameters
    ----------
    links, clocks : Path, optional
        Without, links are what they are, or clocks are right.
    """

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
    """Run the command until it is told to end; returns the exit code."""
    from dwell.cli import main as dwell
    from dwell.cli.process import main as process

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--links", type=Path)
    parser.add_argument("--clocks", type=Path)
    parser.add_argument("command", choices=("agent", "controller", "process"))
    parser.add_argument("words", nargs=argparse.REMAINDER)
    asked = parser.parse_args(arguments)
    platform = FaultyPlatform(links=asked.links, clocks=asked.clocks)
    if asked.command == "process":
        return process(asked.words, platform)
    dwell([asked.command, *asked.words], platform)
    return 0


if __name__ == "__main__":
    sys.exit(main())
