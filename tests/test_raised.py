"""What a user's code raised, in one line with its place."""

from __future__ import annotations

from typing import Any

import pytest

from dwell.errors import LONGEST, PACKAGE, describe_raised


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


def raised_in_call(code: str) -> BaseException:
    """Return the error of ``decide(1)``, called from a file of Dwell's."""
    scope: dict[str, Any] = {}
    exec(compile(code, "/home/me/policy.py", "exec"), scope)
    try:
        exec(compile("decide(1)", f"{PACKAGE}engine.py", "exec"), scope)
    except BaseException as error:
        begin = error.__traceback__
        return error.with_traceback(begin and begin.tb_next)
    raise AssertionError("it raised nothing")


def test_a_users_line_is_the_last_one_in_the_file_that_dwell_called() -> None:
    error = raised_in_call(
        "import json\ndef decide(x):\n    return read()\n\ndef read():\n    json.loads('')\n"
    )
    assert describe_raised(error, users=True).endswith(" (policy.py:6)")
    assert "(decoder.py:" in describe_raised(error)


def test_the_place_of_a_call_itself_is_not_named() -> None:
    error = raised_in_call("def decide():\n    pass\n")
    told = "TypeError: decide() takes 0 positional arguments but 1 was given"
    assert describe_raised(error, users=True) == told


def test_long_messages_are_cut() -> None:
    line = describe_raised(raised("raise ValueError('x' * 1000)", "stages.py"))
    assert line == f"ValueError: {'x' * LONGEST} (stages.py:1)"
