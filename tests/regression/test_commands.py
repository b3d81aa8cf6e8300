"""Every command with its arguments and options, and the exit codes, as they were written down."""

from __future__ import annotations

from tests.regression.commands import FILE, HELPS, helps, surface


def test_the_command_line_is_the_one_that_was_written_down() -> None:
    """`python -m tests.regression commands` writes it again."""
    assert surface().splitlines() == FILE.read_text(encoding="utf-8").splitlines()


def test_every_help_says_what_was_written_down() -> None:
    assert helps().splitlines() == HELPS.read_text(encoding="utf-8").splitlines()


def test_no_help_shows_a_python_type() -> None:
    text = HELPS.read_text(encoding="utf-8")
    assert "str>" not in text
    assert "int>" not in text
    assert "range>" not in text
    assert "ath>" not in text
    assert "{" not in text
