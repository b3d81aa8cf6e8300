"""`dwell schema`: the JSON Schema of the cell file, printed or written for an editor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dwell.cli.options import argument, flag
from dwell.cli.output import write_file
from dwell.errors import ProblemError

#: Name of the schema in a cell file's first line.
SCHEMA_FILE = "cell.schema.json"


def schema(
    file: Annotated[
        Path | None, argument("FILE", "File to write; cell.schema.json without it.")
    ] = None,
    write: Annotated[bool, flag("--write", "Write it to a file for an editor.")] = False,
) -> None:
    """Print the JSON Schema of the cell file, or write it."""
    if write:
        write_schema(file or Path(SCHEMA_FILE))
    elif file is not None:
        raise typer.BadParameter(f"add --write to write {file}")
    else:
        typer.echo(schema_text(), nl=False)


def schema_text() -> str:
    """Return the text of the schema's file."""
    from dwell.cellfile import schema

    return json.dumps(schema(), indent=2) + "\n"


def write_schema(path: Path) -> None:
    """Write the schema, and print the line for a cell file.

    Raises
    ------
    ProblemError
        If another file or a folder has the name, or its folder is missing.
    OSError
        If it cannot be written; an older schema stays.
    """
    if path.is_dir():
        raise ProblemError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise ProblemError(f"{path.parent} is not a folder; make it first")
    if path.exists() and not _is_schema(path):
        raise ProblemError(f"{path} exists and is no schema; choose another file")
    write_file(path, schema_text())
    typer.echo(
        f"wrote {path}; put this line first in a cell file of the same folder:\n"
        f"# yaml-language-server: $schema={path.name}"
    )


def _is_schema(path: Path) -> bool:
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        return False
    return isinstance(known, dict) and known.get("title") == json.loads(schema_text())["title"]
