"""`dwell new`: a cell, a policy, stages and a test to begin with, made from the examples."""

from __future__ import annotations

import re
import shutil
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from dwell.cli.examples import find_examples
from dwell.cli.options import argument
from dwell.cli.schema import SCHEMA_FILE, schema_text
from dwell.errors import ProblemError

FOLDER = re.compile(r"\w[\w.+-]{0,62}")


class Template(StrEnum):
    """The example that a new cell begins as."""

    CANONICAL = "canonical"
    LIVE = "live"


CELLS = {Template.CANONICAL: "first.yaml", Template.LIVE: "live/cell.yaml"}
STAGES = {Template.CANONICAL: "stages.py", Template.LIVE: "live/stages.py"}

#: First lines of the cell file, after the line for editors.
HEAD = """\
# The cell {name}, made from Dwell's example `{origin}`. Change, from top to bottom:
#   period_ms           period of the pipeline; deadline_ms: deadline of a cycle
#   nodes, links        your computers and their connections
#   tasks, flows        your stages: nodes, execution times, messages
#   candidates          the placements to choose from
#   scenarios           disturbances of nodes and links
#   objective           cost of a placement: weights, targets, caps
#   controller.policy   the policy: `policy:Patient` is the class in policy.py
{more}
# Keys for a first cell; docs/reference/cells.md lists all keys:
{keys}
# `dwell check cell.yaml` finds every fault; `python test_cell.py` simulates the cell.
"""
MORE = {
    Template.CANONICAL: "# Execution times: `dwell profile --node R1 --task "
    "perception=stages:perceive --inputs stages:frame`\n# measures functions of stages.py here.",
    Template.LIVE: "#   tasks.*.run         functions and classes in stages.py\n"
    "#   live.hosts          addresses of your computers",
}
#: Command that tries the policy.
RUN = {
    Template.CANONICAL: "dwell run cell.yaml --windows 20",
    Template.LIVE: "dwell live run cell.yaml --seconds 20",
}
STAGES_HEAD = {
    Template.CANONICAL: '"""Stages to measure: replace them with yours."""\n',
    Template.LIVE: '"""Stages, and the drive that they steer: replace them with yours."""\n',
}


def new(
    folder: Annotated[Path, argument("NAME", "Folder to make.")],
    origin: Annotated[
        Template, typer.Option("--from", help="Example to start from: simulated or live.")
    ] = Template.CANONICAL,
) -> None:
    """Make a folder with a cell, a policy, stages and a test.

    The files work unchanged; comments name the parts to change.
    """
    if FOLDER.fullmatch(folder.name) is None:
        raise ProblemError(
            f"{str(folder)!r} is no name for a folder; use letters, digits, _ - . and +, a "
            "letter, a digit or _ first, at most 63 characters"
        )
    if not folder.parent.is_dir():
        raise ProblemError(f"{folder.parent} is not a folder; make it first")
    files = _files(find_examples(None), folder.name, origin)
    try:
        folder.mkdir()
    except FileExistsError:
        raise ProblemError(f"{folder} exists already; choose another name") from None
    try:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    typer.echo(
        f"made {folder}: {', '.join(files)}\n\n"
        f"cd {folder}\n"
        "dwell check cell.yaml\n"
        "python test_cell.py\n"
        f"{RUN[origin]} --policy policy:Patient"
    )


def _files(examples: Path, name: str, origin: Template) -> dict[str, str]:
    """Return the texts of the files of a new cell by their names."""
    given = {
        file: (examples / place).read_text(encoding="utf-8")
        for file, place in {
            "cell.yaml": CELLS[origin],
            "policy.py": "new/policy.py",
            "stages.py": STAGES[origin],
            "test_cell.py": "new/test_cell.py",
        }.items()
    }
    head = HEAD.format(name=name, origin=origin.value, more=MORE[origin], keys=_first_keys())
    cell = re.sub(r"\A(#.*\n)+", "", given["cell.yaml"])
    cell = re.sub(r"^name: .*$", f"name: '{name}'", cell, count=1, flags=re.MULTILINE)
    stages = given["stages.py"].partition("\n")[2]
    return {
        **given,
        "cell.yaml": f"# yaml-language-server: $schema={SCHEMA_FILE}\n{head}{cell}",
        "stages.py": STAGES_HEAD[origin] + stages,
        SCHEMA_FILE: schema_text(),
    }


def _first_keys() -> str:
    """Return a comment with the keys that a first cell needs, by their part of the file."""
    from dwell.cellfile import cell_form

    shapes = {
        "nodes": cell_form.NODE,
        "links": cell_form.LINK,
        "tasks": cell_form.TASK,
        "tasks.*.on": cell_form.EXECUTION,
        "flows": cell_form.FLOW,
        "scenarios": cell_form.DISTURBANCE,
        "objective": cell_form.OBJECTIVE,
        "controller": cell_form.CONTROLLER,
    }
    firsts = {
        part: [key.named for key in shape.by_tier if key.tier == "first"]
        for part, shape in shapes.items()
    }
    return "\n".join(f"#   {part:<19} {', '.join(keys)}" for part, keys in firsts.items())
