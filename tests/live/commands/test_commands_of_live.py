"""The commands of a live cell: the cell is an argument, and the option --cell still works."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import typer.main

from dwell.cli.commands import app
from tests.cli.small_cell import ROOT, call

HIDDEN_COMMANDS = ("agent", "controller", "schema")


@pytest.fixture(name="cell")
def _cell(tmp_path: Path) -> Path:
    """Return a live cell that does not run."""
    return Path(shutil.copytree(ROOT / "examples" / "live", tmp_path / "cell"), "cell.yaml")


@pytest.mark.parametrize(
    "words",
    [
        ("status", "CELL"),
        ("status", "--cell", "CELL"),
        ("pin", "CELL", "HYB"),
        ("pin", "HYB", "--cell", "CELL"),
        ("pin", "CELL", "--off"),
        ("unpin", "--cell", "CELL"),
        ("drain", "CELL", "E"),
        ("drain", "E", "--cell", "CELL"),
        ("drain", "CELL", "E", "--off"),
        ("undrain", "E", "--cell", "CELL"),
    ],
)
def test_without_a_controller_each_says_that_there_is_none(
    cell: Path, words: tuple[str, ...]
) -> None:
    result = call("live", *(str(cell) if word == "CELL" else word for word in words))
    assert result.exit_code == 1, result.output
    assert "error: " in result.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("status",), "missing argument CELL"),
        (("status", "CELL", "--cell", "CELL"), "name one cell"),
        (("pin", "CELL"), "missing argument CANDIDATE"),
        (("drain", "CELL"), "missing argument NODE"),
        (("pin", "CELL", "HYB", "--cell", "CELL"), "name one cell"),
        (("log",), "missing argument CELL"),
        (("agent", "--node", "E"), "missing argument CELL"),
        (("controller",), "missing argument CELL"),
    ],
)
def test_what_is_missing_is_named(cell: Path, words: tuple[str, ...], message: str) -> None:
    result = call("live", *(str(cell) if word == "CELL" else word for word in words))
    assert result.exit_code == 2
    assert message in result.stderr


def test_old_forms_are_hidden_and_there() -> None:
    group = typer.main.get_command(app)
    commands = group.commands  # type: ignore[attr-defined]
    assert {name for name, one in commands.items() if one.hidden} == set(HIDDEN_COMMANDS)
    live = commands["live"].commands
    assert {name for name, one in live.items() if one.hidden} == {"unpin", "undrain"}
    assert not any(one.hidden for one in (live["agent"], live["controller"], live["check"]))


def test_a_node_is_checked_by_both_forms(cell: Path) -> None:
    for words in (("live", "check", cell, "--node", "E"), ("check", cell, "--node", "E")):
        result = call(*words)
        assert result.exit_code == 0, result.output
        assert "E" in result.stdout
