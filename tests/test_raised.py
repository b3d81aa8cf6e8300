"""What a user's code raised, in one line with its place."""

from __future__ import annotations

import pytest

from dwell.errors import LONGEST, describe_raised


def raised(code: str, name: str) -> BaseException:
    try:
        exec(compile(code, name, "exec"), {})
    except BaseException as error:
        return error
    raise AssertionError("it raised nothing")


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ("x = 1\nraise ValueError('no frame')", "ValueError: no frame (stages.py:2)"),
        ("raise ValueError('first\\nsecond')", "ValueError: first (stages.py:1)"),
        ("raise KeyError", "KeyError (stages.py:1)"),
        ("raise SystemExit(3)", "SystemExit: 3 (stages.py:1)"),
        ("int('a')", "ValueError: invalid literal for int() with base 10: 'a' (stages.py:1)"),
    ],
)
def test_the_line_names_error_and_place(code: str, line: str) -> None:
    assert describe_raised(raised(code, "/home/me/stages.py")) == line


def test_a_file_that_is_no_python_is_named_once() -> None:
    assert describe_raised(raised("def (:", "stages.py")).endswith("(stages.py, line 1)")


def test_the_place_of_a_call_itself_is_not_named() -> None:
    error = raised("raise TypeError('no argument')", "/home/me/stages.py")
    assert describe_raised(error, but="/home/me/stages.py") == "TypeError: no argument"


def test_long_messages_are_cut() -> None:
    line = describe_raised(raised("raise ValueError('x' * 1000)", "stages.py"))
    assert line == f"ValueError: {'x' * LONGEST} (stages.py:1)"
