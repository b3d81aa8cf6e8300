"""`dwell schema`: the JSON Schema of the cell file, printed or written for an editor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dwell.cli.options import argument, flag
from dwell.cli.output import write_file
from dwell.errors import ProblemError

#: What a cell file's first line calls its schema.
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
        raise typer.BadParameter(f"say --write to write {file}")
    else:
        typer.echo(schema_text(), nl=False)


def schema_text() -> str:
    """Return the schema as a file has it."""
    from dwell.cellfile import schema

    return json.dumps(schema(), indent=2) + "\n"


def write_schema(path: Path) -> None:
    """Write the schema, and say what to put into a cell file.

    Raises
    ------
    ProblemError
        If there is another file of that name, or a folder, or the folder around it is not there.
    OSError
        If it cannot be written; an older schema stays then.
    """
    if path.is_dir():
        raise ProblemError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise ProblemError(f"there is no folder {path.parent} to write {path.name} in")
    if path.exists() and not _is_schema(path):
        raise ProblemError(f"{path} is there already, and is no schema; choose another file")
    write_file(path, schema_text())
    typer.echo(
        f"wrote {path}; the first line of a cell file beside it:\n"
        f"# yaml-language-server: $schema={path.name}"
    )


def _is_schema(path: Path) -> bool:
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        return False
    return isinstance(known, dict) and known.get("title") == json.loads(schema_text())["title"]
