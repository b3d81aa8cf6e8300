"""The page of commands, from their declarations: `python -m docs.commands` writes it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from dwell.cli.commands import app

PAGE = Path(__file__).with_name("reference") / "commands.md"
TEXT = """# Commands

`dwell COMMAND --help` lists the options; [one file](../../tests/regression/data/commands.txt) has
the options of all commands. Commands with `--json` print for programs. Exit codes: 0 done, 1 the
work failed, 2 the input is wrong, 130 interrupted. Files are complete or absent. `python -m
docs.commands` writes this page.

| command | does |
|---|---|
{rows}
"""


def rows(group: Any, words: tuple[str, ...] = ("dwell",)) -> Iterator[str]:
    """Yield a row for each visible command below a group, in their order."""
    for name, command in group.commands.items():
        if command.hidden:
            continue
        is_group = hasattr(command, "commands")
        if not is_group or command.invoke_without_command:
            does = command.help.partition("\n\n")[0].replace("\n", " ").rstrip(".")
            yield f"| `{' '.join((*words, name))}` | {does} |"
        if is_group:
            yield from rows(command, (*words, name))


def page() -> str:
    """Return the page."""
    return TEXT.format(rows="\n".join(rows(typer.main.get_command(app))))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
