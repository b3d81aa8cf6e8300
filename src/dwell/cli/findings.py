"""What `dwell doctor` found out, and how it is printed."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import typer

from dwell.errors import DwellError


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Parameters
    ----------
    name : str
        Name of the thing, in a few words.
    remedy : str
        Action that repairs it; empty if no action is needed.
    needed : bool
        Whether its part needs it to work.
    """

    name: str
    ok: bool
    found: str
    remedy: str = ""
    needed: bool = True


@dataclass(frozen=True, slots=True)
class Check:
    """One thing to look for on this computer, with the remedy if it is missing.

    `look` returns whether all is well, with a description. If it raises a DwellError, the thing is
    missing.
    """

    name: str
    look: Callable[[], tuple[bool, str]]
    remedy: str = ""
    needed: bool = True

    def finding(self) -> Finding:
        """Look."""
        try:
            ok, found = self.look()
        except DwellError as error:
            ok, found = False, str(error)
        return Finding(self.name, ok, found, "" if ok else self.remedy, self.needed)


@dataclass(frozen=True, slots=True)
class Part:
    """Findings under one heading.

    Parameters
    ----------
    command : str
        The command that works if all of `required` is well; empty for none.
    extra : str
        The extra that the command needs besides.
    """

    name: str
    findings: Sequence[Finding]
    command: str = ""
    extra: str = ""
    required: Sequence[Finding] = ()


def optional(name: str, ok: bool, found: str, remedy: str = "") -> Finding:
    """Return a finding on an optional part; it has its remedy if the part is missing."""
    return Finding(name, ok, found, "" if ok else remedy, needed=False)


def print_findings(findings: Iterable[Finding], *, broken: str, lacking: str) -> None:
    """Print findings, each with its remedy below; long lines are broken on a terminal.

    Parameters
    ----------
    broken, lacking : str
        Marks of failed findings: on needed parts, and on optional parts.
    """
    columns = shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
    for finding in findings:
        mark = "ok" if finding.ok else broken if finding.needed else lacking
        lines = [f"{mark:8} {finding.name}: {finding.found}"]
        lines += [f"{'':8} {finding.remedy}"] * bool(not finding.ok and finding.remedy)
        for line in lines:
            indent = " " * 9
            typer.echo(
                textwrap.fill(line, columns, subsequent_indent=indent, break_on_hyphens=False)
            )
