"""The command line as its helps say it: every command, argument and option."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import click
import typer
from typer.testing import CliRunner

from dwell.cli.commands import app

__all__ = ["FILE", "surface"]

FILE = Path(__file__).parent / "data" / "commands.txt"
COLUMNS = 80


def surface() -> str:
    """Return the helps of all commands, one after another."""
    root = cast(click.Group, typer.main.get_command(app))
    return "\n".join(f"$ {' '.join(words)} --help\n{_help(words)}" for words in _commands(root, ()))


def _commands(command: click.Command, words: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    yield ("dwell", *words)
    for name, inner in getattr(command, "commands", {}).items():
        yield from _commands(inner, (*words, name))


def _help(words: tuple[str, ...]) -> str:
    found = CliRunner().invoke(
        app,
        [*words[1:], "--help"],
        prog_name="dwell",
        terminal_width=COLUMNS,
        max_content_width=COLUMNS,
        color=False,
    )
    assert found.exit_code == 0, found.output
    return found.stdout
