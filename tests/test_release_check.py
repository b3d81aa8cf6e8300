"""The checks of a release that take seconds; `make release-check` makes all of them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.release_check import interpreter, lines_of, run

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_a_stranger_installs_first_and_enters_each_command_of_the_readme() -> None:
    lines = lines_of(README)
    assert lines[0].startswith("make env && ")
    assert [line for line in lines if line.startswith("dwell ")] == [
        line.removeprefix("$ ") for line in README.splitlines() if line.startswith("$ dwell ")
    ]


def test_the_interpreter_of_a_version_is_one_that_runs() -> None:
    version = ".".join(map(str, sys.version_info[:2]))
    found = interpreter(version)
    assert found is None or run(found, "--version").startswith(f"Python {version}.")
    assert interpreter("2.99") is None


def test_a_command_that_fails_gives_its_output() -> None:
    with pytest.raises(RuntimeError, match="no such thing"):
        run(sys.executable, "-c", "raise SystemExit('no such thing')")
