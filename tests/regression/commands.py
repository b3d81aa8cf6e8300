"""The command line: every command, its arguments and options, and what it may exit with."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import click
import typer
from typer.testing import CliRunner

from dwell.cli.commands import app
from dwell.errors import ExitCode

FILE = Path(__file__).parent / "data" / "commands.txt"
HELPS = FILE.with_name("helps.txt")
#: A terminal's.
NARROW = 80
#: So many that every option has one line of its help.
COLUMNS = 2000
#: An option, its help, and what holds of its value.
OPTION = re.compile(r"^  (-.*?)  .*?( \[[^\]]*\])?$", re.MULTILINE)


def helps() -> str:
    """Return the helps of all commands, one after another, as a terminal shows them."""
    root = cast(click.Group, typer.main.get_command(app))
    shown = ((words, _help(words, NARROW)) for words in _commands(root, ()))
    return "\n".join(f"$ {' '.join(('dwell', *words))} --help\n{text}" for words, text in shown)


def surface() -> str:
    """Return a line a command and, below it, a line an option."""
    root = cast(click.Group, typer.main.get_command(app))
    codes = ", ".join(f"{code} {code.name.lower()}" for code in ExitCode)
    lines = (line for words in _commands(root, ()) for line in _lines(words))
    return "\n".join([f"exit codes: {codes}", *lines]) + "\n"


def _commands(command: click.Command, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    yield words
    for name, inner in getattr(command, "commands", {}).items():
        yield from _commands(inner, (*words, name))


def _lines(words: tuple[str, ...]) -> Iterator[str]:
    """Yield the usage of a command, and its options, as its help says them."""
    text = _help(words, COLUMNS)
    usage = text.partition("\n")[0].removeprefix("Usage: ").replace(" [OPTIONS]", "")
    yield from ("", usage)
    for option, holds in OPTION.findall(text):
        if option != "--help":
            yield f"    {option}{holds}"


def _help(words: tuple[str, ...], columns: int) -> str:
    found = CliRunner().invoke(
        app,
        [*words, "--help"],
        prog_name="dwell",
        terminal_width=columns,
        max_content_width=columns,
        color=False,
    )
    assert found.exit_code == 0, found.output
    return found.stdout
