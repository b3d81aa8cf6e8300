"""The command `dwell` itself: its version, and commands that there are not."""

from __future__ import annotations

import dwell
from tests.cli.small_cell import call


def test_version() -> None:
    assert call("--version").stdout == f"dwell {dwell.__version__}\n"


def test_a_wrong_command_is_named_with_its_nearest() -> None:
    result = call("chek")
    assert result.exit_code == 2
    assert "check" in result.stderr
