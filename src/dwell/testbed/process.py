"""Agents, controllers and their processes with faults around them: a testbed's entry point.

``python -m dwell.testbed.process [--losses FILE] [--clocks FILE] COMMAND ...`` runs the code of
``dwell COMMAND ...`` (``agent`` or ``controller``), and that of ``python -m dwell.cli.process``
where the command is ``process``. Its transport leaves out the messages that a `LossFile` says, and
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
from dwell.testbed.losses import Losses, LossyTransport

__all__ = ["FaultyPlatform", "main", "program"]


def program(*, losses: Path | None = None, clocks: Path | None = None) -> tuple[str, ...]:
    """Return the module, and its first arguments, that runs agents and controllers with faults.

    Parameters
    ----------
    losses, clocks : Path, optional
        As a `LossFile` and a `ClockFile` have written them.
    """
    given = {"--losses": losses, "--clocks": clocks}
    words = [word for name, path in given.items() if path is not None for word in (name, str(path))]
    return "dwell.testbed.process", *words


class FaultyPlatform(Platform):
    """Clock and transport with faults around them.

    Parameters
    ----------
    losses, clocks : Path, optional
        Without, no message is lost, or clocks are right.
    """

    def __init__(self, *, losses: Path | None = None, clocks: Path | None = None) -> None:
        self.program = (*program(losses=losses, clocks=clocks), "process")
        self._losses, self._clocks = losses, clocks

    def clock(self, problem: Problem, node: str) -> Clock:
        """Return what the processes of a node read the time from."""
        clock = super().clock(problem, node)
        return clock if self._clocks is None else wrong_clock(clock, self._clocks, node)

    def transport(self, security: Security, who: str, node: str) -> Transport:
        """Open the sessions of a process on a node."""
        if self._losses is None:
            return super().transport(security, who, node)
        losses = Losses(self._losses, who, node)
        return LossyTransport(super().transport(security, who, node), losses)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command until it is told to end; returns the exit code."""
    from dwell.cli import main as dwell
    from dwell.cli.process import main as process

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--losses", type=Path)
    parser.add_argument("--clocks", type=Path)
    parser.add_argument("command", choices=("agent", "controller", "process"))
    parser.add_argument("words", nargs=argparse.REMAINDER)
    asked = parser.parse_args(arguments)
    platform = FaultyPlatform(losses=asked.losses, clocks=asked.clocks)
    if asked.command == "process":
        return process(asked.words, platform)
    dwell([asked.command, *asked.words], platform)
    return 0


if __name__ == "__main__":
    sys.exit(main())
