"""The command `dwell` itself: commands that there are not."""

from __future__ import annotations

from tests.cli.small_cell import assert_refused, call


def test_a_wrong_command_is_named_with_its_nearest() -> None:
    assert_refused(call("chek"), "check")
